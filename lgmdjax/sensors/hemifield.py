"""The part of the picture that each eye's detector looks at."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgmdjax.errors import InputError

LEFT, RIGHT = 0, 1


def columns(width: int, overlap: float) -> int:
    """Count the columns of a picture that one eye looks at: so many that the two eyes leave none out between them."""
    return math.ceil(overlap * width - 1e-9)  # less than a rounding error is no column


def hemifield(picture: Array | np.ndarray, side: int, overlap: float) -> Array | np.ndarray:
    """Cut out what one eye looks at: the left eye the first columns, the right eye the last ones.

    Args:
        picture: the eye's whole picture; leading axes are kept.
        side: `LEFT` or `RIGHT`.
        overlap: fraction of the width that an eye keeps; 0.5 is no overlap, 1 the whole picture.
    """
    if not 0.5 <= overlap <= 1:
        raise InputError(f"lgmd overlap: expected a fraction of the width in 0.5..1, got {overlap}; 0.5 is no overlap")
    if side not in (LEFT, RIGHT):
        raise InputError(f"lgmd side: expected 0 (left) or 1 (right), got {side}; see hemifield.LEFT, hemifield.RIGHT")
    width = jnp.shape(picture)[-1]
    kept = columns(width, overlap)
    return picture[..., :kept] if side == LEFT else picture[..., width - kept :]
