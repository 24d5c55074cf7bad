"""Braitenberg's vehicles, and the rule made of two of them that teaches the robot to walk around things.

Two sensors drive two sides of the body, straight or crossed, exciting or inhibiting. The teacher feeds the
nearness 1/d of the nearest obstacle in either hemifield to the sum of vehicles 2a and 3b (eq. 22).

| symbol     | name                  | unit              | equation |
| ---------- | --------------------- | ----------------- | -------- |
| u          | stimuli, nearness 1/d | any, 1/m          | 18-22    |
| v          | velocity              | nominal, 0.05 m/s | 18-22    |
| v_base     | base                  | nominal           | 18-22    |
| k_2a       | gain_2a               | nominal m         | 18, 22   |
| k_3b       | gain_3b               | nominal m         | 21, 22   |
| d_l, d_r   | distances             | m                 | 22       |

Source: Cizek & Faigl, sec. 4.1, 4.2; Braitenberg 1986. Pairs are (left, right); v_right > v_left turns left.

Eq. 22 as printed is `rule`. It asks for velocities that no gait can make, and straight in front of a flat
wall it walks on, faster and faster, because both sides are equally near. `step` therefore departs from it
twice: it keeps to the gait's range in the way that saves most of the turn (`limit`), and when something is
near it turns at least so much, and goes on turning the way it turns while both sides are nearly equally near.

As it is, 16 robots, a minute each in `scenes.training_room`, kept 0.22 m off everything in 52 m
(`tests/test_teacher.py` does it with eight); there eq. 22 within the gait's range touched something 17 times in 66 m,
and a blind robot 24 times in 58 m. It is `full_turn` that keeps the robot off; the tie-break, without which nothing
was touched there either, makes the labels ones that can be learned: the same sight, the same turn.

Gradient: exact almost everywhere; the side of the turn has none.
"""

import math

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.errors import InputError
from lgmdjax.locomotion.shaping import FASTEST, SLOWEST
from lgmdjax.minmax import maximum, minimum, clip

Scalar = Float[Array, ""] | float

SHORTEST = 0.01  # m; what is nearer counts as this far, so that 1/d stays finite


@struct.dataclass(kw_only=True)
class Params:
    """The rule's gains (paper sec. 4.2), the gait's range, and what breaks a tie.

    With `full_turn` and `symmetry` zero the teacher is eq. 22 within the gait's range; with a gain zero it is
    one of the two vehicles.
    """

    base: Scalar = 1.2  # v_base; the paper's "1.2 m/s" is 1.2 times nominal
    gain_2a: Scalar = 0.8  # k_2a
    gain_3b: Scalar = 0.6  # k_3b
    slowest: Scalar = SLOWEST  # the gait's range
    fastest: Scalar = FASTEST
    near: Scalar = 0.95  # m; nearer than this, it turns at least a part of full_turn
    close: Scalar = 0.6  # m; nearer than this, at least all of it
    full_turn: Scalar = 3.0  # |v_right - v_left|; the range's width is the most there is
    symmetry: Scalar = 0.3  # |1/d_r - 1/d_l| / (1/d_r + 1/d_l) that still counts as a tie
    steady: Scalar = 0.3  # |v_right - v_left| up to which the robot counts as not turning
    first_side: Scalar = 1.0  # of an exact tie before any turn: 1 left, -1 right


@struct.dataclass(kw_only=True)
class State:
    """The way that the robot turns: 1 left, -1 right, 0 neither."""

    side: Float[Array, ""]


def vehicle_2a(stimuli: Float[Array, "2"], base: Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Excite each side by its own sensor (eq. 18): turns away from what it senses, faster."""
    return base + gain * stimuli


def vehicle_2b(stimuli: Float[Array, "2"], base: Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Excite each side by the other's sensor (eq. 19): charges at what it senses."""
    return base + gain * stimuli[::-1]


def vehicle_3a(stimuli: Float[Array, "2"], base: Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Inhibit each side by its own sensor (eq. 20): turns towards what it senses, and rests there."""
    return base - gain * stimuli


def vehicle_3b(stimuli: Float[Array, "2"], base: Float[Array, "2"] | Scalar, gain: Scalar) -> Float[Array, "2"]:
    """Inhibit each side by the other's sensor (eq. 21): turns away from what it senses, slower."""
    return base - gain * stimuli[::-1]


def respond(params: Params, nearness: Float[Array, "2"]) -> Float[Array, "2"]:
    """Add vehicles 2a and 3b around one base velocity: eq. 22 with `nearness` for 1/d."""
    excited = vehicle_2a(nearness, params.base, params.gain_2a)
    return vehicle_3b(nearness, excited, params.gain_3b)


def rule(params: Params, distances: Float[Array, "2"]) -> Float[Array, "2"]:
    """Evaluate eq. 22 as printed, without limits; distances [m] below `SHORTEST` count as that."""
    return respond(params, _nearness(distances))


def limit(params: Params, velocity: Float[Array, "2"]) -> Float[Array, "2"]:
    """Bring a velocity into the range of the gait and keep the turn: shift both sides, then narrow the turn.

    Clipping each side by itself would take most of the turn where it is needed: of (3.75, -0.64), for an
    obstacle 0.3 m away on the left, this makes (2, -1), of (2.2, 0.8) it makes (2, 0.6).
    """
    most = params.fastest - params.slowest
    return _drive(params, jnp.mean(velocity), clip(velocity[1] - velocity[0], -most, most))


def init(params: Params) -> State:
    """Start without a turn behind it."""
    return State(side=jnp.zeros(()))


def step(params: Params, state: State, distances: Float[Array, "2"]) -> tuple[State, Float[Array, "2"]]:
    """Teach the velocity for the nearest distances [m] left and right: eq. 22, limited, ties broken.

    The turn is that of eq. 22, but from `near` to `close` its least size grows to `full_turn`. While near,
    the side changes only when the other side is clearly nearer; a robot in front of a wall or in a corner
    turns on.
    """
    nearness = _nearness(distances)
    velocity = respond(params, nearness)
    turn = velocity[1] - velocity[0]
    danger = clip((params.near - minimum(distances[0], distances[1])) / (params.near - params.close), 0.0, 1.0)
    tied = jnp.abs(nearness[1] - nearness[0]) < params.symmetry * jnp.sum(nearness)
    side = _side(params, state.side, turn, near=danger > 0, tied=tied)
    strength = maximum(side * turn, danger * params.full_turn)
    mean = jnp.mean(velocity)
    limited = limit(params, mean + side * strength * jnp.asarray([-0.5, 0.5], velocity.dtype))
    return watch(params, limited), limited


def watch(params: Params, velocity: Float[Array, "2"]) -> State:
    """Take note of how the robot is being driven, by the teacher or by somebody else.

    A tie is then broken by the turn that is under way, which whoever drives knows of: a pupil can only learn from a
    teacher whose labels hang on what both of them can tell.
    """
    turn = velocity[1] - velocity[0]
    return State(side=jnp.where(jnp.abs(turn) > params.steady, jnp.sign(turn), jnp.zeros_like(turn)))


def check(params: Params) -> None:
    """Raise `InputError` if a number is not finite, or the range or the distances are the wrong way round."""
    for name, value in vars(params).items():
        if not math.isfinite(value):
            raise InputError(f"braitenberg {name}: expected a finite number, got {value}; see braitenberg.Params")
    for name in ("base", "gain_2a", "gain_3b", "close", "full_turn", "symmetry", "steady"):
        if getattr(params, name) < 0:
            raise InputError(f"braitenberg {name}: expected a number >= 0, got {getattr(params, name)}")
    for low, high in (("slowest", "fastest"), ("close", "near")):
        if not getattr(params, low) < getattr(params, high):
            raise InputError(
                f"braitenberg {low}: expected less than {high} = {getattr(params, high)}, "
                f"got {getattr(params, low)}; swap them"
            )
    if params.first_side not in (-1, 1):
        raise InputError(f"braitenberg first_side: expected 1 (left) or -1 (right), got {params.first_side}")


def _nearness(distances: Float[Array, "2"]) -> Float[Array, "2"]:
    return 1 / maximum(distances, SHORTEST)


def _drive(params: Params, mean: Float[Array, ""], turn: Float[Array, ""]) -> Float[Array, "2"]:
    """Make the velocity of a turn (v_right - v_left), its mean as near to the asked one as can be."""
    half = jnp.abs(turn) / 2
    mean = clip(mean, params.slowest + half, params.fastest - half)
    return jnp.stack([mean - turn / 2, mean + turn / 2])


def _side(params: Params, last: Array, turn: Array, near: Array, tied: Array) -> Float[Array, ""]:
    """Choose where to turn: on as last time while near and tied, else where eq. 22 turns.

    Where that turns nowhere it is again the last side, or the first one if something is near; far from
    everything it stays undecided, so that a mirrored robot decides later for the mirrored side.
    """
    known = jnp.where((last == 0) & near, params.first_side, last)
    asked = jnp.sign(turn)
    held = near & tied & (last != 0)
    return jnp.where(held | (asked == 0), known, asked)
