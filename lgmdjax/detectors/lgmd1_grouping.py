"""LGMD1 with a grouping layer: clusters of excited cells, as at expanding edges, pass; isolated cells do not.

One detector serves one eye. As in `lgmdjax.detectors.lgmd`, each cell is excited by the change of its pixel and
inhibited by the last change around it. What is left is multiplied by its mean over 3 x 3 cells, so that edges are
raised above a threshold and isolated noise decays. Feed-forward inhibition suppresses the response to a change of the
whole image.

| symbol       | name                      | unit    | equation                                   |
| ------------ | ------------------------- | ------- | ------------------------------------------ |
| L_f          | frame                     | grey    | -                                          |
| p_1          | persistence               | 1       | -                                          |
| P_f = E_f    | layers.excitation         | grey    | P_f = L_f - L_{f-1} + p_1 P_{f-1}          |
| w_n, w_d     | nearest, diagonal         | 1       | 0.25, 0.125; 0 for the cell itself         |
| I_f          | layers.inhibition         | grey    | sum of w P_{f-1} over the eight neighbours |
| W_I          | inhibition                | 1       | -                                          |
| S_f          | layers.summation          | grey    | E_f - W_I I_f                              |
| Ce_f         | -                         | grey    | mean of S_f over 3 x 3 cells               |
| w            | -                         | grey    | D_c + max |Ce_f| / C_w                     |
| D_c, C_w     | group_offset, group_share | grey, 1 | -                                          |
| G_f          | layers.grouping           | grey    | S_f Ce_f / w; 0 where C_de G_f < T_de      |
| C_de, T_de   | decay, threshold          | 1, grey | -                                          |
| K_f / n_cell | response.excitation       | grey    | mean of |G_f|                              |
| F_f          | response.feed_forward     | grey    | mean of |P_{f-1}|                          |
| T_FFI        | suppression               | grey    | u is 0.5 where F_f >= T_FFI                |
| u            | response.u                | 0.5..1  | 1 / (1 + exp(-K_f / n_cell))               |

Source: Yue & Rind, "Collision detection in complex dynamic scenes using an LGMD-based visual neural network with
feature enhancement", IEEE Trans. Neural Networks 17(3), 2006. Constants are those of public programs: W_I, w_n, w_d and
T_FFI of fuqinbing/LGMD-Plus-and-GAs-Open-Source; D_c, C_w, C_de and T_de of fuqinbing/LGMD2-open-source; Gary2017/LGMD
has the same ones. There, a spike is u >= 0.78 and a collision five spikes in a row; here that is left to the caller.

Errata, and differences between the sources. The paper was not available; its column follows later work.

| point               | paper                       | public programs                      | here                     |
| ------------------- | --------------------------- | ------------------------------------ | ------------------------ |
| persistence         | n_p earlier changes         | none                                 | one change, by default 0 |
| signs of E and I    | signed: S Ce > 0 where      | |E| - W_I |I|, or only S >= T_s > 0, | signed; `magnitudes` for |
|                     | neighbours agree            | by which darkening never passes      | |E| - W_I |I|            |
| magnitudes          | -                           | S < 0 and Ce < 0 pass, as their      | the same                 |
|                     |                             | product is positive                  |                          |
| T_FFI, spike limit  | adapt over many frames      | constant                             | constant                 |
| scale of Ce         | its maximum in the frame: a | the same                             | the same                 |
|                     | frame of noise alone passes |                                      |                          |
| cells on the border | -                           | the last row or column is repeated   | the same                 |

Gradient: the thresholds are steps, so the gradients of T_de, C_de and T_FFI are zero and the others are exact almost
everywhere. With `smooth` both steps are sigmoids.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import (
    U_AT_REST,
    Cells,
    Scalar,
    gate,
    group,
    mean,
    neighbours,
    pool,
    require_frame,
    require_size,
)


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector."""

    persistence: Scalar = 0.0  # p_1
    inhibition: Scalar = 0.6  # W_I
    nearest: Scalar = 0.25  # w_n
    diagonal: Scalar = 0.125  # w_d
    group_share: Scalar = 4.0  # C_w
    group_offset: Scalar = 0.01  # D_c, grey
    decay: Scalar = 0.5  # C_de
    threshold: Scalar = 15.0  # T_de, grey
    suppression: Scalar = 10.0  # T_FFI, grey
    threshold_width: Scalar = 1.0  # grey, of the sigmoid at T_de
    suppression_width: Scalar = 1.0  # grey, of the sigmoid at T_FFI
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell averages
    smooth: bool = struct.field(pytree_node=False, default=False)  # sigmoids instead of steps
    magnitudes: bool = struct.field(pytree_node=False, default=False)  # S = |E| - W_I |I|


@struct.dataclass(kw_only=True)
class State:
    """The last pooled frame L_{f-1} and the last change P_{f-1}."""

    frame: Cells
    change: Cells


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    feed_forward: Float[Array, ""]  # F [grey]
    excitation: Float[Array, ""]  # K / n_cell [grey]; determines u unless F suppresses it


@struct.dataclass(kw_only=True)
class Layers:
    """Layers of cells for one frame, in grey levels."""

    excitation: Cells  # E
    inhibition: Cells  # I
    summation: Cells  # S
    grouping: Cells  # G, after the threshold


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    require_frame("lgmd1_grouping", frame)
    pooled = pool(frame, params.pooling)
    return State(frame=pooled, change=jnp.zeros_like(pooled))


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> params = Params()
    >>> state = init(params, jnp.zeros((6, 8)))
    >>> state, response = step(params, state, jnp.full((6, 8), 50.0))
    >>> round(float(response.excitation), 1)  # S Ce / w of a change of 50 everywhere
    199.8

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    now = layers(params, state, frame)
    K, F = mean(jnp.abs(now.grouping)), mean(jnp.abs(state.change))
    passed = 1.0 - gate(F - params.suppression, params.suppression_width if params.smooth else None)
    u = U_AT_REST + passed * (jax.nn.sigmoid(K) - U_AT_REST)
    next_state = State(frame=pool(frame, params.pooling), change=now.excitation)
    return next_state, Response(u=u, feed_forward=F, excitation=K)


def layers(params: Params, state: State, frame: Float[Array, "height width"]) -> Layers:
    """Return the layers of cells for the next frame."""
    require_frame("lgmd1_grouping", frame)
    pooled = pool(frame, params.pooling)
    require_size("lgmd1_grouping", pooled, state.frame)
    E = pooled - state.frame + params.persistence * state.change
    around = neighbours(state.change)
    I = params.nearest * around.nearest + params.diagonal * around.diagonal  # noqa: E741
    S = jnp.abs(E) - params.inhibition * jnp.abs(I) if params.magnitudes else E - params.inhibition * I
    G = group(S, params.group_share, params.group_offset)
    G = G * gate(params.decay * G - params.threshold, params.threshold_width if params.smooth else None)
    return Layers(excitation=E, inhibition=I, summation=S, grouping=G)
