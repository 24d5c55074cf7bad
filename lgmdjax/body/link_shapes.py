"""Masses and shapes of the links of any MJCF: trunk, and coxa, femur and tibia of six legs.

A link is all bodies that move together: those without a joint, or with a locked one, belong to the link that carries
them. Masses and inertias are added up. A leg's femur and tibia collide as capsules along the link, as thick as its
thickest geom of that direction; the trunk as the smallest capsule along x that holds the geoms of its shape, seen from
above, where all contacts with obstacles are.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from lgmdjax.body.leg_frames import Frame, LegFrames, Source

TRUNK = 0  # number of the link; the others are 1 + 3 leg + joint
DRAWN_GROUPS = (0, 1, 2)  # that MuJoCo's viewer shows
ALONG = np.cos(np.radians(45.0))  # least cosine between a geom and the link along which it lies
RADII = np.linspace(1.0, 1.5, 101)  # of the capsules that are tried for a trunk, in its half width
OUTLINE = 16  # points around the end of a cylinder, and around an ellipsoid
PRIMITIVES = {
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX,
}


class Inertia(NamedTuple):
    """Mass and inertia of a link, in its frame."""

    mass: float  # kg
    centre: Float[np.ndarray, "3"]  # m
    tensor: Float[np.ndarray, "3 3"]  # kg m2, about the centre


class Shape(NamedTuple):
    """A geom as it is drawn, in the frame of its link."""

    kind: int
    size: Float[np.ndarray, "3"]  # m
    position: Float[np.ndarray, "3"]  # m
    rotation: Float[np.ndarray, "3 3"]
    colour: Float[np.ndarray, "4"]


class Bumper(NamedTuple):
    """A capsule along the trunk's x axis."""

    back: float  # m, x of its ends, without the caps
    front: float
    height: float  # m, z
    radius: float  # m

    def front_at(self, y: float) -> float:
        """Return the largest x [m] within the capsule at some y; -inf beside it."""
        return self.front + np.sqrt(self.radius**2 - y**2) if abs(y) < self.radius else -np.inf


def links_of_bodies(source: Source, legs: Sequence[LegFrames]) -> Int[np.ndarray, " bodies"]:
    """Return the number of the link of each body; -1 for the world and for what is no part of the robot."""
    model, trunk = source.model, source.find("body", source.description.trunk, "trunk")
    moving = [int(model.jnt_bodyid[joint]) for leg in legs for joint in leg.joints]
    links = np.full(model.nbody, -1)
    for body in range(1, model.nbody):  # parents come first
        parent = links[model.body_parentid[body]]
        links[body] = TRUNK if body == trunk else 1 + moving.index(body) if body in moving else parent
    return links


def inertia(source: Source, bodies: Sequence[int], frame: Frame) -> Inertia:
    """Return mass and inertia of some bodies that move together."""
    model, data, rows = source.model, source.data, list(bodies)
    masses = model.body_mass[rows]
    total = float(masses.sum())
    centres = (source.to_trunk(data.xipos[rows]) - frame.position) @ frame.rotation
    centre = masses @ centres / max(total, 1e-12)
    tensor = np.zeros((3, 3))
    for body, mass, own in zip(rows, masses, centres, strict=True):
        axes = frame.rotation.T @ source.rotation.T @ data.ximat[body].reshape(3, 3)
        away = own - centre
        tensor += axes @ np.diag(model.body_inertia[body]) @ axes.T
        tensor += mass * (away @ away * np.eye(3) - np.outer(away, away))
    return Inertia(total, centre, tensor)


def geoms_of(model: mujoco.MjModel, bodies: Sequence[int]) -> list[int]:
    """Return the ids of the geoms of some bodies, without planes and height fields."""
    flat = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    return [
        geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in bodies and model.geom_type[geom] not in flat
    ]


def shape(source: Source, geom: int, frame: Frame) -> Shape:
    """Return a geom in the frame of its link; a mesh as the box around it."""
    model, data = source.model, source.data
    rotation = frame.rotation.T @ source.rotation.T @ data.geom_xmat[geom].reshape(3, 3)
    position = (source.to_trunk(data.geom_xpos[geom]) - frame.position) @ frame.rotation
    kind, size = int(model.geom_type[geom]), model.geom_size[geom].copy()
    if kind not in PRIMITIVES:
        centre, size = np.split(model.geom_aabb[geom], 2)
        kind, position = int(mujoco.mjtGeom.mjGEOM_BOX), position + rotation @ centre
    material = model.geom_matid[geom]
    colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    return Shape(kind, size, position, rotation, colour.astype(float))


def is_drawn(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether MuJoCo's viewer shows a geom."""
    return int(model.geom_group[geom]) in DRAWN_GROUPS and bool(model.geom_rgba[geom, 3] > 0)


def half_sizes(shape: Shape) -> Float[np.ndarray, "3"]:
    """Return half the length of a shape along each of its axes [m]."""
    a, b, _ = shape.size
    sizes = {
        mujoco.mjtGeom.mjGEOM_SPHERE: [a, a, a],
        mujoco.mjtGeom.mjGEOM_CAPSULE: [a, a, a + b],
        mujoco.mjtGeom.mjGEOM_CYLINDER: [a, a, b],
    }
    return np.array(sizes.get(mujoco.mjtGeom(shape.kind), shape.size), float)


def thickness(shapes: Sequence[Shape], along: int, default: float) -> float:
    """Return the radius [m] of a link: that of the thickest of its shapes that lie along its axis number `along`.

    Without such shapes it is `default`.
    """
    radii = []
    for one in shapes:
        _, middle, longest = np.argsort(half_sizes(one))
        if one.kind != mujoco.mjtGeom.mjGEOM_SPHERE and abs(one.rotation[along, longest]) > ALONG:
            radii.append(float(half_sizes(one)[middle]))
    return max(radii, default=default)


def cover(shapes: Sequence[Shape]) -> Bumper:
    """Return the smallest capsule along x that holds shapes of the trunk, seen from above.

    A disc of radius r at (x, y) is inside a capsule of radius R whose axis ends at x_end if |y| + r <= R and, beyond
    the end, (x - x_end)^2 + y^2 <= (R - r)^2.
    """
    discs = np.concatenate([_discs(one) for one in shapes])
    x, y, z, r = discs.T
    radii = np.max(np.abs(y) + r) * RADII[:, None]
    within = np.sqrt(np.maximum((radii - r) ** 2 - y**2, 0.0))
    front, back = np.max(x - within, axis=1), np.min(x + within, axis=1)
    length = np.maximum(front - back, 0.0)
    best = int(np.argmin(2 * radii[:, 0] * length + np.pi * radii[:, 0] ** 2))
    middle = 0.5 * (front[best] + back[best])
    return Bumper(
        back=float(middle - 0.5 * length[best]),
        front=float(middle + 0.5 * length[best]),
        height=float(0.5 * (z.min() + z.max())),
        radius=float(radii[best, 0]),
    )


def _discs(one: Shape) -> Float[np.ndarray, "n 4"]:
    """Return spheres (x, y, z, radius) [m] whose convex hull is a shape: exactly, or that of points on its outline."""
    a, b, _ = one.size
    turn = np.linspace(0.0, 2 * np.pi, OUTLINE, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    match mujoco.mjtGeom(one.kind):
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            points, radius = np.zeros((1, 3)), a
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            points, radius = np.array([[0, 0, -b], [0, 0, b]]), a
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            points, radius = np.concatenate([a * circle + [0, 0, z] for z in (-b, b)]), 0.0
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            rings = [np.roll(circle, k, axis=1) for k in range(3)]
            points, radius = np.concatenate(rings) * one.size, 0.0
        case _:
            corners = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]], indexing="ij"), axis=-1)
            points, radius = corners.reshape(-1, 3) * one.size, 0.0
    placed = one.position + points @ one.rotation.T
    return np.column_stack([placed, np.full(len(placed), radius)])
