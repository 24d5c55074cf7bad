"""A walk in C MuJoCo, from the XML alone, and what a person would measure on it."""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

XML = Path(__file__).parents[2] / "mjcf" / "hexapod.xml"


class Walk(NamedTuple):
    """Rows are physics steps."""

    position: np.ndarray  # (steps, 3) m
    roll: np.ndarray  # (steps,) degrees
    pitch: np.ndarray
    yaw: np.ndarray
    feet: np.ndarray  # (steps, 6, 3) m, world
    speed: float  # m/s along the heading
    yaw_rate: float  # rad/s


def walk(targets, settled=3.0):
    """Walk on the empty floor at servo targets (steps, 6, 3); means leave out the first `settled` seconds."""
    model = mujoco.MjModel.from_xml_path(str(XML))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stance").id)
    feet = [geom for geom in range(model.ngeom) if (model.geom(geom).name or "").endswith("_foot")]
    poses, trails = [], []
    for angles in np.asarray(targets, float):
        data.ctrl[:] = angles.ravel()
        mujoco.mj_step(model, data)
        poses.append(data.qpos[:7].copy())
        trails.append(data.geom_xpos[feet].copy())
    return measured(np.array(poses), np.array(trails), model.opt.timestep, settled)


def measured(poses, feet, timestep, settled):
    """Read a walk off trunk poses (steps, 7) and feet (steps, 6, 3)."""
    w, x, y, z = poses[:, 3:].T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    first = round(settled / timestep)
    moves = np.diff(poses[first:, :2], axis=0)
    ahead = moves[:, 0] * np.cos(yaw[first:-1]) + moves[:, 1] * np.sin(yaw[first:-1])
    seconds = len(moves) * timestep
    return Walk(
        position=poses[:, :3],
        roll=np.degrees(roll),
        pitch=np.degrees(pitch),
        yaw=np.degrees(yaw),
        feet=feet,
        speed=ahead.sum() / seconds,
        yaw_rate=(yaw[-1] - yaw[first]) / seconds,
    )
