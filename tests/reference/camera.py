"""A fisheye picture by brute force: many rays per pixel, each cast into the room in NumPy, in float64.

Written from the geometry and from the definition of the patterns. There is no filter; a pixel is the mean of its rays.
"""

from typing import NamedTuple

import numpy as np

from lgmdjax.world.texture import PHASES, WAVES, WEIGHTS


class Picture(NamedTuple):
    grey: np.ndarray  # (rows, columns), mean of the samples
    edge: np.ndarray  # (rows, columns), True where the samples hit more than one surface
    distance: np.ndarray  # (rows, columns), of the last sample of a pixel [m], inf in the sky


def picture(arena, position, rotation, width, height, fov, samples=64, bands=3, columns=slice(None)) -> Picture:
    """Render the picture of one eye with `samples` rays per pixel."""
    rows, cols = np.arange(height), np.arange(width)[columns]
    total, edge = np.zeros((len(rows), len(cols))), np.zeros((len(rows), len(cols)), bool)
    first = distance = None
    for u, v in lattice(samples):
        rays = directions(cols[None, :] + u, rows[:, None] + v, width, height, fov) @ np.asarray(rotation).T
        distance, thing = trace(arena, np.asarray(position), rays)
        first = thing if first is None else first
        edge |= thing != first
        total += paint(arena, np.asarray(position), rays, distance, thing, bands)
    assert distance is not None
    return Picture(total / samples, edge, distance)


def lattice(samples):
    """Return points in the unit square whose coordinates are all different.

    A square grid of 64 points has only eight columns: an upright edge would move in steps of an eighth of a pixel.
    """
    i = np.arange(samples)
    return np.stack([(i + 0.5) / samples, ((i * 0.6180339887498949) + 0.5) % 1.0], axis=-1)


def directions(u, v, width, height, fov):
    """Return unit vectors (x forward, y left, z up) of points in the picture; the radius is the angle from the axis."""
    right, down = np.broadcast_arrays(u - width / 2, v - height / 2)
    angle = np.hypot(right, down) * fov / width
    around = np.arctan2(down, right)
    return np.stack([np.cos(angle), -np.sin(angle) * np.cos(around), -np.sin(angle) * np.sin(around)], axis=-1)


def trace(arena, origin, rays):
    """Return distance and index of the surface that each ray hits: -1 sky, 0 floor, 1..4 walls, boxes, cylinders."""
    with np.errstate(divide="ignore", invalid="ignore"):
        best, thing = np.full(rays.shape[:-1], np.inf), np.full(rays.shape[:-1], -1)

        def meet(distance, number):
            nearer = distance < best
            best[nearer], thing[nearer] = distance[nearer], number

        down = rays[..., 2] < 0
        meet(np.where(down, -origin[2] / rays[..., 2], np.inf), 0)
        for wall, bound in enumerate(np.asarray(arena.bounds)):
            axis = wall // 2
            ahead = rays[..., axis] > 0 if wall % 2 else rays[..., axis] < 0
            distance = np.where(ahead, (bound - origin[axis]) / rays[..., axis], np.inf)
            point = origin + np.where(np.isfinite(distance), distance, 0.0)[..., None] * rays
            low, high = np.asarray(arena.bounds)[[2 - 2 * axis, 3 - 2 * axis]]
            across = point[..., 1 - axis]
            inside = (across >= low) & (across <= high) & (point[..., 2] <= arena.wall_height)
            meet(np.where(inside & (point[..., 2] >= 0), distance, np.inf), 1 + wall)
        for number, box in enumerate(_rows(arena.boxes)):
            meet(_box(box, origin, rays), 5 + number)
        for number, cylinder in enumerate(_rows(arena.cylinders)):
            meet(_cylinder(cylinder, origin, rays), 5 + len(np.asarray(arena.boxes.yaw)) + number)
    return best, thing


def paint(arena, origin, rays, distance, thing, bands):
    """Return the grey level of the surface that each ray hits."""
    point = origin + np.where(np.isfinite(distance), distance, 0.0)[..., None] * rays
    floor_and_walls = np.concatenate([np.asarray(arena.floor_texture)[None], np.asarray(arena.wall_texture)])
    textures = np.concatenate([floor_and_walls, np.asarray(arena.boxes.texture), np.asarray(arena.cylinders.texture)])
    centres = np.concatenate([np.zeros((5, 2)), np.asarray(arena.boxes.centre), np.asarray(arena.cylinders.centre)])
    number = np.maximum(thing, 0)
    brightness, contrast, phase, scale = np.moveaxis(textures[number], -1, 0)
    point[..., :2] -= centres[number]
    point[..., 1] *= float(arena.handedness)
    weights = np.asarray(WEIGHTS[:bands]) / sum(WEIGHTS[:bands])
    pattern = np.zeros(thing.shape)
    for wave, weight, factor in zip(WAVES, weights, PHASES, strict=False):
        turns = point @ np.asarray(wave) / scale + factor * phase / (2 * np.pi)
        part = (turns + 0.5) % 1.0 - 0.5
        pattern += weight * 8.0 * part * (1.0 - 2.0 * np.abs(part))
    grey = brightness + np.minimum(contrast * brightness, 255.0 - brightness) * pattern
    return np.where(thing < 0, float(arena.sky), grey)


def _rows(prisms):
    fields = ("centre", "half_size", "yaw", "bottom", "top")
    columns = [np.asarray(getattr(prisms, name), float) for name in fields]
    return [dict(zip(fields, row, strict=True)) for row in zip(*columns, strict=True)]


def _box(box, origin, rays):
    cosine, sine = np.cos(box["yaw"]), np.sin(box["yaw"])
    turn = np.array([[cosine, sine], [-sine, cosine]])
    start = np.append(turn @ (origin[:2] - box["centre"]), origin[2])
    heading = np.concatenate([rays[..., :2] @ turn.T, rays[..., 2:]], axis=-1)
    low = np.append(-box["half_size"], box["bottom"])
    high = np.append(box["half_size"], box["top"])
    near, far = (low - start) / heading, (high - start) / heading
    enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
    return np.where((leave >= enter) & (enter > 0), enter, np.inf)


def _cylinder(cylinder, origin, rays):
    radius = cylinder["half_size"][0]
    o = origin[:2] - cylinder["centre"]
    a = (rays[..., :2] ** 2).sum(axis=-1)
    b = (rays[..., :2] * o).sum(axis=-1)
    root = np.sqrt(b * b - a * (o @ o - radius**2))
    enter, leave = (-b - root) / a, (-b + root) / a
    low, high = ((cylinder[end] - origin[2]) / rays[..., 2] for end in ("bottom", "top"))
    enter, leave = np.maximum(enter, np.minimum(low, high)), np.minimum(leave, np.maximum(low, high))
    return np.where((leave >= enter) & (enter > 0), enter, np.inf)
