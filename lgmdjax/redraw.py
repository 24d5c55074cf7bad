"""What the eyes of a recorded walk saw, drawn again from the poses that are stored in place of pictures."""

from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from lgmdjax import arena, camera, hexapod, rollout
from lgmdjax.simulation import Leaf, Record


def walks(
    eyes: camera.Params, rooms: arena.Arena, record: Record
) -> Float[np.ndarray, "robots frames 2 height columns"]:
    """Draw what the eyes of a crowd saw once more, grey levels 0..255: bit for bit on the machine where it walked.

    One program draws every frame, so that any part of a walk gives the same bits. They are those of the walk if the
    whole crowd is drawn on as many devices, since the compiler may round a crowd of another size otherwise, by less
    than 0.001 grey levels in single precision.

    Args:
        rooms: a room a robot; things that move are put where they were.
        record: axes (robot, frame), as `batched` gives it.
    """
    poses = (np.asarray(leaf) for leaf in (record.time, record.position, record.quaternion))
    moments = zip(*(leaf.swapaxes(0, 1) for leaf in poses), strict=True)
    return np.stack([_frames(eyes, rooms, *at) for at in moments], axis=1)


@partial(jax.jit, static_argnames="eyes")
def _frames(eyes: camera.Params, rooms: arena.Arena, *poses: Leaf) -> Float[Array, "robots 2 height columns"]:
    return rollout.deal(partial(frame, eyes), rooms, *poses)


@partial(jax.jit, static_argnames="eyes")
def frame(
    eyes: camera.Params,
    room: arena.Arena,
    time: Float[Array, ""],
    position: Float[Array, "3"],
    quaternion: Float[Array, "4"],
) -> Float[Array, "2 height columns"]:
    """Draw what both eyes see from a pose of the trunk [m, 1], at a time [s] that tells where moving things are."""
    pose = hexapod.Pose(position=position, quaternion=quaternion)
    return camera.render(eyes, arena.at(room, time), *hexapod.eye_poses(pose))
