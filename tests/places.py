"""Scenes to walk small versions of the experiments in."""

from dataclasses import replace

import jax
import numpy as np

from lgmdjax.simulation import closed_loop, room_batches
from lgmdjax.world import arena, scenes


def beside(key: jax.Array, lateral: float) -> arena.Arena:
    """A box of 0.5 m a side, 1 m ahead and so far to the left."""
    box = arena.place([[1.25, lateral]], [[0.25, 0.25]], [0.8])
    return scenes.textured(arena.empty_room((10.0, 10.0), boxes=box), key)


def before_a_wall(key: jax.Array, contrast: float) -> arena.Arena:
    """A wall 1.3 m ahead, and all others like it."""
    room = scenes.textured(arena.empty_room((4.0, 4.0), start=(0.7, 0.0, 0.0)), key)
    return replace(room, wall_texture=jax.numpy.tile(jax.numpy.array([235.0, contrast, 0.0, 0.45]), (4, 1)))


def before_a_corner(key: jax.Array) -> arena.Arena:
    """A corner 1.6 m ahead, its walls 1.1 m off to the left and to the right alike."""
    return scenes.textured(arena.empty_room((4.0, 4.0), start=(0.9, 0.9, 0.25 * np.pi)), key)


def in_the_testing_room(key: jax.Array) -> arena.Arena:
    """Fig. 13's room, the robot put down nearer to the box in its middle, for short walks."""
    return replace(scenes.testing_room(key), start=jax.numpy.array([0.1, 1.4, -0.5 * np.pi]))


def with_mirror_images(built: list[arena.Arena]) -> closed_loop.Room:
    """Make rooms of scenes, each followed by its mirror image, in which robots start over and over in one place."""
    return room_batches.stack(
        [
            closed_loop.Room(arena=room, starts=jax.numpy.tile(room.start, (4, 1)), key=jax.random.key(0))
            for one in built
            for room in (one, arena.mirror(one))
        ]
    )
