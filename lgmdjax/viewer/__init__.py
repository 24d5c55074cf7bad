"""The robot in the browser: recorded walks, and a live simulation whose controls are inputs of one compiled program."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
