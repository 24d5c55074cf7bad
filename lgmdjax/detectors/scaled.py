"""Any looming detector, for another camera than it was published for: cells of several pixels, and a contrast gain.

The thresholds of a detector are grey levels of its authors' pictures. Scaling the pictures by k is the same as dividing
all of them by k, for a detector whose constants nobody here knows too. `lgmdjax.learning.detector_calibration` chooses
k and the size of the cells.

| symbol | name     | unit | equation                                                     |
| ------ | -------- | ---- | ------------------------------------------------------------ |
| L      | frame    | grey | 0..255                                                       |
| n      | pooling  | px   | side of the square that a cell averages (`cells.pool`)       |
| k      | contrast | 1    | the detector gets k times the mean of each cell, above 255 too |

`model` is the detector, `detector` its parameters; state and response are its own. A detector that pools by itself
keeps its own pooling of 1.

Gradient: that of the detector; exact for k.
"""

import math

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PyTree

from lgmdjax.detectors import cells, lgmd
from lgmdjax.detectors.cells import Frame, Scalar
from lgmdjax.detectors.protocol import Detector
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Constants of the detector, and of what comes before it."""

    detector: PyTree = struct.field(default_factory=lgmd.Params)  # of the type that `model` takes
    contrast: Scalar = 1.0  # k
    pooling: int = struct.field(pytree_node=False, default=1)  # n, px
    model: Detector = struct.field(pytree_node=False, default=lgmd)


def init(params: Params, frame: Frame) -> PyTree:
    """Return the detector's state after a first frame."""
    return params.model.init(params.detector, scale(params, frame))


def step(params: Params, state: PyTree, frame: Frame) -> tuple[PyTree, PyTree]:
    """Process the next frame; return the detector's next state and its response.

    >>> params = Params(contrast=10.0, pooling=2)
    >>> state = init(params, jnp.zeros((12, 16)))
    >>> float(step(params, state, jnp.full((12, 16), 1.0))[1].excitation)
    10.0
    """
    return params.model.step(params.detector, state, scale(params, frame))


def scale(params: Params, frame: Frame) -> Float[Array, "rows columns"]:
    """Return what the detector gets: cells of n x n pixels, times k."""
    cells.require_frame("scaled", frame, takes_bytes=True)
    pooled = cells.pool(frame, params.pooling)
    return pooled * jnp.asarray(params.contrast, pooled.dtype)


def check(params: Params) -> None:
    """Raise `InputError` for a contrast that is not positive, or less than a pixel a cell, or as the detector does."""
    if not 0 < float(params.contrast) < math.inf:
        raise InputError(f"scaled contrast: expected a positive number, got {params.contrast}; 1 changes nothing")
    if params.pooling < 1:
        raise InputError(f"scaled pooling: expected 1 pixel or more a cell, got {params.pooling}; 1 changes nothing")
    getattr(params.model, "check", lambda _: None)(params.detector)
