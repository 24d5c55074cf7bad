"""LGMD2: a looming detector of young locusts, for objects that are darker than their surroundings.

One detector serves one eye. Brightening and darkening run in separate channels, and inhibition is so strong in the
ON channel that little passes. Inhibition grows with the change of the whole image (photoreceptor mediation) instead of
suppressing the response. Clusters of active cells are amplified, and the response adapts.

| symbol          | name                            | unit    | equation                                             |
| --------------- | ------------------------------- | ------- | ---------------------------------------------------- |
| P, ON, OFF, a   | -                               | grey, 1 | `lgmdjax.detectors.on_off`                           |
| PM_f            | response.mediation              | grey    | a_PM mean |P_f| + (1 - a_PM) PM_{f-1}                |
| T_PM            | mediation_scale                 | grey    | -                                                    |
| W_on, W_off     | -                               | 1       | max(PM / T_PM, b_on), max(PM / T_PM, b_off)          |
| b_on, b_off     | on_inhibition, off_inhibition   | 1       | -                                                    |
| tau_on, tau_off | on_delays, off_delays           | s       | of the cell, its nearest and its diagonal neighbours |
| w_on, w_off     | on_kernel, off_kernel           | 1       | likewise                                             |
| I_on, I_off     | -                               | grey    | sum of w ON and of w OFF over 3 x 3 cells, delayed   |
| S_on, S_off     | -                               | grey    | max(ON - W_on I_on, 0), likewise OFF                 |
| S_f             | layers.summation                | grey    | t_on S_on + t_off S_off + t_both S_on S_off          |
| Ce, w, D_c, C_w | -, -, group_offset, group_share | grey, 1 | as in `lgmdjax.detectors.lgmd1_grouping`             |
| G_f             | layers.grouping                 | grey    | S_f Ce_f / w; 0 where C_de G_f < T_de                |
| K_f / n_cell    | response.excitation             | grey    | mean of G_f                                          |
| k_f             | response.potential              | 0.5..1  | 1 / (1 + exp(-K_f / (n_cell C_sig)))                 |
| u_f             | response.u                      | 0.5..1  | k_f, adapted                                         |

Source: Fu, Hu, Peng, Rind & Yue, "A robust collision perception visual neural network with specific selectivity to
darker objects", IEEE Trans. Cybernetics 50(12), 2020. Equations and constants are those of lgmd2OpenSource.cs of
fuqinbing/LGMD2-open-source, which its first author published for this paper. There, exp(4 (u - 0.78)), rounded down,
are spikes, and eight spikes without a pause a collision; here that is left to the caller.

A cell of the ON channel inhibits itself by at least b_on w_on a ON = 1.38 ON at 30 frames/s, so with these constants
nothing passes the ON channel below 67 frames/s, and the detector responds to darkening only.

Gradient: the thresholds are steps, so the gradients of T_de, C_de and T_sfa are zero and the others are exact almost
everywhere. With `smooth` the step at T_de is a sigmoid.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors import on_off
from lgmdjax.detectors.cells import (
    Cells,
    Scalar,
    gate,
    group,
    low_pass,
    mean,
    neighbours,
    pool,
    rectify,
    require_frame,
    require_size,
)
from lgmdjax.detectors.on_off import Adaptation, Channels
from lgmdjax.minmax import maximum

Triple = Float[Array, "3"]


def _triple(*values: float) -> Any:
    return struct.field(default_factory=lambda: jnp.asarray(values, dtype=float))


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector."""

    residual: Scalar = 0.1  # r
    on_kernel: Triple = _triple(2.0, 0.5, 0.25)  # w_on
    off_kernel: Triple = _triple(1.0, 0.25, 0.125)  # w_off
    on_delays: Triple = _triple(0.015, 0.03, 0.045)  # tau_on, s
    off_delays: Triple = _triple(0.06, 0.12, 0.18)  # tau_off, s
    on_inhibition: Scalar = 1.0  # b_on
    off_inhibition: Scalar = 0.5  # b_off
    mediation_scale: Scalar = 8.0  # T_PM, grey
    mediation_delay: Scalar = 0.09  # s, of PM
    on_weight: Scalar = 1.0  # t_on
    off_weight: Scalar = 1.0  # t_off
    joint_weight: Scalar = 1.0  # t_both, 1/grey
    group_share: Scalar = 4.0  # C_w
    group_offset: Scalar = 0.01  # D_c, grey
    decay: Scalar = 0.5  # C_de
    threshold: Scalar = 15.0  # T_de, grey
    scale: Scalar = 1.0  # C_sig, grey
    adaptation_time: Scalar = 0.8  # tau_hp, s
    adaptation_threshold: Scalar = 0.003  # T_sfa
    threshold_width: Scalar = 1.0  # grey, of the sigmoid at T_de
    frame_time: float = struct.field(pytree_node=False, default=1 / 30)  # dt, s
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell averages
    smooth: bool = struct.field(pytree_node=False, default=False)  # a sigmoid instead of the step


@struct.dataclass(kw_only=True)
class State:
    """What the next frame needs from this one."""

    frame: Cells  # L
    channels: Channels  # ON, OFF
    mediation: Float[Array, ""]  # PM
    adaptation: Adaptation  # k, u


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    potential: Float[Array, ""]  # k, before adaptation
    mediation: Float[Array, ""]  # PM [grey]
    excitation: Float[Array, ""]  # K / n_cell [grey]


@struct.dataclass(kw_only=True)
class Layers:
    """Layers of cells for one frame, in grey levels."""

    channels: Channels
    summation: Cells  # S
    grouping: Cells  # G, after the threshold


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    require_frame("lgmd2", frame)
    pooled = pool(frame, params.pooling)
    return State(
        frame=pooled,
        channels=on_off.silent(pooled),
        mediation=jnp.zeros((), pooled.dtype),
        adaptation=on_off.rest(pooled),
    )


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> params, bright, dark = Params(), jnp.full((6, 8), 90.0), jnp.full((6, 8), 70.0)
    >>> [round(float(step(params, init(params, a), b)[1].u), 2) for a, b in ((bright, dark), (dark, bright))]
    [0.96, 0.5]

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    require_frame("lgmd2", frame)
    pooled, dt = pool(frame, params.pooling), params.frame_time
    require_size("lgmd2", pooled, state.frame)
    PM = low_pass(state.mediation, mean(jnp.abs(pooled - state.frame)), dt, params.mediation_delay)
    now = layers(params, state, pooled, PM)
    K = mean(now.grouping)
    k = jax.nn.sigmoid(K / params.scale)
    adaptation = on_off.adapt(state.adaptation, k, dt, params.adaptation_time, params.adaptation_threshold)
    next_state = State(frame=pooled, channels=now.channels, mediation=PM, adaptation=adaptation)
    return next_state, Response(u=adaptation.adapted, potential=k, mediation=PM, excitation=K)


def layers(params: Params, state: State, pooled: Cells, mediation: Float[Array, ""]) -> Layers:
    """Return the layers of cells for the next frame, given as pooled cells, and its photoreceptor mediation."""
    now, before = on_off.split(state.channels, pooled - state.frame, params.residual), state.channels
    share, dt = mediation / params.mediation_scale, params.frame_time
    I_on = _inhibition(before.on, now.on, params.on_kernel, params.on_delays, dt)
    I_off = _inhibition(before.off, now.off, params.off_kernel, params.off_delays, dt)
    S_on = rectify(now.on - maximum(share, params.on_inhibition) * I_on)
    S_off = rectify(now.off - maximum(share, params.off_inhibition) * I_off)
    S = params.on_weight * S_on + params.off_weight * S_off + params.joint_weight * S_on * S_off
    G = group(S, params.group_share, params.group_offset)
    G = G * gate(params.decay * G - params.threshold, params.threshold_width if params.smooth else None)
    return Layers(channels=now, summation=S, grouping=G)


def _inhibition(before: Cells, now: Cells, kernel: Triple, delays: Triple, frame_time: float) -> Cells:
    """Return the weighted sum over a cell and its neighbours, delayed longer for the farther ones."""
    own, nearest, diagonal = (on_off.delayed(before, now, frame_time, delays[i]) for i in range(3))
    return kernel[0] * own + kernel[1] * neighbours(nearest).nearest + kernel[2] * neighbours(diagonal).diagonal
