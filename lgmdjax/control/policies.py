"""Five policies with one interface: observation to left and right velocity.

| policy  | observes  | does                                                             |
| ------- | --------- | ---------------------------------------------------------------- |
| teacher | distances | eq. 22, limited and tie-broken (`lgmdjax.control.braitenberg`)   |
| learned | u         | the trained network, limited (`lgmdjax.control.navigator`)       |
| blind   | nothing   | walks straight ahead at v_base                                   |
| direct  | u         | eq. 22 with a multiple of u - 0.5 in place of 1/d, no memory     |
| random  | nothing   | replays velocities that the teacher commanded in other rooms     |

Each is a `Policy`: a pair of pure functions and a name. Velocities are multiples of the nominal 0.05 m/s, left first.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from lgmdjax.control import braitenberg, navigator
from lgmdjax.control.names import POLICY_NAMES
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable

ParamsT = TypeVar("ParamsT")
StateT = TypeVar("StateT")

GAIT_RANGE = braitenberg.Params()  # of which `limit` reads the range of the gait, the same for all policies


@struct.dataclass(kw_only=True)
class Observation(NotebookTable):
    """What a policy may use in one frame: outputs of the two LGMDs and distances on either side, left first."""

    u: Float[Array, "2"]  # LGMD output, 0.5..1
    feed_forward: Float[Array, "2"]  # FF cell, grey
    excitation: Float[Array, "2"]  # U / n_cell, grey
    distances: Float[Array, "2"]  # to the nearest obstacle, m
    corridor: Float[Array, "2"]  # to the nearest obstacle in the way, m


@dataclass(frozen=True)
class Policy(Generic[ParamsT, StateT]):
    """A policy as pure functions; hashable, so that it can be a static argument of `jax.jit`.

    Args:
        name: one of `names.POLICY_NAMES`, or "switch".
        init: `init(params, key) -> state`.
        step: `step(params, state, observation) -> (state, velocity)`.
        uses_camera: whether `step` reads outputs of the LGMDs, so that pictures have to be rendered.
    """

    name: str
    init: Callable[[ParamsT, Array], StateT]
    step: Callable[[ParamsT, StateT, Observation], tuple[StateT, Float[Array, "2"]]]
    uses_camera: bool = False


@struct.dataclass(kw_only=True)
class BlindParams(NotebookTable):
    """The constant velocity of policy blind."""

    velocity: Float[Array, "2"]


@struct.dataclass(kw_only=True)
class DirectParams(NotebookTable):
    """Eq. 22 on the outputs of the LGMDs: `gain` [1/m] times u - 0.5 replaces 1/d."""

    rule: braitenberg.Params
    gain: Float[Array, ""]


@struct.dataclass(kw_only=True)
class ReplayParams(NotebookTable):
    """Velocities that the teacher commanded, one per frame, in rooms other than the present one."""

    velocities: Float[Array, "frames 2"]


def _step_teacher(
    params: braitenberg.Params, state: braitenberg.State, observation: Observation
) -> tuple[braitenberg.State, Float[Array, "2"]]:
    distances = braitenberg.sensed_distances(params, observation.distances, observation.corridor)
    return braitenberg.step(params, state, distances)


def _step_learned(
    params: navigator.Params, state: navigator.State, observation: Observation
) -> tuple[navigator.State, Float[Array, "2"]]:
    state, output = navigator.step(params, state, observation.u)
    velocity = braitenberg.limit(GAIT_RANGE, output)
    return replace(state, velocity=velocity), velocity  # the network's next input is the limited velocity


def _step_blind(params: BlindParams, state: None, observation: Observation) -> tuple[None, Float[Array, "2"]]:
    return state, params.velocity


def _step_direct(params: DirectParams, state: None, observation: Observation) -> tuple[None, Float[Array, "2"]]:
    nearness = params.gain * (observation.u - 0.5)
    return state, braitenberg.limit(params.rule, braitenberg.respond(params.rule, nearness))


def _init_replay(params: ReplayParams, key: Array) -> Int[Array, ""]:
    """Sample the frame to begin with."""
    return jax.random.randint(key, (), 0, len(params.velocities))


def _step_replay(
    params: ReplayParams, state: Int[Array, ""], observation: Observation
) -> tuple[Int[Array, ""], Float[Array, "2"]]:
    return (state + 1) % len(params.velocities), jnp.take(params.velocities, state, axis=0)


TEACHER = Policy("teacher", lambda params, key: braitenberg.init(params), _step_teacher)
LEARNED = Policy("learned", lambda params, key: navigator.init(params), _step_learned, uses_camera=True)
BLIND = Policy("blind", lambda params, key: None, _step_blind)
DIRECT = Policy("direct", lambda params, key: None, _step_direct, uses_camera=True)
REPLAY = Policy("random", _init_replay, _step_replay)

POLICIES: tuple[Policy, ...] = (TEACHER, LEARNED, BLIND, DIRECT, REPLAY)
"""All policies, in the order of `names.POLICY_NAMES`."""


def get_policy(name: str) -> Policy:
    """Return the policy of this name; raise `InputError` for an unknown one.

    >>> get_policy("direct").uses_camera
    True
    """
    if name not in POLICY_NAMES:
        raise InputError(f"policy: expected one of {', '.join(POLICY_NAMES)}, got {name!r}")
    return POLICIES[POLICY_NAMES.index(name)]


@struct.dataclass(kw_only=True)
class PolicySwitch(NotebookTable):
    """The parameters of all five policies, in the order of `POLICIES`, and the index of the active one."""

    active: Int[Array, ""]
    policies: tuple[braitenberg.Params, navigator.Params, BlindParams, DirectParams, ReplayParams]


def _init_switch(params: PolicySwitch, key: Array) -> tuple[PyTree, ...]:
    return tuple(policy.init(own, key) for policy, own in zip(POLICIES, params.policies, strict=True))


def _step_switch(
    params: PolicySwitch, states: tuple[PyTree, ...], observation: Observation
) -> tuple[tuple[PyTree, ...], Float[Array, "2"]]:
    results = [
        policy.step(own, state, observation)
        for policy, own, state in zip(POLICIES, params.policies, states, strict=True)
    ]
    velocities = jnp.stack([velocity for _, velocity in results])
    return tuple(state for state, _ in results), jnp.take(velocities, params.active, axis=0)


# One compiled program serves all policies, since the active one is a number. Computing the other four costs less than
# compiling a second rollout.
SWITCH = Policy("switch", _init_switch, _step_switch, uses_camera=True)
