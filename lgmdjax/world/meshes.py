"""Closed triangle meshes of obstacles, with normals and texture coordinates.

| symbol | name                                             | unit |
| ------ | ------------------------------------------------ | ---- |
| -      | vertices, about the middle of the obstacle's foot | m    |
| s, t   | texture coordinates, 1 for a whole texture        | 1    |

The vertices of a triangle are in counter-clockwise order as seen from outside. A vertex on an edge of the surface
occurs once for each face that meets there, with the normal of that face.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

SIDES = 32  # faces of a cylinder, whose radius is then at most half a percent too small


UP = np.array([0.0, 0.0, 1.0])


class Mesh(NamedTuple):
    """A mesh with a normal and texture coordinates for each vertex."""

    vertices: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    texture: Float[np.ndarray, "vertices 2"]
    triangles: Int[np.ndarray, "triangles 3"]


def box(half_size: Float[np.ndarray, "2"], bottom: float, top: float, tile: float) -> Mesh:
    """Return an upright box whose texture repeats every `tile` [m]."""
    a, b = half_size
    corners = np.array([[a, -b], [a, b], [-a, b], [-a, -b]])
    normals = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    ends = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    sides = _walls(ends, np.repeat(normals[:, None], 2, axis=1), (bottom, top), tile)
    return _join(sides, *_caps(corners, (bottom, top), tile))


def cylinder(radius: float, bottom: float, top: float, tile: float) -> Mesh:
    """Return an upright cylinder of `SIDES` faces, shaded as if it were round."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normals = np.stack([circle, np.roll(circle, -1, axis=0)], axis=1)
    return _join(_walls(radius * normals, normals, (bottom, top), tile), *_caps(radius * circle, (bottom, top), tile))


def sphere(radius: float, tile: float) -> Mesh:
    """Return a sphere that lies on the floor."""
    rows, columns = SIDES // 2 + 1, SIDES + 1
    polar, angle = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns), indexing="ij")
    normals = np.stack([np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)], axis=-1)
    texture = np.stack([angle, polar], axis=-1) * radius / tile
    vertices = radius * (normals + UP)
    index = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    flat = vertices.reshape(-1, 3)
    corners = flat[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return Mesh(flat, normals.reshape(-1, 3), texture.reshape(-1, 2), triangles[area > 1e-9])  # no area at poles


def rock(
    half_size: Float[np.ndarray, "2"], top: float, tile: float, rng: np.random.Generator, points: int = 40
) -> Mesh:
    """Return a convex rock within an upright ellipsoid: the hull of random points on it, with flat faces."""
    directions = rng.standard_normal((points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cloud = (directions + UP) * [*half_size, top / 2]
    hull = ConvexHull(cloud)
    corners = cloud[hull.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.sum(normals * hull.equations[:, :3], axis=1) < 0
    corners[inward] = corners[inward][:, ::-1]
    normals = hull.equations[:, None, :3].repeat(3, axis=1).reshape(-1, 3)
    vertices = corners.reshape(-1, 3)
    texture = np.stack([vertices[:, 0] + vertices[:, 1], vertices[:, 2]], axis=1) / tile
    return Mesh(vertices, normals, texture, np.arange(len(vertices)).reshape(-1, 3))


def _walls(ends: np.ndarray, normals: np.ndarray, heights: tuple[float, float], tile: float) -> Mesh:
    """Return upright rectangles over the lines between `ends` (n, 2, 2), with the normals (n, 2, 2) at these points."""
    count = len(ends)
    z = np.broadcast_to(np.asarray(heights)[:, None], (count, 2, 2))
    vertices = np.concatenate([np.repeat(ends[:, None], 2, axis=1), z[..., None]], axis=-1)
    flat = np.concatenate([np.repeat(normals[:, None], 2, axis=1), np.zeros((count, 2, 2, 1))], axis=-1)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    along = np.concatenate([[0], np.cumsum(length)])
    s = np.broadcast_to(np.stack([along[:-1], along[1:]], axis=1)[:, None], (count, 2, 2))
    texture = np.stack([s, z], axis=-1) / tile
    first = 4 * np.arange(count)[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 3]), first + np.array([0, 3, 2])])
    return Mesh(vertices.reshape(-1, 3), flat.reshape(-1, 3), texture.reshape(-1, 2), triangles)


def _caps(outline: np.ndarray, heights: tuple[float, float], tile: float) -> tuple[Mesh, Mesh]:
    """Return the bottom and the top face of a prism over a convex outline in counter-clockwise order."""
    count = len(outline)
    fan = np.stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=1)
    lower, upper = (
        Mesh(
            np.column_stack([outline, np.full(count, z)]),
            np.broadcast_to([0.0, 0.0, up], (count, 3)),
            outline / tile,
            fan if up > 0 else fan[:, ::-1],
        )
        for z, up in zip(heights, (-1.0, 1.0), strict=True)
    )
    return lower, upper


def _join(*parts: Mesh) -> Mesh:
    """Return several meshes as one."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [part.triangles + offset for part, offset in zip(parts, first, strict=False)]
    vertices, normals, texture = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return Mesh(vertices, normals, texture, np.concatenate(triangles))
