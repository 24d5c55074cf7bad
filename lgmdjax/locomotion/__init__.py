"""Locomotion: central pattern generator, shaping networks, tripod gait and leg kinematics (eqs. 1-6)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
