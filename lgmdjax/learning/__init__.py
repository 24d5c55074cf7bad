"""Fits: of the navigator, the detector, and of any controller parameter through the rollout."""
