"""Where on its body a robot touched what, from its record and its room.

A record has the pose at the beginning of a frame, not that of the touch within it, and before the next frame the robot
is set back. The poses in between are taken to go on as from the frame before. Of 368 frames that passed something by
less than 3 cm and went on, this gave a point 1 mm (median; at most 7 mm) from that of the poses on the way to the next
frame, and another limb once.

Seen from above: x ahead of the trunk's centre, y to its left [m]. What stands on the floor is higher than the robot, so
that touching is a problem in the plane (`lgmdjax.world.arena`).

Works on host records, in double precision whatever the walks were recorded in.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from numpy import ndarray

from lgmdjax.body import hexapod
from lgmdjax.evaluation.metrics import yaws
from lgmdjax.simulation.closed_loop import SUBSTEPS, Record
from lgmdjax.world import arena, obstacles

SAMPLES = 65  # points along a limb: 3 mm apart on the trunk, 2 mm on the legs


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """What of a room can be touched: obstacles that stand on the floor, and walls."""

    names: list[str]  # box, wall or cylinder, in the order of `nearest`
    boxes: obstacles.Prisms  # walls too
    cylinders: obstacles.Prisms


class Touch(NamedTuple):
    """What of the robot touched what."""

    limb: str  # a name of `hexapod.CAPSULES`
    point: Float[ndarray, "2"]  # m, seen from above
    surface: int  # in the order of `nearest`


def surfaces(room: arena.Arena, time: float) -> Surfaces:
    """List what can be touched, where it is at `time` [s]; in the same order at any time."""
    boxes, cylinders = jax.tree.map(lambda leaf: np.asarray(leaf, float), _solids(room, time))
    walls = np.arange(len(boxes.yaw)) >= len(boxes.yaw) - 4
    names = np.append(np.where(walls, "wall", "box"), np.full(len(cylinders.yaw), "cylinder"))
    square, round_ = (~(arena.is_overhead(solids) | obstacles.is_parked(solids)) for solids in (boxes, cylinders))
    return Surfaces(
        names=names[np.append(square, round_)].tolist(),
        boxes=jax.tree.map(lambda leaf: leaf[square], boxes),
        cylinders=jax.tree.map(lambda leaf: leaf[round_], cylinders),
    )


@jax.jit
def _solids(room: arena.Arena, time: Array | float) -> tuple[obstacles.Prisms, obstacles.Prisms]:
    """Put the boxes, with the walls as the last four, and the cylinders where they are at `time` [s]."""
    scene = arena.at(room, time)
    return obstacles.join(scene.boxes, _walls(scene)), scene.cylinders


def _walls(room: arena.Arena) -> obstacles.Prisms:
    """Turn the walls into four boxes of 1 m behind their inner faces, in the order of `room`."""
    x_min, x_max, y_min, y_max = room.room
    x, y, half = 0.5 * (x_min + x_max), 0.5 * (y_min + y_max), 0.5
    length, width = 0.5 * (x_max - x_min) + 1.0, 0.5 * (y_max - y_min) + 1.0
    centre = [[x_min - half, y], [x_max + half, y], [x, y_min - half], [x, y_max + half]]
    half_size = [[half, width], [half, width], [length, half], [length, half]]
    boxes = obstacles.place(jnp.asarray(centre), jnp.asarray(half_size), room.wall_height, count=4)
    return jax.tree.map(lambda leaf: leaf.astype(room.room.dtype), boxes)


def nearest(surfaces: Surfaces, points: Float[ndarray, "n 2"]) -> Float[ndarray, "n surfaces 2"]:
    """Find the point of each surface that is nearest to each point [m, world]; inside one, the point itself."""
    boxes, cylinders = surfaces.boxes, surfaces.cylinders
    yaw = np.asarray(boxes.yaw)
    own = _turned(points[:, None] - boxes.centre, -yaw)
    on_boxes = boxes.centre + _turned(np.clip(own, -boxes.half_size, boxes.half_size), yaw)
    out = points[:, None] - cylinders.centre
    share = cylinders.half_size[:, 0] / np.maximum(np.linalg.norm(out, axis=-1), 1e-9)
    on_cylinders = cylinders.centre + out * np.minimum(share, 1.0)[..., None]
    return np.concatenate([on_boxes, on_cylinders], axis=1)


def touch(walk: Record, around: Surfaces) -> Touch:
    """Find what touched in the last frame of an unbroken walk of one robot, frames first."""
    poses = substeps(walk)
    starts, ends, radii = capsules(poses)
    share = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    axes = starts[..., None, :] + share * (ends - starts)[..., None, :]
    towards = nearest(around, axes.reshape(-1, 2)).reshape(*axes.shape[:-1], -1, 2) - axes[..., None, :]
    distance = np.linalg.norm(towards, axis=-1)
    where = np.unravel_index(np.argmin(distance - radii[:, None, None]), distance.shape)
    substep, limb, _, surface = map(int, where)
    point = axes[where[:-1]] + radii[limb] * towards[where] / max(distance[where], 1e-9)
    position, quaternion = poses[[substep], :3], poses[[substep], 3:7]
    return Touch(hexapod.CAPSULES[limb], seen(position, quaternion, point[None])[0], surface)


def substeps(walk: Record) -> Float[ndarray, "substeps 25"]:
    """Go on from the last two frames of a walk through the poses (qpos) whose clearance was looked at.

    They are those at the start of each substep (`hexapod.capsules`): the first is the recorded one. A robot that was
    just put down stands still.
    """
    angles = np.reshape(walk.joints, (-1, 18))
    poses = np.concatenate([walk.position, walk.quaternion, angles], axis=1)[-2:].astype(float)
    return poses[-1] + np.arange(SUBSTEPS)[:, None] / SUBSTEPS * (poses[-1] - poses[0])


def capsules(
    poses: Float[ndarray, "n 25"],
) -> tuple[Float[ndarray, "n shapes 2"], Float[ndarray, "n shapes 2"], Float[ndarray, " shapes"]]:
    """Find both ends [m, world, from above] and radii [m] of what collides (`hexapod.CAPSULES`) in so many poses."""
    model = hexapod.load()
    data = mujoco.MjData(model)
    ids = [model.geom(name).id for name in hexapod.CAPSULES]
    ends = []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        along = data.geom_xmat[ids].reshape(-1, 3, 3)[..., 2] * model.geom_size[ids, 1, None]
        ends.append([data.geom_xpos[ids] - along, data.geom_xpos[ids] + along])
    starts, ends = np.moveaxis(np.array(ends)[..., :2], 1, 0)
    return starts, ends, model.geom_size[ids, 0]


def seen(
    position: Float[ndarray, "frames *#n 3"],
    quaternion: Float[ndarray, "frames *#n 4"],
    points: Float[ndarray, "frames *#n 2"],
) -> Float[ndarray, "frames ... 2"]:
    """Tell where points of the world are as a robot sees them from above [m]: ahead, to the left."""
    return _turned(points - position[..., :2], -yaws(quaternion))


def _turned(vectors: ndarray, angles: ndarray) -> ndarray:
    """Turn plane vectors by angles [rad], counter-clockwise; as `prisms.turned`, but on the host."""
    turned = (vectors[..., 0] + 1j * vectors[..., 1]) * np.exp(1j * angles)
    return np.stack([turned.real, turned.imag], axis=-1)
