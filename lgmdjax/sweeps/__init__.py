"""Sweeps: one command with many settings and seeds, on this machine or a cluster, and a table of the results."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
