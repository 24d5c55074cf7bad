"""The trained nervous system outside of the simulator: ONNX, StableHLO, C99."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
