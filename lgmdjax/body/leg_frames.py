"""Legs of any MJCF in the coordinates of this package: lengths, frames, and the angles that its joints stand for.

A leg has three hinges: the coxa turns about a vertical axis, femur and tibia about parallel horizontal ones, and the
foot is in the vertical plane through the coxa's axis. Everything else may differ from `mjcf/hexapod.xml`: names, order,
frames, signs and zeros of the joints. An angle q of the MJCF stands for the angle a of this package

    a = s q + o.

| symbol  | name                                                             | unit | here           |
| ------- | ---------------------------------------------------------------- | ---- | -------------- |
| d       | direction of a leg: horizontal, from the coxa's axis to the foot | 1    | -              |
| s       | sign: 1 or -1                                                    | 1    | signs          |
| o       | angle at which the joint of the MJCF is zero                     | rad  | offsets        |
| psi     | yaw of the leg in the middle of the coxa's range                 | rad  | mount_yaw      |

Everything is measured in one pose, in the frame of the trunk: x forward, y left, z up.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from lgmdjax.body.robot_description import Description, suggest
from lgmdjax.body.robot_xml import JOINTS

MAX_TILT = np.radians(2.0)  # of an axis from the direction that it should have
MAX_OFFSET = 0.003  # m, of a foot from the plane of its leg
MIN_LENGTH = 0.01  # m, of femur and tibia
UP = np.array([0.0, 0.0, 1.0])
COUNTS = {"body": "nbody", "joint": "njnt", "geom": "ngeom", "site": "nsite", "key": "nkey"}  # fields of a model


class Source(NamedTuple):
    """A user's MJCF in the pose in which it is measured."""

    description: Description
    model: mujoco.MjModel
    data: mujoco.MjData
    rotation: Float[np.ndarray, "3 3"]  # from the frame with x forward to the world
    origin: Float[np.ndarray, "3"]  # m, of the MJCF's trunk

    def to_trunk(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Return points of the world [m] in the frame of the trunk."""
        return (points - self.origin) @ self.rotation

    def find(self, kind: str, name: str, key: str) -> int:
        """Return the id of a joint, geom, site, body or key frame; raise `InputError` if there is none."""
        names = [getattr(self.model, kind)(index).name for index in range(getattr(self.model, COUNTS[kind]))]
        if name not in names:
            expected = f"the name of a {kind} of {self.description.mjcf.name}"
            raise self.description.error(key, expected, repr(name), suggest(name, [one for one in names if one]))
        return names.index(name)


class Frame(NamedTuple):
    """Pose of a link in the trunk's frame: its position [m], and the rotation to the trunk's axes."""

    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]


class LegFrames(NamedTuple):
    """A leg in the coordinates of this package."""

    joints: tuple[int, ...]  # ids in the MJCF
    mount: Float[np.ndarray, "3"]  # m
    mount_yaw: float  # rad
    lengths: Float[np.ndarray, "3"]  # m, coxa, femur, tibia
    foot_radius: float  # m
    foot_friction: float
    foot_geom: int  # id in the MJCF; -1 if a site is the foot
    signs: Float[np.ndarray, "3"]
    offsets: Float[np.ndarray, "3"]  # rad
    frames: tuple[Frame, Frame, Frame]  # of the three links in the measured pose

    def to_angles(self, joints: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return the angles of this package [rad] for those of the MJCF's joints."""
        return self.signs * joints + self.offsets

    def to_range(self, limits: Float[np.ndarray, "3 2"]) -> Float[np.ndarray, "3 2"]:
        """Return limits of the MJCF's joints [rad] as those of this package's angles."""
        return np.sort(self.signs[:, None] * limits + self.offsets[:, None], axis=1)


def measure(source: Source, leg: str) -> LegFrames:
    """Measure a leg; raise `InputError` if it is not a leg as described above."""
    model, data, described = source.model, source.data, source.description.legs[leg]
    key = f"legs.{leg}.joints"
    joints = tuple(source.find("joint", name, key) for name in described.joints)
    _check_chain(source, leg, joints)
    anchors, axes = source.to_trunk(data.xanchor[list(joints)]), data.xaxis[list(joints)] @ source.rotation
    foot, radius, friction, geom = _find_foot(source, leg, int(model.jnt_bodyid[joints[2]]))
    _check_axes(source, leg, axes)
    direction, turn = _direction(axes[1], foot - anchors[0])
    aside = float((foot - anchors[0]) @ np.cross(UP, direction))
    if abs(aside) > MAX_OFFSET:
        raise source.description.error(
            f"legs.{leg}", "a foot in the vertical plane through the coxa's axis",
            f"one {1e3 * abs(aside):.1f} mm beside it", "align the leg's parts in the MJCF",
        )  # fmt: skip
    # In the plane of the leg: along its direction, and up. Points on an axis may be anywhere along it.
    femur, tibia = ([part @ direction, part[2]] for part in (anchors[2] - anchors[1], foot - anchors[2]))
    lengths = np.array([(anchors[1] - anchors[0]) @ direction, np.hypot(*femur), np.hypot(*tibia)])
    if lengths[0] < 0 or lengths[1:].min() < MIN_LENGTH:
        got = ", ".join(f"{name} {1e3 * length:.0f} mm" for name, length in zip(JOINTS, lengths, strict=True))
        raise source.description.error(
            key, f"a coxa that points outward, femur and tibia of {1e3 * MIN_LENGTH:.0f} mm or more", got,
            "name the joints from the trunk to the foot",
        )  # fmt: skip
    values = data.qpos[model.jnt_qposadr[list(joints)]]
    lift = np.arctan2(femur[1], femur[0])
    bend = np.arctan2(tibia[0], -tibia[1]) - lift
    signs = np.array([np.sign(axes[0, 2]), turn, turn * np.sign(axes[1] @ axes[2])])
    coxa = signs[0] * (values[0] - model.jnt_range[joints[0]].mean())
    angles = np.array([coxa, lift, _wrap(bend)])
    yaw = np.arctan2(direction[1], direction[0])
    mount = np.append(anchors[0, :2], anchors[1, 2])
    return LegFrames(
        joints=joints,
        mount=mount,
        mount_yaw=float(_wrap(yaw - coxa)),
        lengths=lengths,
        foot_radius=radius,
        foot_friction=friction,
        foot_geom=geom,
        signs=signs,
        offsets=angles - signs * values,
        frames=_frames(mount, yaw, lengths, angles),
    )


def with_mount_yaw(leg: LegFrames, mount_yaw: float) -> LegFrames:
    """Return a leg whose coxa is at zero where the leg points in another direction [rad]."""
    turned = np.array([_wrap(mount_yaw - leg.mount_yaw), 0.0, 0.0])
    return leg._replace(mount_yaw=mount_yaw, offsets=leg.offsets - turned)


def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _check_chain(source: Source, leg: str, joints: tuple[int, ...]) -> None:
    """Raise `InputError` unless the joints are hinges with limits, each in a body of its own, one after the other."""
    model, error, key = source.model, source.description.error, f"legs.{leg}.joints"
    before = source.find("body", source.description.trunk, "trunk")
    for joint in joints:
        name, body = model.joint(joint).name, int(model.jnt_bodyid[joint])
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            raise error(key, "hinges", f"{name}, which is none", "change its type in the MJCF")
        if not model.jnt_limited[joint]:
            raise error(key, "joints with limits", f"{name} without a range", "add range= to it in the MJCF")
        if before not in _ancestors(model, body):
            raise error(
                key, f"{name} in a body of its own below {model.body(before).name}", f"it in {model.body(body).name}",
                "name coxa, femur and tibia from the trunk to the foot",
            )  # fmt: skip
        before = body


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the ids of the bodies that a body is in, without the world."""
    found = []
    while body := int(model.body_parentid[body]):
        found.append(body)
    return found


def _check_axes(source: Source, leg: str, axes: Float[np.ndarray, "3 3"]) -> None:
    """Raise `InputError` unless the first axis is vertical, and the others are horizontal and parallel."""
    names, error, key = source.description.legs[leg].joints, source.description.error, f"legs.{leg}.joints"
    steepness = np.arcsin(np.minimum(np.abs(axes[:, 2]), 1.0))
    tilts = np.abs(steepness - [np.pi / 2, 0.0, 0.0])
    for name, tilt, wanted in zip(names, tilts, ("vertical", "horizontal", "horizontal"), strict=True):
        if tilt > MAX_TILT:
            raise error(
                key, f"a {wanted} axis of {name}", f"one {np.degrees(tilt):.0f} deg from that",
                "name coxa, femur and tibia in this order, or turn the axis in the MJCF",
            )  # fmt: skip
    angle = np.arccos(min(abs(axes[1] @ axes[2]), 1.0))
    if angle > MAX_TILT:
        raise error(
            key, f"parallel axes of {names[1]} and {names[2]}", f"axes {np.degrees(angle):.0f} deg apart",
            "turn one of them in the MJCF",
        )  # fmt: skip


def _find_foot(source: Source, leg: str, tibia: int) -> tuple[Float[np.ndarray, "3"], float, float, int]:
    """Return centre [m], radius [m] and friction of a foot, and its geom's id, or -1 for a site."""
    model, data, name = source.model, source.data, source.description.legs[leg].foot
    key = f"legs.{leg}.foot"
    geoms, sites = (
        [getattr(model, kind)(i).name for i in range(getattr(model, COUNTS[kind]))] for kind in ("geom", "site")
    )
    is_site = name in sites and name not in geoms
    index = source.find("site" if is_site else "geom", name, key)
    kind, size, body, place, friction = (
        (model.site_type, model.site_size, model.site_bodyid, data.site_xpos, 1.0)
        if is_site
        else (model.geom_type, model.geom_size, model.geom_bodyid, data.geom_xpos, float(model.geom_friction[index, 0]))
    )
    if kind[index] != mujoco.mjtGeom.mjGEOM_SPHERE:
        raise source.description.error(
            key, "a sphere", f"{name} of another shape", "add a spherical site there, with the radius of the foot"
        )
    if tibia not in (body[index], *_ancestors(model, int(body[index]))):
        raise source.description.error(
            key, f"a foot on the body of {source.description.legs[leg].joints[2]}", f"{name} elsewhere",
            "name the foot of this leg",
        )  # fmt: skip
    return source.to_trunk(place[index]), float(size[index, 0]), friction, -1 if is_site else index


def _direction(axis: Float[np.ndarray, "3"], outward: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the direction of a leg whose femur turns about `axis`, and the sign of lifting about it."""
    level = np.array([axis[0], axis[1], 0.0]) / np.hypot(axis[0], axis[1])
    direction = np.cross(UP, level)
    turn = 1.0 if direction @ outward >= 0 else -1.0
    return turn * direction, turn


def _frames(mount: np.ndarray, yaw: float, lengths: np.ndarray, angles: np.ndarray) -> tuple[Frame, Frame, Frame]:
    """Return the frames of the links: x along coxa and femur, z against the tibia."""
    coxa = Frame(mount, np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]]))
    femur = Frame(mount + lengths[0] * coxa.rotation[:, 0], coxa.rotation @ _lifted(angles[1]))
    tibia = Frame(femur.position + lengths[1] * femur.rotation[:, 0], femur.rotation @ _lifted(angles[2]))
    return coxa, femur, tibia


def _lifted(angle: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
