"""The trained robot in another engine: C MuJoCo's contacts, pictures by OpenGL, and faults of cameras and servos."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
