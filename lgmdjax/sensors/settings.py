"""Settings of the stereo camera, and the limits of what its detectors see. Imports no JAX."""

from collections.abc import Mapping
from dataclasses import dataclass

from lgmdjax.errors import InputError

FIELD_LIMITS: Mapping[str, tuple[float, float]] = {
    "overlap": (0.5, 1.0),
    "ground": (0.0, 0.99),
    "falloff": (0.0, 100.0),
}
"""Smallest and largest values of the settings of an LGMD's field in `CameraSettings`."""


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """Image size per eye. A detector's cell is `pooling` x `pooling` pixels, about 6 degrees at every scale."""

    width: int
    """width of each eye's image [px]"""
    height: int
    """height of each eye's image [px]"""
    pooling: int = 1
    """width of a detector's cell [px]"""


@dataclass(frozen=True, kw_only=True)
class CameraSettings(Resolution):
    """Image size per eye, and the field of each side's LGMD. Raises InputError for a field outside its limits.

    A robot keeps the field that it was trained with at every resolution. With the default `overlap` the two LGMDs share
    no column of the images. What is straight ahead and far away is seen by both eyes and does not distinguish the sides
    (`lgmdjax.studies.overlap`).
    """

    overlap: float = 0.5
    """fraction of the width that each LGMD receives, from its own side: 0.5 to 1"""
    ground: float = 0.0
    """fraction of the height, at the bottom, that no LGMD receives; 0.5 is all below the horizon"""
    falloff: float = 0.0
    """how much less weight cells have at the side than ahead (`lgmdjax.detectors.lgmd`); 0 for equal weights"""

    def __post_init__(self) -> None:
        check_field(overlap=self.overlap, ground=self.ground, falloff=self.falloff)


def check_field(**field: float) -> None:
    """Raise `InputError` for an `overlap`, a `ground` or a `falloff` outside its limits.

    >>> check_field(overlap=0.2)
    Traceback (most recent call last):
    ...
    lgmdjax.errors.InputError: expected an overlap of the eyes of 0.5 to 1, got 0.2; change it
    """
    for name, value in field.items():
        low, high = FIELD_LIMITS[name]
        if not low <= value <= high:
            noun = "an overlap" if name == "overlap" else f"a {name}"
            raise InputError(f"expected {noun} of the eyes of {low:g} to {high:g}, got {value}; change it")
