"""Hemifields: the part of each eye's image that the LGMD of that side receives."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped

from lgmdjax.errors import InputError
from lgmdjax.sensors.settings import check_field

LEFT, RIGHT = 0, 1
SIDES = ("left", "right")  # their names


def column_count(width: int, overlap: float) -> int:
    """Return the number of columns of a hemifield, rounded up so that the two hemifields together leave none out.

    >>> column_count(80, 0.5), column_count(81, 0.5)
    (40, 41)
    """
    return math.ceil(overlap * width - 1e-9)  # a rounding error adds no column


def row_count(height: int, ground: float = 0.0) -> int:
    """Return the number of rows of a hemifield, from the top; those at the bottom are the `ground`.

    >>> row_count(60), row_count(60, ground=0.5)
    (60, 30)
    """
    return max(math.ceil((1 - ground) * height - 1e-9), 1)


def crop(image: Array | np.ndarray, side: int, *, overlap: float, ground: float = 0.0) -> Array | np.ndarray:
    """Return the hemifield of an eye: the first columns for the left eye, the last ones for the right eye.

    >>> picture = np.arange(16).reshape(2, 8)
    >>> crop(picture, RIGHT, overlap=0.5).tolist()
    [[4, 5, 6, 7], [12, 13, 14, 15]]
    >>> crop(picture, RIGHT, overlap=0.5, ground=0.5).tolist()
    [[4, 5, 6, 7]]

    Args:
        image: the whole image of that eye, (..., height, width).
        side: `LEFT` or `RIGHT`.
        overlap: fraction of the width to keep; 0.5 is no overlap, 1 the whole image.
        ground: fraction of the height, at the bottom, that is left out.
    """
    check_field(overlap=overlap, ground=ground)
    if side not in (LEFT, RIGHT):
        raise InputError(f"lgmd side: expected 0 (left) or 1 (right), got {side}; see hemifield.LEFT, hemifield.RIGHT")
    height, width = jnp.shape(image)[-2:]
    columns = column_count(width, overlap)
    seen = image[..., : row_count(height, ground), :]
    return seen[..., :columns] if side == LEFT else seen[..., width - columns :]


def edges(fov: float, overlap: float) -> tuple[float, float]:
    """Return the bearings [rad] of the outer and of the inner edge of a hemifield, positive on the eye's own side.

    >>> edges(2.0, overlap=0.5)
    (1.0, 0.0)
    """
    return 0.5 * fov, fov * (0.5 - overlap)


def outermost_first(frames: Shaped[Array, "2 height columns"]) -> Shaped[Array, "2 height columns"]:
    """Mirror the image of the right eye: in both images the first column is then that of the largest bearing."""
    return jnp.stack([frames[LEFT], frames[RIGHT, :, ::-1]])
