"""Cameras and servos: the trained nervous system drives a real robot or a simulated one."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
