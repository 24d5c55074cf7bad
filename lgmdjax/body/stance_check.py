"""Whether a robot of one's own can stand and walk: its feet in a key frame, reach and limits of legs, and torque."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.body.leg_frames import MAX_TILT, LegFrames, Source
from lgmdjax.body.robot_description import Description
from lgmdjax.body.robot_xml import JOINTS, LEGS
from lgmdjax.geometry import rotation_matrix
from lgmdjax.locomotion import kinematics, tripod_gait
from lgmdjax.locomotion.kinematics import LegGeometry
from lgmdjax.locomotion.shaping import MAX_VELOCITY, MIN_VELOCITY
from lgmdjax.locomotion.tripod_gait import Gait

PHASES = 24  # of the cycle that are checked
VELOCITIES = (MIN_VELOCITY, 0.0, MAX_VELOCITY)  # nominal; the extremes of the stride, and standing
MAX_MISS = 1e-3  # m, of a foot that its leg cannot reach
MAX_UNEVEN = 0.01  # m, between the feet of a key frame, in height and from left to right
SETTLING_TIME = 2.0  # s
MAX_SAG = 0.25  # of the height, by which a robot may sink when it stands


def feet_of_key(
    source: Source, legs: Sequence[LegFrames], geometry: LegGeometry
) -> tuple[Float[np.ndarray, "3 2"], float]:
    """Return neutral positions of the left feet and the height of the trunk above them [m], from the key frame."""
    model, description, name = source.model, source.description, source.description.stance or ""
    qpos = model.key_qpos[source.find("key", name, "stance")]
    trunk = model.jnt_qposadr[model.body_jntadr[source.find("body", description.trunk, "trunk")]]
    if rotation_matrix(qpos[trunk + 3 : trunk + 7])[2, 2] < np.cos(MAX_TILT):
        raise description.error("stance", "a key frame with a level trunk", f"{name}, which tilts", "level it")
    for joint, angle in description.locked.items():
        if abs(qpos[model.jnt_qposadr[source.find("joint", joint, "locked")]] - angle) > MAX_TILT:
            raise description.error("stance", f"{joint} at its locked angle", "another one", "change one of the two")
    angles = np.stack([leg.to_angles(qpos[model.jnt_qposadr[list(leg.joints)]]) for leg in legs])
    feet = np.asarray(jax.jit(kinematics.forward)(geometry, jnp.asarray(angles, dtype=float)), float)
    left, right = feet[:3], feet[:2:-1] * [1, -1, 1]
    uneven = max(np.ptp(feet[:, 2]), np.abs(left - right).max())
    if uneven > MAX_UNEVEN:
        raise description.error(
            "stance", f"feet at one height, and left and right alike, within {1e3 * MAX_UNEVEN:.0f} mm",
            f"{1e3 * uneven:.0f} mm in {name}", "correct the key frame, or leave `stance` out",
        )  # fmt: skip
    return (0.5 * (left + right))[:, :2], float(-feet[:, 2].mean())


def check_gait(
    description: Description, geometry: LegGeometry, gait: Gait, set_points: Float[np.ndarray, "18 2"]
) -> Float[np.ndarray, "6 3"]:
    """Return the joint angles of the stance [rad]; raise `InputError` if a leg cannot walk the gait."""
    phase, velocity = np.meshgrid(np.arange(PHASES) / PHASES, VELOCITIES, indexing="ij")
    stance, missed, targets = (
        np.asarray(part, float)
        for part in _walk(geometry, gait, *(jnp.asarray(part.ravel(), dtype=float) for part in (phase, velocity)))
    )
    for leg, miss in zip(LEGS, missed.max(axis=0), strict=True):
        if miss > MAX_MISS:
            raise description.error(
                f"legs.{leg}", "a leg that reaches every point of its step",
                f"one that is {1e3 * miss:.0f} mm too short", "give a key frame `stance` with feet closer to the trunk",
            )  # fmt: skip
    lowest, highest = (np.degrees(part).reshape(18) for part in (targets.min(axis=0), targets.max(axis=0)))
    for number, (low, high) in enumerate(np.degrees(set_points)):
        if lowest[number] < low or highest[number] > high:
            leg, joint = divmod(number, 3)
            raise description.error(
                f"legs.{LEGS[leg]}",
                f"a {JOINTS[joint]} from {lowest[number]:.0f} to {highest[number]:.0f} deg, as the gait needs",
                f"limits of {low:.0f} to {high:.0f} deg (angles of this package)",
                "widen the range in the MJCF, or give another key frame `stance`",
            )  # fmt: skip
    return stance


@jax.jit
def _walk(
    geometry: LegGeometry, gait: Gait, phase: Float[Array, " n"], velocity: Float[Array, " n"]
) -> tuple[Float[Array, "6 3"], Float[Array, "n 6"], Float[Array, "n 6 3"]]:
    """Return the stance [rad], by how much the feet miss their step [m], and the servos' targets [rad]."""
    neutral = tripod_gait.neutral_feet(gait)
    phase, velocity = (jnp.repeat(part[:, None], 6, axis=1) for part in (phase, velocity))
    feet = neutral + tripod_gait.foot_path(gait, phase, velocity)
    reached = kinematics.forward(geometry, kinematics.inverse(geometry, feet))
    missed = jnp.max(jnp.abs(reached - feet), axis=-1)
    return kinematics.inverse(geometry, neutral), missed, tripod_gait.joint_targets(geometry, gait, phase, velocity)


def settle(description: Description, model: mujoco.MjModel) -> float:
    """Return the height of the trunk [m] after the robot has stood for a while; raise `InputError` if it doesn't."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stance").id)
    start = data.qpos[2]
    for _ in range(round(SETTLING_TIME / model.opt.timestep)):
        mujoco.mj_step(model, data)
    height, level = float(data.qpos[2]), float(rotation_matrix(data.qpos[3:7])[2, 2])
    if not (abs(height - start) < MAX_SAG * start and level > np.cos(5 * MAX_TILT)):
        tilt = np.degrees(np.arccos(np.clip(level, -1, 1)))
        raise description.error(
            "mjcf", f"servos that hold the robot {1e3 * start:.0f} mm above the floor",
            f"{1e3 * height:.0f} mm and a tilt of {tilt:.0f} deg after {SETTLING_TIME:g} s",
            "check masses, gains (kp) and torque limits (forcerange)",
        )  # fmt: skip
    return height
