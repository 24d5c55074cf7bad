"""Sensors: the stereo fisheye camera, the laser scanner, and laboratory stimuli in place of the camera."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
