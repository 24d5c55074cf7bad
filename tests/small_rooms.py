"""Rooms for small versions of the experiments."""

from dataclasses import replace

import jax
import numpy as np

from lgmdjax.simulation import closed_loop, room_batches
from lgmdjax.world import arena, scenes


def box_ahead(key: jax.Array, lateral: float) -> arena.Arena:
    """Build a room with a box of 0.5 m a side, 1 m ahead and `lateral` [m] to the left."""
    box = arena.make_prisms([[1.25, lateral]], [[0.25, 0.25]], [0.8])
    return scenes.with_random_textures(arena.empty_room((10.0, 10.0), boxes=box), key)


def facing_wall(key: jax.Array, contrast: float) -> arena.Arena:
    """Build an empty room whose start faces a wall at 1.3 m; all four walls have the same `contrast`."""
    room = scenes.with_random_textures(arena.empty_room((4.0, 4.0), start=(0.7, 0.0, 0.0)), key)
    return replace(room, wall_texture=jax.numpy.tile(jax.numpy.array([235.0, contrast, 0.0, 0.45]), (4, 1)))


def facing_corner(key: jax.Array) -> arena.Arena:
    """Build an empty room whose start faces a corner at 1.6 m, with both walls 1.1 m away."""
    return scenes.with_random_textures(arena.empty_room((4.0, 4.0), start=(0.9, 0.9, 0.25 * np.pi)), key)


def testing_room_near_box(key: jax.Array) -> arena.Arena:
    """Build fig. 13's testing room with the start nearer to the box in its middle, for short walks."""
    return replace(scenes.testing_room(key), start=jax.numpy.array([0.1, 1.4, -0.5 * np.pi]))


def with_mirror_images(arenas: list[arena.Arena]) -> closed_loop.Room:
    """Make a batch of rooms, each followed by its mirror image, in which every reset goes to the same start pose."""
    return room_batches.stack_rooms(
        [
            closed_loop.Room(arena=room, starts=jax.numpy.tile(room.start, (4, 1)), key=jax.random.key(0))
            for original in arenas
            for room in (original, arena.mirror(original))
        ]
    )
