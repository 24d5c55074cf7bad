"""Any looming detector, for another camera than it was published for: other cells, a contrast gain and a response gain.

The thresholds of a detector are grey levels of its authors' pictures, and its squashing function is for its authors'
excitations. Scaling the pictures by k is the same as dividing all thresholds by k, for any detector, whatever its
constants are called; scaling the excitation by g fills the range of u. `lgmdjax.learning.detector_calibration` chooses
k, g and the size of the cells.

| symbol | name       | unit   | equation                                                         |
| ------ | ---------- | ------ | ---------------------------------------------------------------- |
| L      | frame      | grey   | 0..255                                                           |
| n      | pooling    | px     | side of the square that a cell averages (`cells.pool`)           |
| k      | contrast   | 1      | the detector gets k times the mean of each cell, also beyond 255 |
| v      | -          | 0.5..1 | the detector's own u                                             |
| g      | gain       | 1      | -                                                                |
| u      | response.u | 0.5..1 | 1 / (1 + ((1 - v) / v)^g): v = 1 / (1 + exp(-x)) for g x         |

`model` is the detector, `detector` its parameters; the state is its own.

Gradient: that of the detector; exact for k and g, zero where v is 1 in the present precision.
"""

import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PyTree

from lgmdjax.detectors import cells, lgmd
from lgmdjax.detectors.cells import Frame, Scalar
from lgmdjax.detectors.protocol import Detector
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.minmax import clip


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Constants of the detector, and of what comes before and after it."""

    detector: PyTree = struct.field(default_factory=lgmd.Params)  # of the type that `model` takes
    contrast: Scalar = 1.0  # k
    gain: Scalar = 1.0  # g
    pooling: int = struct.field(pytree_node=False, default=1)  # n, px
    model: Detector = struct.field(pytree_node=False, default=lgmd)


@struct.dataclass(kw_only=True)
class Response:
    """Response to one frame; all but u as the detector gave it."""

    u: Float[Array, ""]
    feed_forward: Float[Array, ""]  # zero for a detector without
    excitation: Float[Array, ""]


def init(params: Params, frame: Frame) -> PyTree:
    """Return the detector's state after a first frame."""
    return params.model.init(params.detector, scale(params, frame))


def step(params: Params, state: PyTree, frame: Frame) -> tuple[PyTree, Response]:
    """Process the next frame; return the detector's next state, and the response.

    >>> params = Params(contrast=10.0, pooling=2)
    >>> state = init(params, jnp.zeros((12, 16)))
    >>> float(step(params, state, jnp.full((12, 16), 1.0))[1].excitation)
    10.0
    """
    state, own = params.model.step(params.detector, state, scale(params, frame))
    feed_forward = getattr(own, "feed_forward", jnp.zeros_like(own.u))
    return state, Response(u=expand(own.u, params.gain), feed_forward=feed_forward, excitation=own.excitation)


def scale(params: Params, frame: Frame) -> Float[Array, "rows columns"]:
    """Return what the detector gets: cells of n x n pixels, times k."""
    cells.require_frame("scaled", frame, takes_bytes=True)
    pooled = cells.pool(frame, params.pooling)
    return pooled * jnp.asarray(params.contrast, pooled.dtype)


def expand(v: Float[Array, "*shape"], gain: Float[Array, "*shape"] | float) -> Float[Array, "*shape"]:
    """Return the squashed value of g x for that of x.

    >>> expand(jnp.asarray([0.5, 0.9]), 0.5).round(2).tolist()
    [0.5, 0.75]
    """
    return jax.nn.sigmoid(jnp.asarray(gain, v.dtype) * logit(v))


def logit(v: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return x of v = 1 / (1 + exp(-x)), finite also for v that is rounded to 1."""
    margin = float(jnp.finfo(v.dtype).eps)
    within = clip(v, margin, 1.0 - margin)
    return jnp.log(within) - jnp.log1p(-within)


def check(params: Params) -> None:
    """Raise `InputError` for gains that are not positive, or less than a pixel a cell, or as the detector does."""
    for name in ("contrast", "gain"):
        if not 0 < float(getattr(params, name)) < math.inf:
            raise InputError(
                f"scaled {name}: expected a positive number, got {getattr(params, name)}; 1 changes nothing"
            )
    if params.pooling < 1:
        raise InputError(f"scaled pooling: expected 1 pixel or more a cell, got {params.pooling}; 1 changes nothing")
    getattr(params.model, "check", lambda _: None)(params.detector)
