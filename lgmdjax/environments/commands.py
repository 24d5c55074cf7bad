"""The environment as the actor sees it: a command lasts several frames, and the last u of both LGMDs are its input.

`make` returns what `lgmdjax.learning.short_horizon` trains on. A step is one command: an action in -1..1, held for
`actor.HOLD` frames of `functional.Environment`, whose rewards are added. The observation is the input of
`lgmdjax.control.actor`, whose `POLICY` therefore walks the same in a rollout. When an episode ends, the command ends
with it. The step after that ignores its action and begins the next episode.

The privileged observation is for a critic, which is needed in training alone. All of it is seen from the robot's
position and heading, and has a derivative by both.

| feature  | number      | meaning                                                               |
| -------- | ----------- | --------------------------------------------------------------------- |
| nearness | `RAYS`      | exp(-r / `RANGE`) of the range r in level directions all around       |
| covered  | 1 + 8 radii | floor covered (`coverage`) under the robot, and on rings around it    |
| velocity | 2           | the last command, nominal                                             |
"""

import math
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from lgmdjax.body import hexapod
from lgmdjax.control import actor
from lgmdjax.environments import coverage, functional
from lgmdjax.environments.functional import Environment
from lgmdjax.errors import InputError
from lgmdjax.minmax import minimum
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.world import arena, raycast

RAYS = 24  # directions of the nearness
RANGE = 0.5  # m, in which nearness falls to 1/e
MAX_RANGE = 5.0  # m
RADII = (0.25, 0.5, 1.0)  # m, of the rings on which the covered floor is sampled
RING = 8  # points on a ring
PRIVILEGED = RAYS + 1 + RING * len(RADII) + 2  # features


@struct.dataclass(kw_only=True)
class State:
    """State of one robot between two commands."""

    environment: functional.State
    history: Float[Array, "depth 2"]  # of u, oldest first


class Transition(NamedTuple):
    """What a command returns."""

    observation: Float[Array, " inputs"]
    state: State
    reward: Float[Array, ""]  # sum over its frames
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]


@struct.dataclass(kw_only=True)
class Commands:
    """An environment with observation "lgmd" and action "velocity", in commands of several frames; from `make`."""

    environment: Environment
    depth: int = struct.field(pytree_node=False, default=actor.DEPTH)
    hold: int = struct.field(pytree_node=False, default=actor.HOLD)

    @property
    def observation_size(self) -> int:
        """Number of inputs of the actor."""
        return 2 * self.depth

    @property
    def privileged_size(self) -> int:
        """Number of further inputs of a critic."""
        return PRIVILEGED

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return 2

    def reset(self, key: Array) -> tuple[Float[Array, " inputs"], State]:
        """Return the observation and the state at a start of a room, both drawn with the key."""
        u, state = self.environment.reset(key)
        return self._observe(State(environment=state, history=actor.fill(u, self.depth)))

    def step(self, key: Array, state: State, action: Float[Array, "2"]) -> Transition:
        """Return the transition that a command causes; after the end of an episode, the start of the next.

        Gradient: as that of `functional.Environment.step`.
        """
        velocity, begins = actor.to_velocity(action), state.environment.done

        def frame(
            carry: tuple[functional.State, Bool[Array, ""]], key: Array
        ) -> tuple[tuple[functional.State, Bool[Array, ""]], tuple[Array, Array, Array]]:
            before, is_over = carry
            moved = self.environment.step(key, before, velocity)
            after = functional.choose(is_over, before, moved.state)
            reward = jnp.where(is_over, 0.0, moved.reward)
            ends = moved.terminated & ~is_over, moved.truncated & ~is_over
            return (after, is_over | begins | moved.state.done), (reward, *ends)

        # Intermediates of pictures take too much memory to be stored for the backward pass; those of the rest do not.
        # The recomputed frame is inside a loop, where XLA cannot merge it with the first one.
        stored = not self.environment.settings.vision_gradient
        scanned = frame if stored else jax.checkpoint(frame, prevent_cse=False)
        initial = state.environment, jnp.asarray(False)
        (after, _), (rewards, terminated, truncated) = jax.lax.scan(scanned, initial, jax.random.split(key, self.hold))
        u = after.sensed.u
        history = jnp.where(begins, actor.fill(u, self.depth), actor.push(state.history, u))
        observation, after = self._observe(State(environment=after, history=history))
        return Transition(observation, after, jnp.sum(rewards), jnp.any(terminated), jnp.any(truncated))

    def privileged(self, state: State) -> Float[Array, " features"]:
        """Return the privileged observation, for a critic."""
        robot, floor = state.environment.robot, state.environment.floor
        pose = hexapod.pose(robot.data)
        heading = hexapod.yaw(pose)
        room = self.environment.room_of(state.environment).arena
        nearness = _nearness(arena.at_time(room, robot.frame / FRAME_RATE), pose.position, heading)
        points = pose.position[:2] + _rings(heading)
        covered = jax.vmap(coverage.covered_at, in_axes=(None, 0))(floor, points)
        return jnp.concatenate([nearness, covered, robot.controller.velocity])

    def _observe(self, state: State) -> tuple[Float[Array, " inputs"], State]:
        history = state.history
        if not self.environment.settings.vision_gradient:
            history = jax.lax.stop_gradient(history)
        return actor.inputs(history), replace(state, history=history)


def make(environment: Environment, *, depth: int = actor.DEPTH, hold: int = actor.HOLD) -> Commands:
    """Return an environment in commands of `hold` frames, which shows the last `depth` pairs of u.

    Raises InputError for an environment with another observation or action.
    """
    found = environment.settings.observation, environment.settings.action
    if found != ("lgmd", "velocity"):
        raise InputError(
            f"expected an environment with observation lgmd and action velocity, got {' and '.join(found)}"
        )
    if depth < 1 or hold < 1:
        raise InputError(f"expected a depth and a hold of 1 or more, got {depth} and {hold}")
    return Commands(environment=environment, depth=depth, hold=hold)


def _nearness(scene: arena.Arena, position: Float[Array, "3"], heading: Float[Array, ""]) -> Float[Array, " RAYS"]:
    """Return the nearness in level directions all around, the first straight ahead."""
    angles = heading + jnp.arange(RAYS, dtype=heading.dtype) * (2 * math.pi / RAYS)
    directions = jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros_like(angles)], axis=-1)
    return jnp.exp(-minimum(raycast.distance(scene, position, directions), MAX_RANGE) / RANGE)


def _rings(heading: Float[Array, ""]) -> Float[Array, "points 2"]:
    """Return the points where the covered floor is sampled, relative to the robot [m]."""
    angles = heading + jnp.arange(RING, dtype=heading.dtype) * (2 * math.pi / RING)
    ring = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    return jnp.concatenate([jnp.zeros((1, 2), ring.dtype), *(radius * ring for radius in RADII)])
