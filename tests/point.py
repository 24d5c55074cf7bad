"""A point that slides along a line, as an environment of reinforcement learning."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

SPEED = 0.3


@struct.dataclass
class PointState:
    position: jax.Array
    time: jax.Array
    is_over: jax.Array


class PointTransition(NamedTuple):
    observation: jax.Array
    state: PointState
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


@struct.dataclass
class Point:
    """A point that an action moves; reward -x^2 at its new position, the end beyond `limit` and after `steps`."""

    limit: float = 3.0
    steps: int = 1000
    observation_size, privileged_size, action_size = 1, 1, 1

    def reset(self, key):
        position = jax.random.uniform(key, (), minval=-1.0, maxval=1.0)
        state = PointState(position, jnp.asarray(0, jnp.int32), jnp.asarray(False))
        return position[None], state

    def step(self, key, state, action):
        position, time = state.position + SPEED * action[0], state.time + 1
        terminated, truncated = jnp.abs(position) > self.limit, time >= self.steps
        moved = PointState(position, time, terminated | truncated)
        after = jax.tree.map(lambda a, b: jnp.where(state.is_over, a, b), self.reset(key)[1], moved)
        counts = ~state.is_over
        return PointTransition(
            after.position[None], after, -(position**2) * counts, terminated & counts, truncated & counts
        )

    def privileged(self, state):
        return state.position[None] ** 2
