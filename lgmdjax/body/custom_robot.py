"""A robot of one's own: an MJCF and its description (`robot_description`) become a body in this package's form.

```python
robot = custom_robot.read(Path("my_robot.toml"))
model = hexapod.load(robot.body)  # with the names of mjcf/hexapod.xml
```

The MJCF has a trunk with a free joint and six legs of three hinges (`leg_frames`), each moved by a position servo. What
is not named there is read: lengths, masses, limits, gains, friction. Whatever cannot be used raises an `InputError`
that says what was expected, what the file has, and what to do.

The gait keeps the package's speed, 0.05 m/s at v = 1, and its rhythm. Its feet are those of the key frame `stance`, or
without one they follow from the angles of the package's stance. The height of a step grows with the legs.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from lgmdjax.body import canonical_mjcf, robot_description, robot_parts, robot_xml, six_legs, stance_check
from lgmdjax.body.canonical_mjcf import Measured, Stance
from lgmdjax.body.leg_frames import LegFrames, Source
from lgmdjax.body.robot_description import Description
from lgmdjax.body.robot_xml import JOINTS, LEGS, Body
from lgmdjax.errors import one_line
from lgmdjax.locomotion import kinematics
from lgmdjax.locomotion.tripod_gait import Gait
from lgmdjax.runtime import checksums
from lgmdjax.runtime.storage import JsonObject

MAX_WIDTH_RATIO = 1.4  # of the stance to that of the package's robot, for which rooms and trials are made


class CustomRobot(NamedTuple):
    """A body of one's own, and what was read about it."""

    name: str
    digest: str  # of the files that it was read from
    body: Body
    facts: JsonObject


def read(path: Path) -> CustomRobot:
    """Read the robot that a TOML file describes; raise `InputError` for one that cannot be used."""
    description = robot_description.read(path)
    source, legs = six_legs.measure(_open(description))
    robot = robot_parts.measure(source, legs)
    draft = Stance(Gait(), robot_xml.stance(), 0.1)
    geometry = kinematics.read_geometry(_write(description, robot, draft)[1])
    gait = _choose_gait(source, legs, geometry)
    set_points = np.stack([servo.set_points for servo in robot.servos])
    angles = stance_check.check_gait(description, geometry, gait, set_points)
    stance = Stance(gait, angles, float(gait.body_height) + float(geometry.foot_radius))
    settled = stance_check.settle(description, _write(description, robot, stance)[1])
    stance = stance._replace(height=settled)
    body, _ = _write(description, robot, stance)
    return CustomRobot(path.stem, _digest(source), body, _facts(description, robot, stance))


def _digest(source: Source) -> str:
    """Return a hash of the TOML file, and of the MJCF with the files that it includes."""
    spec = mujoco.MjSpec.from_file(str(source.description.mjcf))
    spec.compile()
    parts = (source.description.path.read_bytes(), spec.to_xml().encode(), source.model.mesh_vert.tobytes())
    return checksums.digest(*parts)[:16]


def _open(description: Description) -> Source:
    """Compile the MJCF, and put it in the pose in which it is measured: its reference, with the locked joints set."""
    try:
        model = mujoco.MjModel.from_xml_path(str(description.mjcf))
    except ValueError as error:
        raise description.error("mjcf", "a MuJoCo model", f"one that fails: {one_line(error)}", "correct it") from None
    data = mujoco.MjData(model)
    source = Source(description, model, data, np.eye(3), np.zeros(3))
    trunk = source.find("body", description.trunk, "trunk")
    joints = range(model.body_jntadr[trunk], model.body_jntadr[trunk] + model.body_jntnum[trunk])
    if [model.jnt_type[joint] for joint in joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise description.error("trunk", "a body with a free joint", f"{description.trunk}", "add <freejoint/> to it")
    for name, angle in description.locked.items():
        joint = source.find("joint", name, "locked")
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            raise description.error("locked", "hinges", f"{name}, which is none", "remove the joint from the MJCF")
        data.qpos[model.jnt_qposadr[joint]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    c, s = np.cos(description.forward), np.sin(description.forward)
    rotation = data.xmat[trunk].reshape(3, 3) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return source._replace(rotation=rotation, origin=data.xpos[trunk].copy())


def _choose_gait(source: Source, legs: Sequence[LegFrames], geometry: kinematics.LegGeometry) -> Gait:
    """Return the package's gait with the feet of the key frame, or of the package's posture, and a scaled step."""
    if source.description.stance is None:
        feet, height = _package_posture(legs[:3])
    else:
        feet, height = stance_check.feet_of_key(source, legs, geometry)
    own = kinematics.read_geometry(robot_xml.compiled())
    length = np.mean([leg.lengths[1:].sum() for leg in legs])
    gait = replace(
        Gait(),
        left_feet=tuple((float(x), float(y)) for x, y in feet),
        body_height=height,
        swing_height=float(Gait().swing_height) * float(length) / float(own.femur + own.tibia),
    )
    ratio = gait.width_ratio()
    if not 1 / MAX_WIDTH_RATIO <= ratio <= MAX_WIDTH_RATIO:
        raise source.description.error(
            "stance", "feet 0.29 to 0.56 m apart, since rooms and trials are made for a robot of 0.4 m",
            f"{0.4 * ratio:.2f} m", "choose another stance, or scale the robot",
        )  # fmt: skip
    return gait


def _package_posture(legs: Sequence[LegFrames]) -> tuple[Float[np.ndarray, "3 2"], float]:
    """Return neutral positions of the left feet and the height of the trunk above them [m].

    Femur and tibia have the angles of the package's stance, and the feet are in the same directions from the coxae.
    """
    femur, tilt = robot_xml.stance()[:3, 1], robot_xml.stance()[:3, 1:].sum(axis=1)
    lengths, mounts = np.stack([leg.lengths for leg in legs]), np.stack([leg.mount for leg in legs])
    reach = lengths[:, 0] + lengths[:, 1] * np.cos(femur) + lengths[:, 2] * np.sin(tilt)
    rise = lengths[:, 1] * np.sin(femur) - lengths[:, 2] * np.cos(tilt)
    away = np.array(Gait().left_feet) - np.asarray(kinematics.read_geometry(robot_xml.compiled()).mounts)[:3, :2]
    feet = mounts[:, :2] + reach[:, None] * away / np.linalg.norm(away, axis=1, keepdims=True)
    return feet, float(-np.mean(mounts[:, 2] + rise))


def _write(description: Description, robot: Measured, stance: Stance) -> tuple[Body, mujoco.MjModel]:
    """Return the body of a robot, and its model."""
    try:
        body = Body(canonical_mjcf.write(robot, stance))
        return body, robot_xml.load(body)
    except ValueError as error:
        raise description.error(
            "mjcf", "masses and sizes that MuJoCo accepts", one_line(error), "correct the MJCF"
        ) from None


def _facts(description: Description, robot: Measured, stance: Stance) -> JsonObject:
    """Return what was read, for people."""
    return {
        "name": robot.name,
        "mjcf": description.mjcf.name,
        "mass": sum(inertia.mass for inertia in robot.inertias),
        "trunk_mass": robot.inertias[0].mass,
        "lengths": {
            leg: dict(zip(JOINTS, part.lengths.tolist(), strict=True))
            for leg, part in zip(LEGS, robot.legs, strict=True)
        },
        "joints": {
            f"{leg}_{joint}": {
                "name": description.legs[leg].joints[j],
                "sign": int(part.signs[j]),
                "offset_deg": float(np.degrees(part.offsets[j])),
            }
            for leg, part in zip(LEGS, robot.legs, strict=True)
            for j, joint in enumerate(JOINTS)
        },
        "shape": robot.bumper._asdict(),
        "eyes": robot.sensors[:2].tolist(),
        "scanner": robot.sensors[2].tolist(),
        "height": stance.height,
        "left_feet": stance.gait.left_feet,
        "swing_height": float(stance.gait.swing_height),
        "locked_deg": {joint: float(np.degrees(angle)) for joint, angle in description.locked.items()},
    }
