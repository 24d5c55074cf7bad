"""ON and OFF channels and spike-frequency adaptation, which the LGMD1 and LGMD2 of Fu, Yue et al. share.

| symbol      | name              | unit   | meaning                                                               |
| ----------- | ----------------- | ------ | --------------------------------------------------------------------- |
| P_f         | change            | grey   | L_f - L_{f-1}                                                         |
| ON_f, OFF_f | channels.on, .off | grey   | max(P_f, 0) + r ON_{f-1}, max(-P_f, 0) + r OFF_{f-1}                  |
| r           | residual          | 1      | part of the last activity that remains                                |
| a           | -                 | 1      | dt / (dt + tau)                                                       |
| -           | delayed           | grey   | a X_f + (1 - a) X_{f-1}                                               |
| k_f         | potential         | 0.5..1 | membrane potential                                                    |
| h           | -                 | 1      | tau_hp / (dt + tau_hp)                                                |
| u_f         | adapted           | 0.5..1 | h k_f if k_f rose by more than T_sfa, else h (u_{f-1} + rise); >= 0.5 |

Source: the equations of fuqinbing/LGMD2-open-source, the programs of the first author. Surprising points:

| point      | there                                                                | here                             |
| ---------- | -------------------------------------------------------------------- | -------------------------------- |
| delay      | called a low-pass filter of the first order, but it mixes this input | the same                         |
|            | with the last one and stores no output                               |                                  |
| rectifiers | clip at 0.1 for integers, so that 0 < P < 0.1 would be OFF           | clip at 0, the same for integers |

Gradient: exact almost everywhere; zero for T_sfa, and where the adapted potential rests at 0.5.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import U_AT_REST, Cells, Scalar, rectify
from lgmdjax.minmax import maximum


class Channels(NamedTuple):
    """Activity of brightening and of darkening, zero or more."""

    on: Cells
    off: Cells


class Adaptation(NamedTuple):
    """Membrane potential before and after spike-frequency adaptation."""

    potential: Float[Array, ""]
    adapted: Float[Array, ""]


def silent(cells: Cells) -> Channels:
    """Return channels without activity."""
    return Channels(on=jnp.zeros_like(cells), off=jnp.zeros_like(cells))


def rest(cells: Cells) -> Adaptation:
    """Return the potential without motion."""
    u = jnp.asarray(U_AT_REST, cells.dtype)
    return Adaptation(potential=u, adapted=u)


def split(before: Channels, change: Cells, residual: Scalar) -> Channels:
    """Return the next activity of both channels.

    >>> split(silent(jnp.zeros((1, 2))), jnp.asarray([[3.0, -2.0]]), 0.1).off.tolist()
    [[0.0, 2.0]]
    """
    return Channels(on=rectify(change) + residual * before.on, off=rectify(-change) + residual * before.off)


def delayed(before: Cells, now: Cells, frame_time: float, time_constant: Scalar) -> Cells:
    """Return the present activity mixed with the last one, whose weight grows with the time constant."""
    a = frame_time / (frame_time + time_constant)
    return a * now + (1.0 - a) * before


def adapt(
    before: Adaptation, potential: Float[Array, ""], frame_time: float, time_constant: Scalar, threshold: Scalar
) -> Adaptation:
    """Let the response decay unless the potential rises by more than the threshold from one frame to the next.

    Args:
        before: of the last frame.
        potential: k_f.
        frame_time: dt [s].
        time_constant: tau_hp [s].
        threshold: T_sfa.
    """
    rise = potential - before.potential
    u = jnp.where(rise > threshold, potential, before.adapted + rise) * (time_constant / (frame_time + time_constant))
    return Adaptation(potential=potential, adapted=maximum(u, U_AT_REST))
