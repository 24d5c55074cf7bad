"""Rooms as models of C MuJoCo, and distances in the plane for single points."""

import mujoco
import numpy as np

from lgmdjax.world.arena import Arena


def to_mjcf(arena: Arena) -> str:
    """Return a room at rest as MJCF: floor, four thick walls, and the active obstacles, named by kind and row."""
    x_min, x_max, y_min, y_max = (float(value) for value in arena.bounds)
    height, thick = float(arena.wall_height), 1.0
    x, y = (x_min + x_max) / 2, (y_min + y_max) / 2
    a, b = (x_max - x_min) / 2 + 2 * thick, (y_max - y_min) / 2 + 2 * thick
    geoms = ['<geom name="floor" type="plane" size="0 0 1"/>']
    walls = [
        ((x_min - thick, y), (thick, b)),
        ((x_max + thick, y), (thick, b)),
        ((x, y_min - thick), (a, thick)),
        ((x, y_max + thick), (a, thick)),
    ]
    for index, (centre, half) in enumerate(walls):
        geoms.append(_geom(f"wall{index}", "box", centre, (*half, height / 2), 0.0, height / 2))
    for kind, prisms in (("box", arena.boxes), ("cylinder", arena.cylinders)):
        for row in range(prisms.yaw.shape[0]):
            low, high = float(prisms.bottom[row]), float(prisms.top[row])
            if high <= 0:
                continue
            half = np.asarray(prisms.half_size[row])
            size = (*half, (high - low) / 2) if kind == "box" else (half[0], (high - low) / 2)
            centre = np.asarray(prisms.centre[row])
            geoms.append(_geom(f"{kind}{row}", kind, centre, size, float(prisms.yaw[row]), (low + high) / 2))
    return f'<mujoco><compiler angle="radian"/><worldbody>{"".join(geoms)}</worldbody></mujoco>'


def _geom(name: str, kind: str, centre, size, yaw: float, z: float) -> str:
    numbers = " ".join(repr(float(value)) for value in size)
    x, y = (float(value) for value in centre)
    return f'<geom name="{name}" type="{kind}" pos="{x!r} {y!r} {z!r}" size="{numbers}" euler="0 0 {yaw!r}"/>'


def load(xml: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Compile a model and compute the poses of its geoms."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def ray(model: mujoco.MjModel, data: mujoco.MjData, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Cast single rays (n, 3) with C `mj_ray`; inf where nothing is hit."""
    geom = np.zeros(1, dtype=np.int32)
    hits = [
        mujoco.mj_ray(model, data, origin, direction, None, True, -1, geom)
        for origin, direction in zip(origins, directions, strict=True)
    ]
    return np.where(np.asarray(hits) < 0, np.inf, hits)


def segment(start: np.ndarray, end: np.ndarray, count: int = 400) -> np.ndarray:
    """Return points along a segment, including its ends."""
    return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)


def point_to_room(arena: Arena, points: np.ndarray) -> np.ndarray:
    """Return the signed distance of plane points (n, 2) to the nearest wall or obstacle that is not overhead."""
    x_min, x_max, y_min, y_max = np.asarray(arena.bounds)
    x, y = points.T
    nearest = np.min([x - x_min, x_max - x, y - y_min, y_max - y], axis=0)
    for row in range(arena.cylinders.yaw.shape[0]):
        if arena.cylinders.bottom[row] < 0.35:
            away = np.linalg.norm(points - np.asarray(arena.cylinders.centre[row]), axis=1)
            nearest = np.minimum(nearest, away - float(arena.cylinders.half_size[row, 0]))
    for row in range(arena.boxes.yaw.shape[0]):
        if arena.boxes.bottom[row] < 0.35:
            yaw, half = float(arena.boxes.yaw[row]), np.asarray(arena.boxes.half_size[row])
            axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
            over = np.abs((points - np.asarray(arena.boxes.centre[row])) @ axes.T) - half
            outside = np.linalg.norm(np.maximum(over, 0.0), axis=1)
            nearest = np.minimum(nearest, outside + np.minimum(np.max(over, axis=1), 0.0))
    return nearest
