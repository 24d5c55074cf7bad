"""What the eyes of a recorded walk saw, drawn again from the poses that are stored in place of pictures."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.body import hexapod
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop, rollout, sharding
from lgmdjax.simulation.closed_loop import Leaf, Record
from lgmdjax.world import arena

FRAMES = 30  # drawn by one call; the last frame of a walk fills it up


def walks(
    eyes: camera.Params, rooms: arena.Arena, record: Record
) -> Float[np.ndarray, "robots frames 2 height columns"]:
    """Draw what the eyes of a crowd saw once more, grey levels 0..255: bit for bit on the machine where it walked.

    One program draws every frame, so that any part of a walk gives the same bits. They are those of the walk if the
    whole crowd is drawn on as many devices, since the compiler may round a crowd of another size otherwise, by a few
    thousandths of a grey level in single precision.

    Args:
        rooms: a room a robot; things that move are put where they were.
        record: axes (robot, frame), as `batched` gives it.
    """
    poses = [np.asarray(leaf) for leaf in (record.time, record.position, record.quaternion)]
    frames = poses[0].shape[1]
    parts = []
    for first in range(0, frames, FRAMES):
        these = np.minimum(np.arange(first, first + FRAMES), frames - 1)
        pictures = _frames(eyes, rooms, *(leaf[:, these] for leaf in poses))
        parts.append(np.asarray(pictures)[:, : frames - first])
    return np.concatenate(parts, axis=1)


@partial(jax.jit, static_argnames="eyes")
def _frames(eyes: camera.Params, rooms: arena.Arena, *poses: Leaf) -> Float[Array, "robots frames 2 height columns"]:
    """Draw as `rollout.advance` does, in a loop over frames: it comes to the same last bits."""

    def step(room: arena.Arena, _: None, pose: tuple[Leaf, Leaf, Leaf]) -> tuple[None, Array]:
        return None, frame(eyes, room, *pose)

    return sharding.deal(lambda rooms, *poses: rollout.march(step, rooms, None, poses)[1], rooms, *poses)


def frame(
    eyes: camera.Params,
    room: arena.Arena,
    time: Float[Leaf, ""],
    position: Float[Leaf, "3"],
    quaternion: Float[Leaf, "4"],
) -> Float[Array, "2 height columns"]:
    """Draw what both eyes see from a pose of the trunk [m, 1], at a time [s] that tells where moving things are."""
    pose = hexapod.Pose(position=jnp.asarray(position), quaternion=jnp.asarray(quaternion))
    return closed_loop.look(eyes, arena.at(room, jnp.asarray(time)), pose)
