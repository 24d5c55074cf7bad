"""Looming detectors: `Params`, `State`, `init`, `step` (eqs. 7-16)."""
