"""Fits of the navigator, of the detector, and of any parameter of the controller through the rollout."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
