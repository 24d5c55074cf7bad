"""Independent models of the robot: C MuJoCo with the same barriers, and a tripod gait by trigonometry in NumPy."""

import mujoco
import numpy as np

# robot.md: m and degrees, in the order left front, left middle, left rear, right rear, right middle, right front
MOUNTS = np.array([(0.125, 0.062), (0, 0.1), (-0.125, 0.062), (-0.125, -0.062), (0, -0.1), (0.125, -0.062)])
MOUNT_YAWS = np.radians([45, 90, 135, -135, -90, -45])
COXA, FEMUR, TIBIA = 0.052, 0.066, 0.133


def with_barriers(model: mujoco.MjModel, placed) -> mujoco.MjModel:
    """Copy the barriers of an `mjx.Model` to a model of C MuJoCo and return it."""
    for name in ("geom_pos", "geom_quat"):
        getattr(model, name)[:] = np.asarray(getattr(placed, name))
    model.geom_sameframe[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE] = 0  # they are no longer aligned with the body
    return model


def angles(feet: np.ndarray) -> np.ndarray:
    """Return joint angles (6, 3) of feet (6, 3) in the trunk frame, from the triangle hip, knee, foot (knee up)."""
    x, y = (feet[:, :2] - MOUNTS).T
    coxa = (np.arctan2(y, x) - MOUNT_YAWS + np.pi) % (2 * np.pi) - np.pi
    reach, drop = np.hypot(x, y) - COXA, -feet[:, 2]
    span = np.hypot(reach, drop)
    knee = np.arccos((FEMUR**2 + TIBIA**2 - span**2) / (2 * FEMUR * TIBIA))
    femur = np.arccos((FEMUR**2 + span**2 - TIBIA**2) / (2 * FEMUR * span)) - np.arctan2(drop, reach)
    return np.stack([coxa, femur, knee - np.pi / 2], axis=-1)


def tripod(steps: int, velocity: tuple[float, float], neutral_feet: np.ndarray) -> np.ndarray:
    """Return joint angles (steps, 6, 3) of a tripod gait at (left, right) [m/s], one row for each 1/180 s."""
    sides = np.repeat(velocity, 3)
    rows = []
    for time in np.arange(steps) / 180:
        phase = (time + np.array([0.0, 0.5] * 3)) % 1.0  # of a cycle of 1 s; stance in its first half
        swing = np.clip(2 * phase - 1, 0, 1)
        along = np.where(phase < 0.5, 0.5 - 2 * phase, swing - np.sin(2 * np.pi * swing) / (2 * np.pi) - 0.5)
        feet = neutral_feet.copy()
        feet[:, 0] += along * sides * 0.5
        feet[:, 2] += 0.01 * (1 - np.cos(2 * np.pi * swing))
        rows.append(angles(feet))
    return np.stack(rows)
