"""Looming detectors, each with `Params`, `State`, `init` and `step` (LGMD: eqs. 7-16)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
