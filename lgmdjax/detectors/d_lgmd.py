"""D-LGMD: excitation and inhibition spread over a neighbourhood, and inhibition from farther cells arrives later.

One detector serves one eye. A change excites the cells around it at once and inhibits a wider neighbourhood: near cells
at once, farther cells one or two frames later. An edge that moves faster than the inhibition spreads escapes it. The
ratio of the two widths and the latency therefore set the angular velocity to which the detector responds. Clusters of
active cells are amplified, and a threshold that grows with the change of the whole image removes the rest.

| symbol        | name                               | unit    | equation                                          |
| ------------- | ---------------------------------- | ------- | ------------------------------------------------- |
| P_f           | changes                            | 0..1    | |L_f - L_{f-1}| / 255                             |
| r             | -                                  | cells   | distance from the middle, RADIUS cells either way |
| g(r, s)       | -                                  | 1       | exp(-r^2 / (2 s^2)) / (s sqrt(2 pi))              |
| s_E, s_I      | excitation_sigma, inhibition_sigma | cells   | -                                                 |
| a             | inhibition                         | 1       | -                                                 |
| tau(r)        | -                                  | frames  | alpha + 1 / (beta + exp(-lambda^2 r^2))           |
| alpha, beta   | latency_offset, latency_shape      | 1       | -                                                 |
| lambda        | latency_spread                     | 1/cells | -                                                 |
| q_0, q_1, q_2 | -                                  | 1       | share of the latencies 0, 1 and 2 in tau          |
| W_0           | kernels().now                      | 1       | max(g(r, s_E) - q_0 a g(r, s_I), 0)               |
| W_1, W_2      | .one_later, .two_later             | 1       | q_1 a g(r, s_I), q_2 a g(r, s_I)                  |
| S_f           | layers.summation                   | 1       | max(W_0 * P_f - W_1 * P_{f-1} - W_2 * P_{f-2}, 0) |
| Ce            | -                                  | 1       | mean of S over 4 x 4 cells                        |
| F_f           | response.feed_forward              | 1       | mean of P_{f-2}                                   |
| T_G           | -                                  | 1       | min(T_0 F_f, T_max)                               |
| T_0, T_max    | threshold, max_threshold           | 1       | -                                                 |
| G_f           | layers.grouping                    | 0..1    | min(S Ce, 1); 0 where S Ce < T_G                  |
| K_f / n_cell  | response.excitation                | 0..1    | mean of G_f                                       |
| u_f           | response.u                         | 0.5..1  | 1 / (1 + exp(-gain K_f / n_cell))                 |

Source: Zhao, Wang, Bellotto, Hu, Peng & Yue, "Enhancing LGMD's looming selectivity for UAV with spatial-temporal
distributed presynaptic connections", IEEE Trans. Neural Networks and Learning Systems 34(5), 2023 (online 2021).
Equations and constants are those of cquzjn/D-LGMD, the program of its first author; the paper itself was not
available. alpha, beta and lambda (-0.1, 0.5, 0.7) are values in the program's comments; its code uses -0.6, 0.4, 0.6.
Surprising points of the program, and choices made here:

| point   | program                                                | here                                        |
| ------- | ------------------------------------------------------ | ------------------------------------------- |
| g       | in two dimensions, but normalised as in one, so that   | the same                                    |
|         | inhibition sums to a s_I / s_E times excitation        |                                             |
| latency | 0 where tau < 1, else 1; 2 where tau >= 1.9, which     | whole frames below tau; with `interpolated` |
|         | tau comes near to but does not reach                   | shared between the two nearest, so that     |
|         |                                                        | gradients reach alpha, beta and lambda      |
| Ce      | 4 x 4 cells, half a cell off the middle                | the same, so not symmetric under mirroring  |
| T_G     | grows with the sum of P, thus with the number of cells | with the mean; T_0 = 0.5 is chosen here,    |
|         |                                                        | T_max = 0.3 is the program's                |
| u       | output scaled to 0..1 over each clip                   | gain = 255 is chosen here                   |
| border  | zero                                                   | the same                                    |

Widths and latencies are in cells, so the detector is tuned to an angular velocity that depends on the resolution. Peak
of K / n_cell for an approach with l/|v| = 0.1 s, over that for the same square that translates at 1 rad/s (170 deg,
30 frames/s):

| columns | whole frames | `interpolated` |
| ------- | ------------ | -------------- |
| 32      | 0.0012       | 3.1            |
| 80      | 5.7          | 91             |
| 160     | 49           | 70             |

Gradient: zero for T_0 and T_max, as T_G is a step, and without `interpolated` for alpha, beta and lambda; exact almost
everywhere for the others. With `smooth` the step is a sigmoid.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import Cells, Scalar, correlate, gate, mean, pool, rectify, require_frame, require_size
from lgmdjax.minmax import maximum, minimum

RADIUS = 6  # cells, half the width of the kernels
GREY = 255.0
GROUP = 4  # cells, width of the neighbourhood of Ce

Kernel = Float[Array, "side side"]


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector."""

    excitation_sigma: Scalar = 1.0  # s_E, cells
    inhibition_sigma: Scalar = 5.0  # s_I, cells
    inhibition: Scalar = 1.5  # a
    latency_offset: Scalar = -0.1  # alpha, frames
    latency_shape: Scalar = 0.5  # beta, 1/frames
    latency_spread: Scalar = 0.7  # lambda, 1/cells
    threshold: Scalar = 0.5  # T_0
    max_threshold: Scalar = 0.3  # T_max
    gain: Scalar = 255.0
    threshold_width: Scalar = 0.01  # of the sigmoid at T_G
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell averages
    interpolated: bool = struct.field(pytree_node=False, default=False)  # latencies between whole frames
    smooth: bool = struct.field(pytree_node=False, default=False)  # a sigmoid instead of the step


@struct.dataclass(kw_only=True)
class State:
    """The last pooled frame L_{f-1}, and the magnitudes P_{f-1} and P_{f-2} of the last changes."""

    frame: Cells
    changes: Float[Array, "2 rows columns"]


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    feed_forward: Float[Array, ""]  # F
    excitation: Float[Array, ""]  # K / n_cell


@struct.dataclass(kw_only=True)
class Layers:
    """Layers of cells for one frame."""

    change: Cells  # P
    summation: Cells  # S
    grouping: Cells  # G


class Kernels(NamedTuple):
    """Weights of the present change and of the last two."""

    now: Kernel  # W_0
    one_later: Kernel  # W_1
    two_later: Kernel  # W_2


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    require_frame("d_lgmd", frame)
    pooled = pool(frame, params.pooling)
    return State(frame=pooled, changes=jnp.zeros((2, *pooled.shape), pooled.dtype))


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> state = init(Params(), jnp.zeros((6, 8)))
    >>> state, response = step(Params(), state, jnp.full((6, 8), 50.0))
    >>> bool(response.excitation > 0), float(response.feed_forward)
    (True, 0.0)

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    now = layers(params, state, frame)
    K = mean(now.grouping)
    response = Response(u=jax.nn.sigmoid(params.gain * K), feed_forward=mean(state.changes[1]), excitation=K)
    return State(frame=pool(frame, params.pooling), changes=jnp.stack([now.change, state.changes[0]])), response


def layers(params: Params, state: State, frame: Float[Array, "height width"]) -> Layers:
    """Return the layers of cells for the next frame."""
    require_frame("d_lgmd", frame)
    pooled = pool(frame, params.pooling)
    require_size("d_lgmd", pooled, state.frame)
    P = jnp.abs(pooled - state.frame) / GREY
    W = kernels(params)
    changes = jnp.concatenate([P[None], state.changes])
    weights = jnp.stack([W.now, -W.one_later, -W.two_later]).astype(P.dtype)
    S = rectify(jnp.sum(correlate(changes, weights, RADIUS, RADIUS), axis=0))
    # As MATLAB's conv2(..., "same"): one cell up and left, two cells down and right.
    Ce = correlate(S[None], jnp.full((1, GROUP, GROUP), GROUP**-2, P.dtype), GROUP // 2 - 1, GROUP // 2)[0]
    T_G = minimum(params.threshold * mean(state.changes[1]), params.max_threshold)
    G = S * Ce
    G = minimum(G, 1.0) * gate(G - T_G, params.threshold_width if params.smooth else None)
    return Layers(change=P, summation=S, grouping=G)


def kernels(params: Params) -> Kernels:
    """Return the weights of excitation and inhibition by the distance from the cell that is excited or inhibited."""
    row, column = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
    squared = jnp.asarray(row**2 + column**2, float)
    tau = params.latency_offset + 1.0 / (params.latency_shape + jnp.exp(-(params.latency_spread**2) * squared))
    q = _shares(tau, params.interpolated)
    E = _gaussian(squared, params.excitation_sigma)
    I = params.inhibition * _gaussian(squared, params.inhibition_sigma)  # noqa: E741
    return Kernels(now=maximum(E - q[0] * I, 0.0), one_later=q[1] * I, two_later=q[2] * I)


def _gaussian(squared: Kernel, sigma: Scalar) -> Kernel:
    return jnp.exp(-squared / (2.0 * sigma**2)) / (sigma * jnp.sqrt(2.0 * jnp.pi))


def _shares(tau: Kernel, interpolated: bool) -> Float[Array, "3 side side"]:
    """Return the shares of the latencies 0, 1 and 2."""
    if interpolated:
        return jnp.stack([rectify(1.0 - jnp.abs(minimum(maximum(tau, 0.0), 2.0) - frames)) for frames in range(3)])
    return jnp.stack([tau < 1.0, (tau >= 1.0) & (tau < 2.0), tau >= 2.0]).astype(tau.dtype)
