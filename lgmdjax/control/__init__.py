"""From observations to left and right velocity: teacher, navigator, baselines, the whole controller (eqs. 17-22)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
