"""Pictures of recorded walks, rendered again from the recorded poses, since pictures are not stored."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.body import hexapod
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop, rollout, sharding
from lgmdjax.simulation.closed_loop import AnyArray, Record
from lgmdjax.world import arena

FRAMES_PER_CALL = 30  # rendered by one call of the compiled program; the last call is padded


def render_walks(
    camera_params: camera.Params, rooms: arena.Arena, record: Record
) -> Float[np.ndarray, "robots frames 2 height columns"]:
    """Render the pictures of recorded walks, grey levels 0..255: bit for bit those of the rollout on the same machine.

    One program renders all frames, so that any part of a walk gives the same bits. They equal those of the rollout if
    the whole batch is rendered on equally many devices. For batches of another size the compiler may round differently,
    by a few thousandths of a grey level in single precision.

    Args:
        camera_params: the stereo camera.
        rooms: the arena of each robot; moving obstacles are placed for the time of each frame.
        record: axes (robot, frame), as from `episodes.stack_walks`.
    """
    poses = [np.asarray(leaf) for leaf in (record.time, record.position, record.quaternion)]
    frames = poses[0].shape[1]
    parts = []
    for first in range(0, frames, FRAMES_PER_CALL):
        padded = np.minimum(np.arange(first, first + FRAMES_PER_CALL), frames - 1)
        pictures = _render_frames(camera_params, rooms, *(leaf[:, padded] for leaf in poses))
        parts.append(np.asarray(pictures)[:, : frames - first])
    return np.concatenate(parts, axis=1)


@partial(jax.jit, static_argnames="camera_params")
def _render_frames(
    camera_params: camera.Params, rooms: arena.Arena, *poses: AnyArray
) -> Float[Array, "robots frames 2 height columns"]:
    """Render in a loop over frames as `rollout.rollout_batch` does, which gives the same rounding."""

    def step(room: arena.Arena, _: None, pose: tuple[AnyArray, AnyArray, AnyArray]) -> tuple[None, Array]:
        return None, render_pose(camera_params, room, *pose)

    return sharding.shard_robots(lambda rooms, *poses: rollout.scan_batch(step, rooms, None, poses)[1], rooms, *poses)


def render_pose(
    camera_params: camera.Params,
    room: arena.Arena,
    time: Float[AnyArray, ""],
    position: Float[AnyArray, "3"],
    quaternion: Float[AnyArray, "4"],
) -> Float[Array, "2 height columns"]:
    """Render both cameras from a pose of the trunk [m, 1] at a time [s], for which moving obstacles are placed."""
    pose = hexapod.Pose(position=jnp.asarray(position), quaternion=jnp.asarray(quaternion))
    return closed_loop.render_stereo(camera_params, arena.at_time(room, jnp.asarray(time)), pose)
