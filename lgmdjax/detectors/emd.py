"""Elementary motion detectors (EMD): correlation of neighbouring cells, as Hassenstein and Reichardt found in a beetle.

One array of detectors serves one eye. Each multiplies the signal of a cell with the delayed signal of its neighbour and
subtracts the mirror image, which gives the direction of motion. As a looming detector the array takes the mean motion
away from the middle of the frame.

| symbol     | name                   | unit   | equation                                           |
| ---------- | ---------------------- | ------ | -------------------------------------------------- |
| L_f        | frame                  | 0..1   | grey levels / 255                                  |
| dt         | frame_time             | s      | -                                                  |
| H_f        | state.signal           | 1      | tau_H / (dt + tau_H) (H_{f-1} + L_f - L_{f-1})     |
| D_f        | state.delayed          | 1      | D_{f-1} + dt / (dt + tau) (H_f - D_{f-1})          |
| tau_H, tau | adaptation_time, delay | s      | -                                                  |
| R          | motion.rightward       | 1      | D(x) H(x + 1) - H(x) D(x + 1)                      |
| U          | motion.upward          | 1      | D(y + 1) H(y) - H(y + 1) D(y); rows count downward |
| E          | response.excitation    | 1      | max(mean of sign(x) R + mean of sign(y) U, 0)      |
| u          | response.u             | 0.5..1 | 1 / (1 + exp(-gain E))                             |

x and y are the distance from the middle of the frame to the right and up. For a sine grating of amplitude A, wavelength
W cells and frequency w [rad/s], the mean of R is A^2 h(w) sin(2 pi / W) w tau / (1 + (w tau)^2), with h(w) the power
that the high-pass filter passes: it is largest near w = 1 / tau for every wavelength, and changes its sign for W < 2.

Source: Hassenstein & Reichardt 1956; Reichardt 1961; Borst & Egelhaaf 1989 for the form. tau = 50 ms and tau_H = 250 ms
are those of zhaojunyu01/EMD-LPLC2-GF-model (Zhao et al. 2023), without its separation of ON and OFF. Outward motion as
a template for looming is textbook knowledge; gain = 1000 is chosen here, so that u is well below 1 for most stimuli.

Gradient: exact; zero where the mean motion is inward.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import Cells, Scalar, high_pass, low_pass, pool, rectify, require_frame, require_size

GREY = 255.0


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector."""

    delay: Scalar = 0.05  # tau, s
    adaptation_time: Scalar = 0.25  # tau_H, s
    gain: Scalar = 1000.0
    frame_time: float = struct.field(pytree_node=False, default=1 / 30)  # dt, s
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell averages


@struct.dataclass(kw_only=True)
class State:
    """The last pooled frame, its signal and the delayed signal."""

    frame: Cells  # L
    signal: Cells  # H
    delayed: Cells  # D


@struct.dataclass(kw_only=True)
class Motion:
    """Motion between neighbouring cells; `rightward` has one column fewer than the cells, `upward` one row fewer."""

    rightward: Float[Array, "rows columns-1"]  # R
    upward: Float[Array, "rows-1 columns"]  # U


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    excitation: Float[Array, ""]  # E
    rightward: Float[Array, ""]  # mean of R
    upward: Float[Array, ""]  # mean of U


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    require_frame("emd", frame)
    pooled = pool(frame, params.pooling) / GREY
    return State(frame=pooled, signal=jnp.zeros_like(pooled), delayed=jnp.zeros_like(pooled))


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> dark, edge = jnp.zeros((4, 6)), jnp.zeros((4, 6)).at[:, :2].set(200.0)
    >>> state, _ = step(Params(), init(Params(), dark), edge)
    >>> _, response = step(Params(), state, edge.at[:, 2].set(200.0))
    >>> bool(response.rightward > 0), float(response.upward)
    (True, 0.0)

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    state = filter_frame(params, state, frame)
    motion = correlate(state)
    right, up = motion.rightward, motion.upward
    outward = jnp.mean(_side(right, 1) * right) - jnp.mean(_side(up, 0)[:, None] * up)
    E = rectify(outward)
    response = Response(u=jax.nn.sigmoid(params.gain * E), excitation=E, rightward=jnp.mean(right), upward=jnp.mean(up))
    return state, response


def filter_frame(params: Params, state: State, frame: Float[Array, "height width"]) -> State:
    """Return the signals of the next frame."""
    require_frame("emd", frame)
    pooled, dt = pool(frame, params.pooling) / GREY, params.frame_time
    require_size("emd", pooled, state.frame)
    H = high_pass(state.signal, pooled - state.frame, dt, params.adaptation_time)
    return State(frame=pooled, signal=H, delayed=low_pass(state.delayed, H, dt, params.delay))


def correlate(state: State) -> Motion:
    """Return the motion between neighbouring cells."""
    H, D = state.signal, state.delayed
    return Motion(
        rightward=D[:, :-1] * H[:, 1:] - H[:, :-1] * D[:, 1:],
        upward=D[1:] * H[:-1] - H[1:] * D[:-1],
    )


def _side(motion: Array, axis: int) -> Float[Array, "count"]:
    """Return -1 before the middle of an axis, 1 after it, and 0 at it."""
    count = motion.shape[axis]
    return jnp.asarray(np.sign(np.arange(count) - (count - 1) / 2), motion.dtype)
