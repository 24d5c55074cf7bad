"""A measured robot as an MJCF in the form of `mjcf/hexapod.xml`: the package's file with the robot's numbers.

Names, order of the servos, barriers, contact pairs and solver options stay those of the package. Trunk and links get
the measured masses; their geoms are replaced by the shapes that are drawn (group 2), and by the capsules that collide
with obstacles (group 3). The gait's numbers are custom numbers of the model (`tripod_gait.read_gait`).
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from lgmdjax.body import robot_xml
from lgmdjax.body.leg_frames import LegFrames
from lgmdjax.body.link_shapes import Bumper, Inertia, Shape
from lgmdjax.body.robot_xml import CAPSULES, EYES, JOINTS, LEGS
from lgmdjax.locomotion import tripod_gait
from lgmdjax.locomotion.tripod_gait import Gait

DRAWN, TOUCHED = 2, 3  # groups of geoms


class Servo(NamedTuple):
    """A joint and its position servo; angles are those of this package."""

    limits: Float[np.ndarray, "2"]  # rad, of the joint
    set_points: Float[np.ndarray, "2"]  # rad
    torque: Float[np.ndarray, "2"]  # N m, lowest and highest
    gain: float  # N m/rad
    damping: float  # N m s/rad, of the servo
    joint_damping: Float[np.ndarray, "3"]  # as in the MJCF
    armature: float  # kg m2
    friction: float  # N m


class Measured(NamedTuple):
    """All numbers of a robot."""

    name: str
    legs: Sequence[LegFrames]  # by `LEGS`
    servos: Sequence[Servo]  # leg by leg
    inertias: Sequence[Inertia]  # of trunk and links
    shapes: Sequence[Sequence[Shape]]  # of trunk and links, that are drawn
    radii: Float[np.ndarray, "6 2"]  # m, of femur and tibia
    bumper: Bumper
    sensors: Float[np.ndarray, "3 3"]  # m, left eye, right eye, laser scanner


class Stance(NamedTuple):
    """How a robot stands, and how it walks from there."""

    gait: Gait
    angles: Float[np.ndarray, "6 3"]  # rad
    height: float  # m, of the trunk's centre above the floor


def write(robot: Measured, stance: Stance) -> str:
    """Return the MJCF."""
    spec = robot_xml.read_spec()
    spec.modelname = robot.name
    spec.comment = "Made by lgmdjax from an MJCF and its description (lgmdjax.body.custom_robot)."
    for geom in list(spec.geoms):
        if geom.parent.name != "world" and geom.name not in (*CAPSULES, *(f"{leg}_foot" for leg in LEGS)):
            spec.delete(geom)
    _write_trunk(spec, robot)
    for index, (leg, frames) in enumerate(zip(LEGS, robot.legs, strict=True)):
        _write_leg(spec, leg, frames, robot.radii[index])
        for joint, name in enumerate(f"{leg}_{joint}" for joint in JOINTS):
            link = 1 + 3 * index + joint
            _set_link(spec.body(name), robot.inertias[link], robot.shapes[link])
            _set_servo(spec, name, robot.servos[link - 1])
    _write_stance(spec, stance)
    spec.compile()
    # MuJoCo writes six digits, and the time step must divide a camera frame.
    return re.sub(r'timestep="[^"]*"', f'timestep="{spec.option.timestep!r}"', spec.to_xml())


def _write_trunk(spec: mujoco.MjSpec, robot: Measured) -> None:
    _set_link(spec.body("trunk"), robot.inertias[0], robot.shapes[0])
    bumper, geom = robot.bumper, spec.geom("bumper")
    geom.size[0] = bumper.radius
    front = max(bumper.front, bumper.back + 1e-4)  # MuJoCo wants a capsule of some length
    geom.fromto[:] = [bumper.back, 0, bumper.height, front, 0, bumper.height]
    for site, position in zip((*EYES, "laser"), robot.sensors, strict=True):
        spec.site(site).pos[:] = position


def _write_leg(spec: mujoco.MjSpec, leg: str, frames: LegFrames, radii: Float[np.ndarray, "2"]) -> None:
    coxa, femur, tibia = frames.lengths
    spec.body(f"{leg}_coxa").pos[:] = frames.mount
    spec.body(f"{leg}_coxa").alt.euler[:] = [0, 0, np.degrees(frames.mount_yaw)]
    spec.body(f"{leg}_femur").pos[:] = [coxa, 0, 0]
    spec.body(f"{leg}_tibia").pos[:] = [femur, 0, 0]
    for part, end, radius in (("femur", [femur, 0, 0], radii[0]), ("tibia", [0, 0, -tibia], radii[1])):
        geom = spec.geom(f"{leg}_{part}")
        geom.fromto[:] = [0, 0, 0, *end]
        geom.size[0], geom.mass, geom.group = radius, 0.0, TOUCHED
        geom.material, geom.rgba[:] = "", [0.9, 0.2, 0.2, 0.3]
    foot = spec.geom(f"{leg}_foot")
    foot.pos[:] = spec.site(f"{leg}_foot").pos[:] = [0, 0, -tibia]
    foot.size[0] = frames.foot_radius
    foot.friction[0] = frames.foot_friction
    pair = next(pair for pair in spec.pairs if pair.geomname2 == foot.name)
    pair.friction[:2] = frames.foot_friction


def _set_link(body: mujoco.MjsBody, inertia: Inertia, shapes: Sequence[Shape]) -> None:
    """Set mass and inertia of a body, and add the shapes that are drawn."""
    tensor = inertia.tensor
    body.explicitinertial, body.mass = True, inertia.mass
    body.ipos[:] = inertia.centre
    body.fullinertia[:] = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]
    for shape in shapes:
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, shape.rotation.ravel())
        body.add_geom(
            type=mujoco.mjtGeom(shape.kind), size=shape.size, pos=shape.position, quat=quaternion, rgba=shape.colour,
            mass=0.0, contype=0, conaffinity=0, group=DRAWN,
        )  # fmt: skip


def _set_servo(spec: mujoco.MjSpec, name: str, servo: Servo) -> None:
    joint, actuator = spec.joint(name), spec.actuator(name)
    joint.range[:] = np.degrees(servo.limits)
    joint.damping[:] = servo.joint_damping
    joint.armature, joint.frictionloss = servo.armature, servo.friction
    actuator.gainprm[0] = servo.gain
    actuator.biasprm[:3] = [0.0, -servo.gain, -servo.damping]
    actuator.inheritrange = 0.0
    actuator.ctrlrange[:] = servo.set_points
    actuator.forcerange[:] = servo.torque


def _write_stance(spec: mujoco.MjSpec, stance: Stance) -> None:
    spec.body("trunk").pos[:] = [0, 0, stance.height]
    key, angles = spec.key("stance"), stance.angles.reshape(18)
    key.qpos = [0.0, 0.0, stance.height, 1.0, 0.0, 0.0, 0.0, *angles]
    key.ctrl = angles
    numbers = tripod_gait.to_numbers(stance.gait)
    spec.add_numeric(name=tripod_gait.NUMERIC, size=len(numbers), data=numbers)
