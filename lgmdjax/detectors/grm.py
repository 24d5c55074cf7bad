"""Generalised regressive motion (GRM): motion from back to front, which nothing that stands still can cause.

One detector serves one eye that looks ahead. An animal that walks forward sees everything that stands still move from
front to back. A part of the image that moves from back to front belongs to something that moves itself, or to the front
edge of something that grows beside the animal; both may collide with it. What stands straight ahead and grows moves
from front to back and is not detected.

| symbol | name                | unit   | equation                                          |
| ------ | ------------------- | ------ | ------------------------------------------------- |
| R      | -                   | 1      | motion to the right, `lgmdjax.detectors.emd`      |
| g_l    | response.left       | 1      | mean of max(R, 0) over the left half of the frame |
| g_r    | response.right      | 1      | mean of max(-R, 0) over the right half            |
| E      | response.excitation | 1      | g_l + g_r; of a hemifield the mean of max(R, 0)   |
| u      | response.u          | 0.5..1 | 1 / (1 + exp(-gain E))                            |

Source: Chalupka, Dickinson & Perona, "Generalized regressive motion: a visual cue to collision", Bioinspiration &
Biomimetics 11, 2016, after Zabala et al. 2012, for the cue; only the abstracts were available. Chosen here: the motion
comes from correlators, is rectified cell by cell and averaged over a hemifield; gain = 1000, as in emd. The middle
column of detectors belongs to neither half. With `hemifield` the frame is that of the robot's eyes: one half of the
view, the outermost column first, so that motion to the right is regressive everywhere.

Gradient: exact almost everywhere.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors import emd
from lgmdjax.detectors.cells import Scalar, rectify

State = emd.State


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector; the gain of `motion` is not used."""

    motion: emd.Params = struct.field(default_factory=emd.Params)
    gain: Scalar = 1000.0
    hemifield: bool = struct.field(pytree_node=False, default=False)  # the frame is the left half of the view


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    excitation: Float[Array, ""]  # E
    left: Float[Array, ""]  # g_l
    right: Float[Array, ""]  # g_r


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    return emd.init(params.motion, frame)


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> dark, edge = jnp.zeros((4, 9)), jnp.zeros((4, 9)).at[:, :2].set(200.0)
    >>> state, _ = step(Params(), init(Params(), dark), edge)
    >>> _, response = step(Params(), state, edge.at[:, 2].set(200.0))
    >>> bool(response.left > 0), float(response.right)
    (True, 0.0)

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    state = emd.filter_frame(params.motion, state, frame)
    R = emd.correlate(state).rightward
    if params.hemifield:
        left, right = jnp.mean(rectify(R)), jnp.zeros((), R.dtype)
    else:
        half = R.shape[1] // 2
        left, right = jnp.mean(rectify(R[:, :half])), jnp.mean(rectify(-R[:, R.shape[1] - half :]))
    E = left + right
    return state, Response(u=jax.nn.sigmoid(params.gain * E), excitation=E, left=left, right=right)
