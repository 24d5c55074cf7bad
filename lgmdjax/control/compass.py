"""Keep a heading: a policy avoids obstacles, and between them the robot returns to the heading that it started with.

A policy without a goal keeps whatever heading an obstacle left it with. Here a compass, or the integral of a gyroscope,
adds a turn towards a wanted heading, in proportion to the error, as people steer who walk to a goal among obstacles:

    w = w_policy + (1 - m) clip(k e, -w_max, w_max),    e = wrap(psi_0 - psi - b t)

The memory m of avoidance is 1 while the policy turns hard and decays with the time constant tau afterwards, so that the
robot has passed an obstacle before it turns back to the heading that would lead into it:

    m(t) = max(m(t - dt) exp(-dt/tau), min(|w_policy| / w_hard, 1))

| symbol   | name          | unit    | meaning                                             |
| -------- | ------------- | ------- | --------------------------------------------------- |
| w        | turn          | nominal | v_right - v_left                                    |
| psi      | yaw           | rad     | present heading, positive to the left               |
| psi_0    | state.wanted  | rad     | heading to keep                                     |
| b        | state.drift   | rad/s   | drift of the sensor                                 |
| m        | state.memory  | 1       | how much the robot is still avoiding something      |
| k        | gain          | nominal/rad | |
| w_max    | max_turn      | nominal | largest turn towards the heading                    |
| w_hard   | hard_turn     | nominal | turn of the policy that counts as avoidance         |
| tau      | memory_time   | s       | time constant of m                                  |

Source: Fajen & Warren 2003, "Behavioral dynamics of steering, obstacle avoidance, and route selection", for the sum of
attraction and avoidance; the memory is ours.
"""

import math
from dataclasses import replace

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.control import braitenberg
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.minmax import clip, maximum, minimum

Scalar = Float[Array, ""] | float

GYROSCOPE_DRIFT = math.radians(1.0) / 60  # rad/s; a degree a minute


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Steering towards the heading, and the largest drift of its sensor: zero for a compass."""

    gain: Scalar = 1.0  # nominal/rad
    max_turn: Scalar = 0.8  # nominal
    hard_turn: Scalar = 1.0  # nominal
    memory_time: Scalar = 4.0  # s
    drift: Scalar = GYROSCOPE_DRIFT  # rad/s


@struct.dataclass(kw_only=True)
class State:
    """The heading to keep, the drift of this sensor, and the memory of avoidance."""

    wanted: Float[Array, ""]  # rad
    drift: Float[Array, ""]  # rad/s
    memory: Float[Array, ""]  # 0..1


def init(params: Params, yaw: Float[Array, ""], sign: Float[Array, ""]) -> State:
    """Return the state of a robot that shall keep its present heading [rad].

    Args:
        params: of the steering.
        yaw: present heading [rad].
        sign: of the drift, in -1..1.
    """
    return State(wanted=yaw, drift=sign * params.drift, memory=jnp.zeros_like(yaw))


def step(
    params: Params, state: State, velocity: Float[Array, "2"], yaw: Float[Array, ""], interval: float
) -> tuple[State, Float[Array, "2"]]:
    """Return the velocity of a policy with the turn towards the heading added, within the range of the gait.

    Args:
        params: of the steering.
        state: before this frame.
        velocity: that the policy commands, left first [nominal].
        yaw: present heading [rad].
        interval: time since the last call [s].

    >>> state = init(Params(), jnp.asarray(0.0), jnp.asarray(0.0))
    >>> _, velocity = step(Params(), state, jnp.asarray([1.3, 1.3]), jnp.asarray(-0.5), 1 / 30)  # looks to the right
    >>> print(velocity.round(2))
    [1.05 1.55]
    """
    turn = velocity[1] - velocity[0]
    avoiding = minimum(jnp.abs(turn) / params.hard_turn, 1.0)
    memory = maximum(state.memory * jnp.exp(-interval / params.memory_time), avoiding)
    error = jnp.mod(state.wanted - yaw + jnp.pi, 2 * jnp.pi) - jnp.pi
    wish = (1 - memory) * clip(params.gain * error, -params.max_turn, params.max_turn)
    steered = braitenberg.limit(braitenberg.Params(), velocity + wish * jnp.asarray([-0.5, 0.5], velocity.dtype))
    # A sensor that drifts to the left lets the robot keep a heading that drifts to the right.
    return replace(state, wanted=state.wanted - state.drift * interval, memory=memory), steered


def check(params: Params) -> None:
    """Raise `InputError` for a number that is negative or not finite, and for a time or a hard turn of zero."""
    for name, value in vars(params).items():
        positive = name in ("hard_turn", "memory_time")
        if not math.isfinite(value) or value < 0 or (positive and value == 0):
            bound = "a number above 0" if positive else "a number of 0 or more"
            raise InputError(f"compass {name}: expected {bound}, got {value}; see compass.Params")
