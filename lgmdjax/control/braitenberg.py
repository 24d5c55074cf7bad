"""Braitenberg vehicles, and the teacher: the obstacle avoidance rule made of two of them (eqs. 18-22).

Two sensors drive the two sides of the body, straight or crossed, exciting or inhibiting. The teacher feeds the
nearness of what is in its way on either side to the sum of vehicles 2a and 3b (eq. 22).

| symbol     | name                       | unit              | equation |
| ---------- | -------------------------- | ----------------- | -------- |
| u          | stimuli, nearness 1/r      | any, 1/m          | 18-22    |
| v          | velocity                   | nominal, 0.05 m/s | 18-22    |
| v_base     | base                       | nominal           | 18-22    |
| k_2a       | gain_2a                    | nominal m         | 18, 22   |
| k_3b       | gain_3b                    | nominal m         | 21, 22   |
| d_l, d_r   | nearest                    | m                 | 22       |
| e_l, e_r   | corridor                   | m                 | -        |
| r_l, r_r   | distances                  | m                 | 22       |

Source: Cizek & Faigl, sec. 4.1, 4.2; Braitenberg 1986. Pairs are (left, right); v_right > v_left turns left.

`rule` is eq. 22 as printed. It turns away from whatever is nearest, even beside its path, and so turns back where it
could pass. It commands velocities that no gait can reach. In front of a flat wall both sides are equally near, so it
accelerates into the wall. `step` therefore departs from it in three ways:

1. `sensed_distances` weighs what is in the way (`lgmdjax.sensors.laser`) more than what is merely near.
2. `limit` brings the velocity into the range of the gait and keeps as much of the turn as possible.
3. Near an obstacle the turn has a minimum size, and while both sides are nearly equally near, its direction is kept.

The paper's own rule within the gait's range is `Params(base=1.2, corridor=0, full_turn=0, tie_tolerance=0)`. In the
paper's scenes of 90 s, and in 64 random rooms of 180 s:

| rule                     | passed: indoor, outdoor, dynamic, gap of 0.8 m  | collisions | new cells a minute |
| ------------------------ | ----------------------------------------------- | ---------- | ------------------ |
| teacher                  | 12 of 12, 10 of 10, 40 of 40, 40 of 40          | 0 in 798 m | 21.0               |
| the paper's, in range    | 0 of 12, 0 of 10, 0 of 40, 38 of 40             | 145 in 780 m | 21.7             |

In the three scenes 3 of the 62 robots with the paper's rule touch nothing.

Gradient: exact almost everywhere; zero through the direction of the turn.
"""

import math

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.locomotion.shaping import MAX_VELOCITY, MIN_VELOCITY
from lgmdjax.minmax import clip, maximum, minimum

Scalar = Float[Array, ""] | float

MIN_DISTANCE = 0.01  # m; shorter distances are clipped to it, so that 1/d stays finite


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Gains of the rule (paper sec. 4.2), range of the gait, minimum turn and tie-break.

    With `full_turn` and `tie_tolerance` zero the teacher is eq. 22 with `limit`. With one gain zero as well it is a
    single vehicle.
    """

    base: Scalar = 1.3  # v_base; paper: 1.2 (its "m/s" are multiples of nominal), with 1.0 to 1.4 equally good
    gain_2a: Scalar = 0.8  # k_2a
    gain_3b: Scalar = 0.6  # k_3b
    min_velocity: Scalar = MIN_VELOCITY  # range of the gait
    max_velocity: Scalar = MAX_VELOCITY
    turn_distance: Scalar = 0.8  # m; below it the turn has a minimum size
    full_turn_distance: Scalar = 0.5  # m; at and below it the minimum is full_turn
    full_turn: Scalar = 3.0  # |v_right - v_left|; the width of the gait's range is the largest possible
    tie_tolerance: Scalar = 0.24  # |1/d_r - 1/d_l| / (1/d_r + 1/d_l) below which both sides count as equally near
    turn_deadband: Scalar = 0.23  # |v_right - v_left| up to which the robot counts as not turning
    default_side: Scalar = 1.0  # direction at an exact tie before any turn: 1 left, -1 right
    corridor: Scalar = 0.85  # weight of what is in the way; with 0 only what is nearest counts, as in the paper


@struct.dataclass(kw_only=True)
class State:
    """Direction of the robot's present turn: 1 left, -1 right, 0 none."""

    side: Float[Array, ""]


def vehicle_2a(stimuli: Float[Array, "2"], base: Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Excite each side by its own sensor (eq. 18): turn away from the stimulus, faster."""
    return base + gain * stimuli


def vehicle_2b(stimuli: Float[Array, "2"], base: Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Excite each side by the opposite sensor (eq. 19): turn towards the stimulus, faster."""
    return base + gain * stimuli[::-1]


def vehicle_3a(stimuli: Float[Array, "2"], base: Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Inhibit each side by its own sensor (eq. 20): turn towards the stimulus, slower, and stop there."""
    return base - gain * stimuli


def vehicle_3b(stimuli: Float[Array, "2"], base: Float[Array, "2"] | Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Inhibit each side by the opposite sensor (eq. 21): turn away from the stimulus, slower."""
    return base - gain * stimuli[::-1]


def respond(params: Params, nearness: Float[Array, "2"]) -> Float[Array, "2"]:
    """Return the sum of vehicles 2a and 3b around one base velocity: eq. 22 with `nearness` for 1/d.

    >>> print(respond(Params(), jnp.asarray([0.0, 1.0])).round(2))  # an obstacle on the right: turn left
    [0.7 2.1]
    """
    excited = vehicle_2a(nearness, params.base, params.gain_2a)
    return vehicle_3b(nearness, excited, params.gain_3b)


def rule(params: Params, distances: Float[Array, "2"]) -> Float[Array, "2"]:
    """Return the velocity of eq. 22 as printed, without limits; distances [m] are clipped to `MIN_DISTANCE`."""
    return respond(params, _nearness(distances))


def limit(params: Params, velocity: Float[Array, "2"]) -> Float[Array, "2"]:
    """Bring a velocity into the range of the gait and keep the turn: first shift both sides, then narrow the turn.

    Clipping each side by itself would lose most of the turn where it is needed most. The velocity (3.75, -0.64) belongs
    to an obstacle 0.3 m away on the left:

    >>> print(limit(Params(), jnp.asarray([3.75, -0.64])))
    [ 2. -1.]
    >>> print(limit(Params(), jnp.asarray([2.25, 0.75])))  # clipping each side would give (2, 0.75)
    [2.  0.5]
    """
    max_turn = params.max_velocity - params.min_velocity
    return _from_mean_and_turn(params, jnp.mean(velocity), clip(velocity[1] - velocity[0], -max_turn, max_turn))


def sensed_distances(params: Params, nearest: Float[Array, "2"], corridor: Float[Array, "2"]) -> Float[Array, "2"]:
    """Return the distances [m] that the rule reacts to, on either side.

    Their nearness 1/r is the mean of the nearness of what is in the way (e) and of what is nearest (d), with weights:

        1/r = corridor / e + (1 - corridor) / d.

    Where the path is equally blocked on both sides, what is nearest decides the side: beside a wall the robot turns
    away from it, not into it.

    Args:
        params: of the rule.
        nearest: d_l and d_r [m].
        corridor: e_l and e_r [m].
    """
    return 1 / (params.corridor * _nearness(corridor) + (1 - params.corridor) * _nearness(nearest))


def init(params: Params) -> State:
    """Return the state of a robot that has not turned yet."""
    return State(side=jnp.zeros(()))


def step(params: Params, state: State, distances: Float[Array, "2"]) -> tuple[State, Float[Array, "2"]]:
    """Return the teacher's velocity for the nearest distances [m] on the left and right: eq. 22 with limits.

    The turn is that of eq. 22. Its minimum size grows from zero at `turn_distance` to `full_turn` at
    `full_turn_distance`. Within `turn_distance` its direction changes only when the other side is clearly nearer, so
    that a robot in front of a wall or in a corner continues its turn.
    """
    nearness = _nearness(distances)
    velocity = respond(params, nearness)
    turn = velocity[1] - velocity[0]
    margin = params.turn_distance - minimum(distances[0], distances[1])
    urgency = clip(margin / (params.turn_distance - params.full_turn_distance), 0.0, 1.0)
    tied = jnp.abs(nearness[1] - nearness[0]) < params.tie_tolerance * jnp.sum(nearness)
    side = _turn_side(params, state.side, turn, near=urgency > 0, tied=tied)
    size = maximum(side * turn, urgency * params.full_turn)
    mean = jnp.mean(velocity)
    limited = limit(params, mean + side * size * jnp.asarray([-0.5, 0.5], velocity.dtype))
    return track_turn(params, limited), limited


def track_turn(params: Params, velocity: Float[Array, "2"]) -> State:
    """Return the state after a velocity, whichever policy commanded it.

    The executed turn then breaks the next tie. A learner can only imitate labels that depend on information it has
    itself, and it knows its own turn.
    """
    turn = velocity[1] - velocity[0]
    return State(side=jnp.where(jnp.abs(turn) > params.turn_deadband, jnp.sign(turn), jnp.zeros_like(turn)))


def check(params: Params) -> None:
    """Raise `InputError` if a number is not finite or negative, or if a range is the wrong way round."""
    for name, value in vars(params).items():
        if not math.isfinite(value):
            raise InputError(f"braitenberg {name}: expected a finite number, got {value}; see braitenberg.Params")
    for name in ("base", "gain_2a", "gain_3b", "full_turn_distance", "full_turn", "tie_tolerance", "turn_deadband"):
        if getattr(params, name) < 0:
            raise InputError(f"braitenberg {name}: expected a number >= 0, got {getattr(params, name)}")
    for low, high in (("min_velocity", "max_velocity"), ("full_turn_distance", "turn_distance")):
        if not getattr(params, low) < getattr(params, high):
            raise InputError(
                f"braitenberg {low}: expected less than {high} = {getattr(params, high)}, "
                f"got {getattr(params, low)}; swap them"
            )
    if not 0 <= params.corridor <= 1:
        raise InputError(f"braitenberg corridor: expected a weight in 0..1, got {params.corridor}")
    if params.default_side not in (-1, 1):
        raise InputError(f"braitenberg default_side: expected 1 (left) or -1 (right), got {params.default_side}")


def _nearness(distances: Float[Array, "2"]) -> Float[Array, "2"]:
    return 1 / maximum(distances, MIN_DISTANCE)


def _from_mean_and_turn(params: Params, mean: Float[Array, ""], turn: Float[Array, ""]) -> Float[Array, "2"]:
    """Return the velocity with this turn (v_right - v_left) in the gait's range whose mean is nearest to `mean`."""
    half = jnp.abs(turn) / 2
    mean = clip(mean, params.min_velocity + half, params.max_velocity - half)
    return jnp.stack([mean - turn / 2, mean + turn / 2])


def _turn_side(params: Params, last: Array, turn: Array, near: Array, tied: Array) -> Float[Array, ""]:
    """Choose the direction of the turn: the last one while near and tied, else that of eq. 22.

    Where eq. 22 does not turn, it is the last direction, or `default_side` if an obstacle is near. Far from all
    obstacles it stays 0, so that a mirrored robot later decides for the mirrored side.
    """
    default = jnp.where((last == 0) & near, params.default_side, last)
    requested = jnp.sign(turn)
    keep = near & tied & (last != 0)
    return jnp.where(keep | (requested == 0), default, requested)
