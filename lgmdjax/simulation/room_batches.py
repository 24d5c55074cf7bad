"""TODO docstring."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.simulation import closed_loop
from lgmdjax.simulation.closed_loop import Room
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.world import scenes
from lgmdjax.world.arena import Arena, free_poses

STARTS = 32  # places where a room's robot is put down, one after the other


@partial(jax.jit, static_argnames="count")
def random_rooms(key: Array, count: int, density: Float[Array, ""] | float = 0.15) -> Room:
    """Draw rooms that a key alone decides, each with its starts; the same key and index give the same room."""

    def room(key: Array) -> Room:
        arena_key, starts_key, luck = jax.random.split(key, 3)
        arena = scenes.random_room(arena_key, density)
        return Room(arena=arena, starts=free_poses(starts_key, arena, STARTS), key=luck)

    return jax.vmap(lambda index: room(jax.random.fold_in(key, index)))(jnp.arange(count))


@partial(jax.jit, static_argnames="count")
def copies(key: Array, arena: Arena, count: int, spread: Float[Array, ""] | float = jnp.pi) -> Room:
    """Give every robot of a crowd the same room: first its own start, turned by up to `spread`, then free ones."""

    def room(key: Array) -> Room:
        turn_key, starts_key, luck = jax.random.split(key, 3)
        turn = jnp.asarray([0, 0, 1]) * jax.random.uniform(turn_key, minval=-spread, maxval=spread)
        later = free_poses(starts_key, arena, STARTS - 1)
        return Room(arena=arena, starts=jnp.concatenate([(arena.start + turn)[None], later]), key=luck)

    return jax.vmap(lambda index: room(jax.random.fold_in(key, index)))(jnp.arange(count))


def stack(rooms: list[Room]) -> Room:
    """Batch rooms of one padding, so that every robot has its own."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)


def join(first: Room, second: Room) -> Room:
    """Put two batches of rooms together."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def rooms_of(seed: int, episode: int, robots: int) -> closed_loop.Room:
    """Draw the rooms of an episode to learn in, the same for the same seed and number, of every contrast.

    A robot that has learned in busy rooms only hardly turns from the one thing that moves before a plain wall. Where
    little moves, little is much; it has to be met to be learned.
    """
    key = jax.random.fold_in(jax.random.key(seed), episode)
    rooms = random_rooms(key, robots)
    contrast = jax.random.uniform(jax.random.fold_in(key, robots), (robots,), jnp.float32, *CONTRAST)
    return replace(rooms, arena=jax.vmap(scenes.faded)(rooms.arena, contrast))


def bench_rooms(bench: BenchmarkRooms, seed: int, contrast: float = 1.0) -> closed_loop.Room:
    """Draw the rooms of `benched`."""
    rooms = random_rooms(jax.random.fold_in(jax.random.key(seed), BENCH), bench.robots)
    return replace(rooms, arena=jax.vmap(scenes.faded, in_axes=(0, None))(rooms.arena, contrast))


BENCH = 2**23  # number of an episode far from any other: its rooms are met nowhere else


CONTRAST = (0.3, 1.0)  # of a room to learn in, times what it is drawn with
