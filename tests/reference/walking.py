"""Simulation of a walk in C MuJoCo from the XML alone, and the quantities that a person would measure on it."""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

XML = Path(__file__).parents[2] / "mjcf" / "hexapod.xml"


class Trajectory(NamedTuple):
    """One row per physics step, and means."""

    position: np.ndarray  # (steps, 3) m
    roll: np.ndarray  # (steps,) degrees
    pitch: np.ndarray
    yaw: np.ndarray
    feet: np.ndarray  # (steps, 6, 3) m, world
    speed: float  # m/s along the heading
    yaw_rate: float  # rad/s


def simulate(targets, settled=3.0):
    """Simulate servo targets (steps, 6, 3) on an empty floor; means exclude the first `settled` seconds."""
    model = mujoco.MjModel.from_xml_path(str(XML))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stance").id)
    feet = [geom for geom in range(model.ngeom) if (model.geom(geom).name or "").endswith("_foot")]
    poses, foot_positions = [], []
    for angles in np.asarray(targets, float):
        data.ctrl[:] = angles.ravel()
        mujoco.mj_step(model, data)
        poses.append(data.qpos[:7].copy())
        foot_positions.append(data.geom_xpos[feet].copy())
    return summarise(np.array(poses), np.array(foot_positions), model.opt.timestep, settled)


def summarise(poses, feet, timestep, settled):
    """Return the trajectory of trunk poses (steps, 7) and feet (steps, 6, 3)."""
    w, x, y, z = poses[:, 3:].T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    first = round(settled / timestep)
    steps = np.diff(poses[first:, :2], axis=0)
    forward = steps[:, 0] * np.cos(yaw[first:-1]) + steps[:, 1] * np.sin(yaw[first:-1])
    duration = len(steps) * timestep
    return Trajectory(
        position=poses[:, :3],
        roll=np.degrees(roll),
        pitch=np.degrees(pitch),
        yaw=np.degrees(yaw),
        feet=feet,
        speed=forward.sum() / duration,
        yaw_rate=(yaw[-1] - yaw[first]) / duration,
    )
