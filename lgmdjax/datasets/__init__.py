"""Recorded walks in the formats of other libraries: LeRobot, CSV, Parquet, Zarr."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
