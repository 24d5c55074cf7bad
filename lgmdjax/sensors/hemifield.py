"""Hemifields: the part of each eye's image that the LGMD of that side receives."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgmdjax.errors import InputError

LEFT, RIGHT = 0, 1


def column_count(width: int, overlap: float) -> int:
    """Return the number of columns of a hemifield, rounded up so that the two hemifields together leave none out.

    >>> column_count(80, 0.5), column_count(81, 0.5)
    (40, 41)
    """
    return math.ceil(overlap * width - 1e-9)  # a rounding error adds no column


def crop(image: Array | np.ndarray, side: int, overlap: float) -> Array | np.ndarray:
    """Return the hemifield of an eye: the first columns for the left eye, the last columns for the right eye.

    >>> crop(np.arange(8), RIGHT, overlap=0.5)
    array([4, 5, 6, 7])

    Args:
        image: the whole image of that eye, (..., height, width).
        side: `LEFT` or `RIGHT`.
        overlap: fraction of the width to keep; 0.5 is no overlap, 1 the whole image.
    """
    if not 0.5 <= overlap <= 1:
        raise InputError(f"lgmd overlap: expected a fraction of the width in 0.5..1, got {overlap}; 0.5 is no overlap")
    if side not in (LEFT, RIGHT):
        raise InputError(f"lgmd side: expected 0 (left) or 1 (right), got {side}; see hemifield.LEFT, hemifield.RIGHT")
    width = jnp.shape(image)[-1]
    columns = column_count(width, overlap)
    return image[..., :columns] if side == LEFT else image[..., width - columns :]
