"""Who is at the wheel: five ways from the senses to a velocity of either side, of one shape.

| driver  | looks at     | does                                                             |
| ------- | ------------ | ---------------------------------------------------------------- |
| teacher | laser        | eq. 22, limited and tie-broken (`lgmdjax.control.braitenberg`)            |
| learned | u            | the trained network, limited (`lgmdjax.control.navigator`)                |
| blind   | nothing      | walks straight on at v_base                                       |
| direct  | u            | eq. 22 with a multiple of u - 0.5 in the place of 1/d, no memory  |
| random  | nothing      | replays commands that the teacher gave somewhere else             |

Each is a pair of pure functions: `init(params, key) -> state` and `step(params, state, senses) -> (state,
velocity)`, with the velocity in multiples of the nominal 0.05 m/s, left first.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from lgmdjax.control import braitenberg, navigator

RANGE = braitenberg.Params()  # its limits are what the legs can do, whoever drives


@struct.dataclass(kw_only=True)
class Senses:
    """What one frame tells: the two LGMDs and the scanner's two hemifields, left first."""

    u: Float[Array, "2"]  # LGMD output, 0.5..1
    feed_forward: Float[Array, "2"]  # FF cell, grey
    excitation: Float[Array, "2"]  # U / n_cell, grey
    distances: Float[Array, "2"]  # nearest obstacle, m


class Driver(NamedTuple):
    """A way to drive."""

    name: str
    init: Callable[[Any, Array], Any]
    step: Callable[[Any, Any, Senses], tuple[Any, Float[Array, "2"]]]


@struct.dataclass(kw_only=True)
class Blind:
    """The command of a robot that looks at nothing."""

    velocity: Float[Array, "2"]


@struct.dataclass(kw_only=True)
class Direct:
    """Eq. 22 straight on the LGMDs: `gain` [1/m] makes u - 0.5 stand for 1/d."""

    rule: braitenberg.Params
    gain: Float[Array, ""]


@struct.dataclass(kw_only=True)
class Replay:
    """Commands that the teacher once gave, one a frame, in rooms other than the one walked."""

    velocities: Float[Array, "frames 2"]


def _step_teacher(params: braitenberg.Params, state: braitenberg.State, senses: Senses):
    return braitenberg.step(params, state, senses.distances)


def _step_learned(params: navigator.Params, state: navigator.State, senses: Senses):
    state, asked = navigator.step(params, state, senses.u)
    velocity = braitenberg.limit(RANGE, asked)
    return replace(state, velocity=velocity), velocity  # what was done, not what was asked, is its next input


def _step_blind(params: Blind, state: None, senses: Senses):
    return state, params.velocity


def _step_direct(params: Direct, state: None, senses: Senses):
    nearness = params.gain * (senses.u - 0.5)
    return state, braitenberg.limit(params.rule, braitenberg.respond(params.rule, nearness))


def _start_replay(params: Replay, key: Array) -> Int[Array, ""]:
    return jax.random.randint(key, (), 0, len(params.velocities))


def _step_replay(params: Replay, state: Int[Array, ""], senses: Senses):
    return (state + 1) % len(params.velocities), jnp.take(params.velocities, state, axis=0)


TEACHER = Driver("teacher", lambda params, key: braitenberg.init(params), _step_teacher)
LEARNED = Driver("learned", lambda params, key: navigator.init(params), _step_learned)
BLIND = Driver("blind", lambda params, key: None, _step_blind)
DIRECT = Driver("direct", lambda params, key: None, _step_direct)
RANDOM = Driver("random", _start_replay, _step_replay)
ALL = (TEACHER, LEARNED, BLIND, DIRECT, RANDOM)


@struct.dataclass(kw_only=True)
class Anyone:
    """The parameters of all five, in the order of `ALL`, and which of them drives."""

    seat: Int[Array, ""]
    drivers: tuple[braitenberg.Params, navigator.Params, Blind, Direct, Replay]


def _init_anyone(params: Anyone, key: Array) -> tuple[Any, ...]:
    return tuple(driver.init(own, key) for driver, own in zip(ALL, params.drivers, strict=True))


def _step_anyone(params: Anyone, states: tuple[Any, ...], senses: Senses):
    results = [driver.step(own, state, senses) for driver, own, state in zip(ALL, params.drivers, states, strict=True)]
    velocities = jnp.stack([velocity for _, velocity in results])
    return tuple(state for state, _ in results), jnp.take(velocities, params.seat, axis=0)


# Compiling a crowd's walk takes longer than the sums of all five drivers ever will: one program serves them all,
# and who is at the wheel is a number.
ANYONE = Driver("anyone", _init_anyone, _step_anyone)
