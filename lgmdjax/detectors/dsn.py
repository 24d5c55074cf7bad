"""DSN: four networks that each ignore motion in one direction, fused so that all four must respond.

One detector serves one eye. Each cell is excited by the change of its pixel. In each of four networks it is inhibited
by the earlier changes of the cells on one side of it, so an edge that comes from that side is cancelled by the
inhibition that runs ahead of it. A growing object has edges in all directions, so every network responds to some of
them. An object that passes is missed by one of the four.

| symbol      | name                       | unit    | equation                                                        |
| ----------- | -------------------------- | ------- | --------------------------------------------------------------- |
| L_f         | frame                      | grey    | -                                                               |
| P_f         | layers.excitation          | grey    | |L_f - L_{f-1}|                                                 |
| n_I, d      | reach, delay               | cells,  | how far inhibition spreads, and its delay                       |
|             |                            | frames  |                                                                 |
| w_i         | decay                      | 1       | decay^(i - 1), over the sum of all n_I                          |
| I_f^D(x)    | layers.inhibition          | grey    | sum over i = 1..n_I of w_i P_{f-d}(x - i e_D)                   |
| e_D         | -                          | -       | unit step of direction D: left, right, up, down                 |
| W_I, T_s    | inhibition, threshold      | 1, grey | -                                                               |
| S_f^D       | layers.summation           | grey    | P_f - W_I I_f^D; 0 where it is below T_s                        |
| K_f^D       | response.networks          | grey    | mean of S_f^D                                                   |
| F_f, T_FFI  | feed_forward, suppression  | grey    | mean of P_{f-1}; u is 0.5 where F_f >= T_FFI                    |
| E_f         | response.excitation        | grey    | geometric mean of the four K_f^D: 0 if one of them is silent    |
| u           | response.u                 | 0.5..1  | 1 / (1 + exp(-E_f))                                             |

Network D is the one that does not see motion in direction D. Beyond the border nothing changes.

Sources: Yue & Rind, "A synthetic vision system using directionally selective motion detectors to recognize collision",
Artificial Life 13(2), 2007; "Postsynaptic organisations of directional selective visual neural networks for collision
detection", Neurocomputing 103, 2013. Only the abstract of the second was available, and later descriptions of the
first: inhibition spreads in one direction, one or several frames late, and the fusion was evolved. Equations of the
networks and T_s = 12 are those of the public program of later work by the same group
(fuqinbing/Binocular-DSN-Neural-Network-Model).

| point      | papers, as far as known   | that program                     | here                                 |
| ---------- | ------------------------- | -------------------------------- | ------------------------------------ |
| excitation | change                    | |change| of foreground and frame | |change|, which is rectified         |
| reach      | several cells             | 1 cell, weight 5.5 x 1.5         | 4 cells, W_I = 3, so most of an edge |
|            |                           |                                  | of up to 3 cells a frame is removed  |
| border     | -                         | the outermost cells inhibit none | they do                              |
| cells      | pixels                    | pools P and I before S           | pools the frame: `pooling`           |
| fusion     | weights and thresholds of | of all four and of disparity     | geometric mean: silent if one is     |
|            | spikes, evolved           |                                  |                                      |
| T_FFI      | -                         | none                             | 25, far above motion                 |

Gradient: T_s and T_FFI are steps, with zero gradient; others are exact almost everywhere, and zero where a network is
silent. With `smooth` both steps are sigmoids.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import U_AT_REST, Cells, Scalar, gate, mean, pool, rectify, require_frame, require_size
from lgmdjax.errors import InputError

DIRECTIONS = ((0, -1), (0, 1), (-1, 0), (1, 0))  # steps in rows and columns: left, right, up, down
SMALLEST = 1e-12  # grey, added to K inside a logarithm


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector."""

    inhibition: Scalar = 3.0  # W_I
    decay: Scalar = 0.8  # of the weight from cell to cell
    threshold: Scalar = 12.0  # T_s, grey
    suppression: Scalar = 25.0  # T_FFI, grey
    threshold_width: Scalar = 1.0  # grey, of the sigmoid at T_s
    suppression_width: Scalar = 1.0  # grey, of the sigmoid at T_FFI
    reach: int = struct.field(pytree_node=False, default=4)  # n_I, cells
    delay: int = struct.field(pytree_node=False, default=1)  # d, frames
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell averages
    smooth: bool = struct.field(pytree_node=False, default=False)  # sigmoids instead of steps


@struct.dataclass(kw_only=True)
class State:
    """The last pooled frame, and the changes of the last d frames, the oldest first."""

    frame: Cells
    changes: Float[Array, "delay rows columns"]  # P


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    excitation: Float[Array, ""]  # E; determines u unless F suppresses it
    feed_forward: Float[Array, ""]  # F [grey]
    networks: Float[Array, "4"]  # K of the networks that do not see motion to the left, right, up, down [grey]


class Layers(NamedTuple):
    """Layers of cells of the four networks for one frame, in grey levels."""

    excitation: Cells  # P
    inhibition: Float[Array, "4 rows columns"]  # I
    summation: Float[Array, "4 rows columns"]  # S, after the threshold


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change; raise `InputError` for a reach or delay below 1."""
    require_frame("dsn", frame)
    if params.reach < 1 or params.delay < 1:
        raise InputError(
            f"dsn: expected a reach of 1 cell and a delay of 1 frame or more, got {params.reach} and {params.delay}; "
            "4 and 1 are usual"
        )
    pooled = pool(frame, params.pooling)
    return State(frame=pooled, changes=jnp.zeros((params.delay, *pooled.shape), pooled.dtype))


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> dark = jnp.zeros((6, 8))
    >>> _, response = step(Params(), init(Params(), dark), dark.at[2:4, 3:5].set(240.0))
    >>> response.networks.tolist()  # nothing was there to inhibit
    [20.0, 20.0, 20.0, 20.0]

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    now = layers(params, state, frame)
    K = jax.vmap(mean)(now.summation)
    all_answer = jnp.where(jnp.min(K) > 0, jnp.ones((), K.dtype), jnp.zeros((), K.dtype))
    E = all_answer * jnp.exp(jnp.mean(jnp.log(K + SMALLEST)))
    F = mean(state.changes[-1])
    passed = 1.0 - gate(F - params.suppression, params.suppression_width if params.smooth else None)
    changes = jnp.concatenate([state.changes[1:], now.excitation[None]])
    response = Response(
        u=U_AT_REST + passed * (jax.nn.sigmoid(E) - U_AT_REST), excitation=E, feed_forward=F, networks=K
    )
    return State(frame=pool(frame, params.pooling), changes=changes), response


def layers(params: Params, state: State, frame: Float[Array, "height width"]) -> Layers:
    """Return the layers of cells for the next frame."""
    require_frame("dsn", frame)
    pooled = pool(frame, params.pooling)
    require_size("dsn", pooled, state.frame)
    P = jnp.abs(pooled - state.frame)
    I = jnp.stack([_spread(params, state.changes[0], direction) for direction in DIRECTIONS])  # noqa: E741
    S = rectify(P - params.inhibition * I)
    S = S * gate(S - params.threshold, params.threshold_width if params.smooth else None)
    return Layers(excitation=P, inhibition=I, summation=S)


def _spread(params: Params, change: Cells, direction: tuple[int, int]) -> Cells:
    """Return the weighted sum of the changes behind each cell, opposite to the direction; zero beyond the border."""
    rows, columns = change.shape
    n = params.reach
    padded = jnp.pad(change, n)
    weights = jnp.asarray(params.decay, change.dtype) ** jnp.arange(n, dtype=change.dtype)
    weights = weights / jnp.sum(weights)
    shifted = [
        padded[
            n - i * direction[0] : n - i * direction[0] + rows, n - i * direction[1] : n - i * direction[1] + columns
        ]
        for i in range(1, n + 1)
    ]
    return jnp.tensordot(weights, jnp.stack(shifted), 1, precision=jax.lax.Precision.HIGHEST)
