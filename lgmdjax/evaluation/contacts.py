"""Where on its body a robot touched which surface, computed from its recorded walk and its room.

A record has the pose at the start of a frame, not at the moment of contact within the frame, and before the next frame
the robot is reset. The poses within the frame are therefore extrapolated from the last two frames. This was checked on
368 frames without contact that passed something at less than 3 cm, where the next pose is known:

| extrapolated against interpolated poses | result                 |
| --------------------------------------- | ---------------------- |
| distance of the nearest point           | median 1 mm, max. 7 mm |
| another limb was nearest                | once                   |

Coordinates on the robot are seen from above: x ahead of the trunk's centre, y to its left [m]. What stands on the floor
is higher than the robot, so contact is a problem in the plane (`lgmdjax.world.arena`).

Works on host records, always in double precision.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from numpy import ndarray

from lgmdjax import geometry
from lgmdjax.body import robot_xml
from lgmdjax.body.robot_xml import Body
from lgmdjax.simulation.closed_loop import SUBSTEPS, Record
from lgmdjax.world import arena, obstacles

AXIS_SAMPLES = 65  # points along the axis of a limb: 3 mm apart on the trunk, 2 mm on the legs


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """The surfaces of a room that a robot can touch: obstacles that stand on the floor, and walls."""

    kinds: list[str]  # box, wall or cylinder, in the order of `nearest_points`
    boxes: obstacles.Prisms  # the walls are the last four
    cylinders: obstacles.Prisms


class Contact(NamedTuple):
    """A contact: limb, point on the robot and surface."""

    limb: str  # a name of `robot_xml.CAPSULES`
    point: Float[ndarray, "2"]  # m, on the robot, seen from above
    surface: int  # index in the order of `nearest_points`


def touchable_surfaces(room: arena.Arena, time: float) -> Surfaces:
    """List the surfaces that can be touched, at their positions at `time` [s]; the order is the same at any time."""
    boxes, cylinders = jax.tree.map(lambda leaf: np.asarray(leaf, float), _obstacles_at(room, time))
    is_wall = np.arange(len(boxes.yaw)) >= len(boxes.yaw) - 4
    kinds = np.append(np.where(is_wall, "wall", "box"), np.full(len(cylinders.yaw), "cylinder"))
    solid_boxes, solid_cylinders = (
        ~(arena.is_overhead(prisms) | obstacles.is_inactive(prisms)) for prisms in (boxes, cylinders)
    )
    return Surfaces(
        kinds=kinds[np.append(solid_boxes, solid_cylinders)].tolist(),
        boxes=jax.tree.map(lambda leaf: leaf[solid_boxes], boxes),
        cylinders=jax.tree.map(lambda leaf: leaf[solid_cylinders], cylinders),
    )


@jax.jit
def _obstacles_at(room: arena.Arena, time: Array | float) -> tuple[obstacles.Prisms, obstacles.Prisms]:
    """Return boxes, with the walls as the last four, and cylinders at their positions at `time` [s]."""
    scene = arena.at_time(room, time)
    return obstacles.concatenate(scene.boxes, _wall_boxes(scene)), scene.cylinders


def _wall_boxes(room: arena.Arena) -> obstacles.Prisms:
    """Convert the walls into four boxes, 1 m thick, behind their inner faces, in the order of `bounds`."""
    x_min, x_max, y_min, y_max = room.bounds
    x, y, half = 0.5 * (x_min + x_max), 0.5 * (y_min + y_max), 0.5
    length, width = 0.5 * (x_max - x_min) + 1.0, 0.5 * (y_max - y_min) + 1.0
    centre = [[x_min - half, y], [x_max + half, y], [x, y_min - half], [x, y_max + half]]
    half_size = [[half, width], [half, width], [length, half], [length, half]]
    boxes = obstacles.make_prisms(jnp.asarray(centre), jnp.asarray(half_size), room.wall_height, capacity=4)
    return jax.tree.map(lambda leaf: leaf.astype(room.bounds.dtype), boxes)


def nearest_points(surfaces: Surfaces, points: Float[ndarray, "n 2"]) -> Float[ndarray, "n surfaces 2"]:
    """Find the point of each surface nearest to each given point [m, world]; inside a surface, the point itself."""
    boxes, cylinders = surfaces.boxes, surfaces.cylinders
    yaw = np.asarray(boxes.yaw)
    local = geometry.rotate_recorded(points[:, None] - boxes.centre, -yaw)
    on_boxes = boxes.centre + geometry.rotate_recorded(np.clip(local, -boxes.half_size, boxes.half_size), yaw)
    offset = points[:, None] - cylinders.centre
    fraction = cylinders.half_size[:, 0] / np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    on_cylinders = cylinders.centre + offset * np.minimum(fraction, 1.0)[..., None]
    return np.concatenate([on_boxes, on_cylinders], axis=1)


def locate_contact(walk: Record, surfaces: Surfaces, body: Body | None = None) -> Contact:
    """Locate the contact in the last frame of a walk of one robot without resets; axis (frame,)."""
    poses = extrapolate_substeps(walk)
    starts, ends, radii = collision_capsules(poses, body)
    fraction = np.linspace(0.0, 1.0, AXIS_SAMPLES)[:, None]
    axes = starts[..., None, :] + fraction * (ends - starts)[..., None, :]
    offset = nearest_points(surfaces, axes.reshape(-1, 2)).reshape(*axes.shape[:-1], -1, 2) - axes[..., None, :]
    distance = np.linalg.norm(offset, axis=-1)
    nearest = np.unravel_index(np.argmin(distance - radii[:, None, None]), distance.shape)
    substep, limb, _, surface = map(int, nearest)
    point = axes[nearest[:-1]] + radii[limb] * offset[nearest] / max(distance[nearest], 1e-9)
    position, quaternion = poses[[substep], :3], poses[[substep], 3:7]
    return Contact(robot_xml.CAPSULES[limb], to_body_frame(position, quaternion, point[None])[0], surface)


def extrapolate_substeps(walk: Record) -> Float[ndarray, "substeps 25"]:
    """Extrapolate the last two frames of a walk to the poses (qpos) of the substeps whose clearance was computed.

    They are the poses at the start of each substep (`hexapod.capsules`); the first is the recorded one. If the walk has
    a single frame, the robot stands still.
    """
    angles = np.reshape(walk.joints, (-1, 18))
    poses = np.concatenate([walk.position, walk.quaternion, angles], axis=1)[-2:].astype(float)
    return poses[-1] + np.arange(SUBSTEPS)[:, None] / SUBSTEPS * (poses[-1] - poses[0])


def collision_capsules(
    poses: Float[ndarray, "n 25"], body: Body | None = None
) -> tuple[Float[ndarray, "n capsules 2"], Float[ndarray, "n capsules 2"], Float[ndarray, " capsules"]]:
    """Compute both ends [m, world, from above] and radii [m] of the capsules that collide (`hexapod.CAPSULES`)."""
    model = robot_xml.compiled(body)
    data = mujoco.MjData(model)
    ids = [model.geom(name).id for name in robot_xml.CAPSULES]
    ends = []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        half_axis = data.geom_xmat[ids].reshape(-1, 3, 3)[..., 2] * model.geom_size[ids, 1, None]
        ends.append([data.geom_xpos[ids] - half_axis, data.geom_xpos[ids] + half_axis])
    starts, ends = np.moveaxis(np.array(ends)[..., :2], 1, 0)
    return starts, ends, model.geom_size[ids, 0]


def to_body_frame(
    position: Float[ndarray, "frames *#n 3"],
    quaternion: Float[ndarray, "frames *#n 4"],
    points: Float[ndarray, "frames *#n 2"],
) -> Float[ndarray, "frames ... 2"]:
    """Transform points of the world into the robot's frame, seen from above [m]: ahead, to the left."""
    return geometry.rotate_recorded(points - position[..., :2], -geometry.yaw(np.asarray(quaternion, dtype=float)))
