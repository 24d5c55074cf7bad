"""Cameras and servos: the trained nervous system on a robot, or on the simulated robot that stands in for one."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
