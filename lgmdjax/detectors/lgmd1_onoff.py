"""LGMD1 with ON and OFF channels and spike-frequency adaptation: selective for approach, not recession or translation.

One detector serves one eye. Brightening and darkening run in separate channels. In the ON channel a cell excites at
once and its neighbours inhibit it later; in the OFF channel it inhibits at once and its neighbours excite it later. The
response to motion that does not accelerate adapts.

| symbol        | name                          | unit    | equation                                                   |
| ------------- | ----------------------------- | ------- | ---------------------------------------------------------- |
| P, ON, OFF, a | -                             | grey, 1 | `lgmdjax.detectors.on_off`                                 |
| F_f           | response.feed_forward         | grey    | a_F mean |P_f| + (1 - a_F) F_{f-1}                         |
| tau_n, tau_d  | delay_nearest, delay_diagonal | s       | of the four nearest and of the four diagonal neighbours    |
| w_n, w_d      | nearest, diagonal             | 1       | 0.25, 0.125; 0 for the cell itself                         |
| N(X)          | -                             | grey    | sum of w X over the neighbours, delayed by tau_n, tau_d    |
| S_on, S_off   | -                             | grey    | ON - W_on N(ON), N(OFF) - W_off OFF                        |
| W_on, W_off   | on_inhibition, off_inhibition | 1       | -                                                          |
| S_f           | layers.summation              | grey    | t_on S_on + t_off S_off + t_both S_on S_off, 0 where < T_s |
| T_s           | threshold                     | grey    | -                                                          |
| G_f           | layers.grouping               | grey    | mean of S_f over 3 x 3 cells                               |
| K_f / n_cell  | response.excitation           | grey    | mean of G_f                                                |
| k_f           | response.potential            | 0.5..1  | 1 / (1 + exp(-K_f / (n_cell C_sig)))                       |
| u_f           | response.u                    | 0.5..1  | k_f, adapted                                               |
| T_FFI         | suppression                   | grey    | k_f = u_f = 0.5 where F_f >= T_FFI                         |

Source: Fu, Hu, Peng & Yue, "Shaping the collision selectivity in a looming sensitive neuron model with parallel ON and
OFF pathways and spike frequency adaptation", Neural Networks 106, 2018. Equations and constants are those of LGMDs.cs
of fuqinbing/LGMD2-open-source, which its first author calls the general model; they were not compared with the paper.
There, exp(4 (u - 0.78)), rounded down, are spikes, and eight spikes without a pause a collision; here that is left
to the caller. Other constants in use:

| constant    | LGMDs.cs (here) | Fu2018.cs of Gary2017/LGMD             |
| ----------- | --------------- | -------------------------------------- |
| W_on, W_off | 0.5, 1          | 0.3, 0.6                               |
| t_both      | 0               | 0.1                                    |
| T_FFI       | 8               | 15                                     |
| G           | -               | 0 where G < 10                         |
| tau_hp      | 0.5 s           | 0.8 s, 0.4 s where the potential falls |

Gradient: thresholds are steps, so the gradients of T_s, T_FFI and T_sfa are zero and the others are exact almost
everywhere. With `smooth` the steps at T_s and T_FFI are sigmoids.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors import on_off
from lgmdjax.detectors.cells import (
    U_AT_REST,
    Cells,
    Scalar,
    gate,
    local_mean,
    low_pass,
    mean,
    neighbours,
    pool,
    require_frame,
    require_size,
)
from lgmdjax.detectors.on_off import Adaptation, Channels


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector."""

    residual: Scalar = 0.1  # r
    nearest: Scalar = 0.25  # w_n
    diagonal: Scalar = 0.125  # w_d
    delay_nearest: Scalar = 0.03  # tau_n, s
    delay_diagonal: Scalar = 0.06  # tau_d, s
    on_inhibition: Scalar = 0.5  # W_on
    off_inhibition: Scalar = 1.0  # W_off
    on_weight: Scalar = 1.0  # t_on
    off_weight: Scalar = 1.0  # t_off
    joint_weight: Scalar = 0.0  # t_both, 1/grey
    threshold: Scalar = 30.0  # T_s, grey
    scale: Scalar = 1.0  # C_sig, grey
    suppression: Scalar = 8.0  # T_FFI, grey
    suppression_delay: Scalar = 0.09  # s, of F
    adaptation_time: Scalar = 0.5  # tau_hp, s
    adaptation_threshold: Scalar = 0.005  # T_sfa
    threshold_width: Scalar = 1.0  # grey, of the sigmoid at T_s
    suppression_width: Scalar = 1.0  # grey, of the sigmoid at T_FFI
    frame_time: float = struct.field(pytree_node=False, default=1 / 30)  # dt, s
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell averages
    smooth: bool = struct.field(pytree_node=False, default=False)  # sigmoids instead of steps


@struct.dataclass(kw_only=True)
class State:
    """What the next frame needs from this one."""

    frame: Cells  # L
    channels: Channels  # ON, OFF
    feed_forward: Float[Array, ""]  # F
    adaptation: Adaptation  # k, u


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    potential: Float[Array, ""]  # k, before adaptation
    feed_forward: Float[Array, ""]  # F [grey]
    excitation: Float[Array, ""]  # K / n_cell [grey]


@struct.dataclass(kw_only=True)
class Layers:
    """Layers of cells for one frame, in grey levels."""

    channels: Channels
    summation: Cells  # S, after the threshold
    grouping: Cells  # G


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    require_frame("lgmd1_onoff", frame)
    pooled = pool(frame, params.pooling)
    return State(
        frame=pooled,
        channels=on_off.silent(pooled),
        feed_forward=jnp.zeros((), pooled.dtype),
        adaptation=on_off.rest(pooled),
    )


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> params = Params(suppression=100.0)
    >>> state = init(params, jnp.zeros((6, 8)))
    >>> state, response = step(params, state, jnp.full((6, 8), 50.0))
    >>> round(float(response.excitation), 1), float(response.potential), float(response.u)
    (32.4, 1.0, 0.9375)

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    now = layers(params, state, frame)
    pooled, dt = pool(frame, params.pooling), params.frame_time
    F = low_pass(state.feed_forward, mean(jnp.abs(pooled - state.frame)), dt, params.suppression_delay)
    K = mean(now.grouping)
    shut = gate(F - params.suppression, params.suppression_width if params.smooth else None)
    k = jax.nn.sigmoid(K / params.scale)
    adapted = on_off.adapt(state.adaptation, k, dt, params.adaptation_time, params.adaptation_threshold)
    adaptation = jax.tree.map(lambda potential: potential + shut * (U_AT_REST - potential), adapted)
    next_state = State(frame=pooled, channels=now.channels, feed_forward=F, adaptation=adaptation)
    response = Response(u=adaptation.adapted, potential=adaptation.potential, feed_forward=F, excitation=K)
    return next_state, response


def layers(params: Params, state: State, frame: Float[Array, "height width"]) -> Layers:
    """Return the layers of cells for the next frame."""
    require_frame("lgmd1_onoff", frame)
    pooled = pool(frame, params.pooling)
    require_size("lgmd1_onoff", pooled, state.frame)
    now, before = on_off.split(state.channels, pooled - state.frame, params.residual), state.channels
    S_on = now.on - params.on_inhibition * _neighbourhood(params, before.on, now.on)
    S_off = _neighbourhood(params, before.off, now.off) - params.off_inhibition * now.off
    S = params.on_weight * S_on + params.off_weight * S_off + params.joint_weight * S_on * S_off
    S = S * gate(S - params.threshold, params.threshold_width if params.smooth else None)
    return Layers(channels=now, summation=S, grouping=local_mean(S))


def _neighbourhood(params: Params, before: Cells, now: Cells) -> Cells:
    """Return N: the weighted sum over the neighbours, delayed longer for the farther ones."""
    dt = params.frame_time
    nearest = neighbours(on_off.delayed(before, now, dt, params.delay_nearest)).nearest
    diagonal = neighbours(on_off.delayed(before, now, dt, params.delay_diagonal)).diagonal
    return params.nearest * nearest + params.diagonal * diagonal
