"""Batches of rooms: one `closed_loop.Room` whose leaves have a leading axis of robots.

| function          | rooms                                                                     |
| ----------------- | ------------------------------------------------------------------------- |
| `random_rooms`    | random obstacles, sampled from a key                                      |
| `replicate_room`  | one arena for all robots, with different starts                           |
| `training_rooms`  | random rooms of one training episode, of various contrasts                |
| `benchmark_rooms` | held-out random rooms in which studies compare robots                     |
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.simulation.closed_loop import Room
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.world import scenes
from lgmdjax.world.arena import Arena, sample_free_poses

START_COUNT = 32  # start poses of a room, used in order, a new one after each reset
BENCHMARK_EPISODE = 2**23  # episode number of `benchmark_rooms`, above those of all training episodes
CONTRAST_RANGE = (0.3, 1.0)  # factors by which the contrast of training rooms is scaled
OVERHEAD_SHARE = 0.2  # of the obstacles in training rooms


@partial(jax.jit, static_argnames="count")
def random_rooms(key: Array, count: int, density: Float[Array, ""] | float = 0.15) -> Room:
    """Return random rooms with random starts; the same key and index give the same room.

    >>> random_rooms(jax.random.key(0), 4).starts.shape
    (4, 32, 3)

    Args:
        key: random key of the whole batch.
        count: number of rooms, one for each robot.
        density: of obstacles, as in `scenes.random_room`.
    """

    def room(key: Array) -> Room:
        arena_key, starts_key, policy_key = jax.random.split(key, 3)
        arena = scenes.random_room(arena_key, density)
        return Room(arena=arena, starts=sample_free_poses(starts_key, arena, START_COUNT), key=policy_key)

    return jax.vmap(lambda index: room(jax.random.fold_in(key, index)))(jnp.arange(count))


@partial(jax.jit, static_argnames="count")
def replicate_room(key: Array, arena: Arena, count: int, spread: Float[Array, ""] | float = jnp.pi) -> Room:
    """Return a batch of rooms with the same arena.

    The first start of each is the arena's own, rotated by up to `spread` [rad]; the others are random free poses.
    """

    def room(key: Array) -> Room:
        turn_key, starts_key, policy_key = jax.random.split(key, 3)
        turn = jnp.asarray([0, 0, 1]) * jax.random.uniform(turn_key, minval=-spread, maxval=spread)
        later = sample_free_poses(starts_key, arena, START_COUNT - 1)
        return Room(arena=arena, starts=jnp.concatenate([(arena.start + turn)[None], later]), key=policy_key)

    return jax.vmap(lambda index: room(jax.random.fold_in(key, index)))(jnp.arange(count))


def stack_rooms(rooms: list[Room]) -> Room:
    """Stack single rooms with equally many prisms into a batch."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)


def training_rooms(seed: int, episode: int, robots: int) -> Room:
    """Return the random rooms of a training episode, with contrasts in `CONTRAST_RANGE` and a few obstacles overhead.

    Rooms of low contrast are needed: a navigator trained only in rooms of high contrast learns that little motion means
    no obstacle, and hardly turns from the single moving edge of a plain wall. Obstacles overhead are needed for table
    tops and crowns of trees: a navigator that never walked under anything turns round in front of them.
    """
    key = jax.random.fold_in(jax.random.key(seed), episode)
    rooms = random_rooms(key, robots)
    contrast_key, overhead_key = (jax.random.fold_in(key, robots + k) for k in range(2))
    contrast = jax.random.uniform(contrast_key, (robots,), jnp.float32, *CONTRAST_RANGE)

    def vary(arena: Arena, contrast: Array, key: Array) -> Arena:
        return scenes.raise_obstacles(scenes.scale_contrast(arena, contrast), key, OVERHEAD_SHARE)

    return replace(rooms, arena=jax.vmap(vary)(rooms.arena, contrast, jax.random.split(overhead_key, robots)))


def benchmark_rooms(benchmark: BenchmarkRooms, seed: int, contrast: float = 1.0) -> Room:
    """Return the held-out random rooms of a benchmark, the contrast of all textures scaled by `contrast`."""
    rooms = random_rooms(jax.random.fold_in(jax.random.key(seed), BENCHMARK_EPISODE), benchmark.robots)
    return replace(rooms, arena=jax.vmap(scenes.scale_contrast, in_axes=(0, None))(rooms.arena, contrast))
