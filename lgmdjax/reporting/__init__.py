"""Figures and videos of recorded walks."""
