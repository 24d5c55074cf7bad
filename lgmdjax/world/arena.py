"""The world a robot walks in: a walled room with upright boxes and cylinders, all of it arrays.

Every obstacle is an upright prism (`lgmdjax.world.obstacles`), and may hang overhead: a table top, a tree's crown.
Each kind is padded to a static number with prisms parked far away under the floor, so that every robot of a
batch has a room of its own: `vmap` over a batched `Arena`.

World frame: x forward, y left, z up, floor at z = 0; metres, radians, seconds.

A texture row is brightness, contrast, phase, scale (`prisms.TEXTURE`). A pattern is a function of (x, h y, z)
in the frame of its prism, or of the world for walls and floor, with the room's `handedness` h = 1 or -1.

A robot cannot step onto or over anything here, nor crawl under it: what stands on the floor reaches above the
robot, and what does not starts above it (`validate`). Touching is then a problem in the plane, and exact.

Source: sec. 5 of the paper (its figure 10 shows the rooms; `lgmdjax.world.scenes` builds them).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from lgmdjax.errors import InputError
from lgmdjax.world.obstacles import (
    COUNT,
    PARKED,
    Prisms,
    distance_to_boxes,
    distance_to_cylinders,
    is_parked,
    mirrored,
    moved,
    parked,
    place,
)

__all__ = [
    "COUNT",
    "PARKED",
    "ROBOT_HEIGHT",
    "Arena",
    "Prisms",
    "at",
    "clearance",
    "empty_room",
    "free_pose",
    "free_poses",
    "is_overhead",
    "is_parked",
    "margins",
    "mirror",
    "parked",
    "place",
    "tangents",
    "validate",
]

ROBOT_HEIGHT = 0.35
"""Nothing of the robot is ever higher [m]; the parting line between obstacles and what hangs overhead."""


@struct.dataclass(kw_only=True)
class Arena:
    """A room: obstacles, four walls seen from inside, a floor, a sky (or ceiling) of one brightness."""

    boxes: Prisms
    cylinders: Prisms
    room: Float[Array, "4"]
    """x_min, x_max, y_min, y_max of the walls' inner faces."""
    wall_height: Float[Array, ""]
    wall_texture: Float[Array, "4 4"]
    """One row a wall, in the order of `room`."""
    floor_texture: Float[Array, "4"]
    sky: Float[Array, ""]
    """Grey 0..255 of whatever no ray hits."""
    start: Float[Array, "3"]
    """A free start pose: x, y, yaw."""
    handedness: Float[Array, ""]
    """1, or -1 in a mirrored room: textures take h y for y, so that their patterns are mirrored too."""


def empty_room(
    size: ArrayLike = (6.0, 6.0),
    *,
    boxes: Prisms | None = None,
    cylinders: Prisms | None = None,
    wall_height: ArrayLike = 2.0,
    wall_texture: ArrayLike = (170.0, 0.5, 0.0, 1.0),
    floor_texture: ArrayLike = (110.0, 0.4, 0.0, 0.5),
    sky: ArrayLike = 220.0,
    start: ArrayLike = (0.0, 0.0, 0.0),
) -> Arena:
    """Build a room of `size` (x, y) centred at the origin, with the prisms given and nothing else in it."""
    x, y = 0.5 * jnp.asarray(size, dtype=float)
    return Arena(
        boxes=parked() if boxes is None else boxes,
        cylinders=parked() if cylinders is None else cylinders,
        room=jnp.stack([-x, x, -y, y]),
        wall_height=jnp.asarray(wall_height, dtype=float),
        wall_texture=jnp.broadcast_to(jnp.asarray(wall_texture, dtype=float), (4, 4)),
        floor_texture=jnp.asarray(floor_texture, dtype=float),
        sky=jnp.asarray(sky, dtype=float),
        start=jnp.asarray(start, dtype=float),
        handedness=jnp.asarray(1.0, dtype=float),
    )


def at(arena: Arena, time: ArrayLike) -> Arena:
    """Move the obstacles to where they are at `time` [s]; the result is a still room."""
    return dataclasses.replace(arena, boxes=moved(arena.boxes, time), cylinders=moved(arena.cylinders, time))


def mirror(arena: Arena) -> Arena:
    """Reflect the room in its x axis: y -> -y, yaw -> -yaw, walls y_min and y_max swapped, textures too."""
    order = jnp.asarray([0, 1, 3, 2])
    flip = jnp.asarray([1.0, 1.0, -1.0, -1.0], dtype=arena.room.dtype)
    return dataclasses.replace(
        arena,
        boxes=mirrored(arena.boxes),
        cylinders=mirrored(arena.cylinders),
        room=(arena.room * flip)[order],
        wall_texture=arena.wall_texture[order],
        start=arena.start * flip[1:],
        handedness=-arena.handedness,
    )


def clearance(
    arena: Arena, starts: Float[Array, "s axes"], ends: Float[Array, "s axes"], radii: Float[Array, " s"]
) -> Float[Array, " s"]:
    """Measure the signed distance [m] of capsules to the nearest obstacle or wall, negative inside.

    Exact, and a problem in the plane, since what stands on the floor is higher than the robot and what hangs
    overhead cannot be touched; the floor does not count. Of the ends (x, y) is enough.
    Gradient: that of the nearest feature; zero where a cylinder's axis cuts a capsule's.
    """
    return jnp.min(_distances(arena, starts[..., :2], ends[..., :2]), axis=-1) - radii


def tangents(
    arena: Arena, starts: Float[Array, "s axes"], ends: Float[Array, "s axes"]
) -> tuple[Float[Array, "s 2"], Float[Array, " s"]]:
    """Find for each plane segment the line n . x = c that parts it from the obstacle or wall nearest to it.

    With d(t) the signed distance of that thing from the segment shifted by t, n = dd/dt at t = 0 and
    c = min(n . p, n . q) - d(0), p and q the ends. All of the thing lies at n . x <= c, since it is convex. Where the
    segment cuts it, n is the shortest way out; of two as short a mean, and x where there is none to be named, as on a
    cylinder's axis.

    Gradient: that of the nearest feature; the line turns the faster, the nearer a corner is.

    Returns:
        n, of length 1, and c [m].
    """
    p, q = starts[..., :2], ends[..., :2]
    nearest = jnp.argmin(_distances(arena, p, q), axis=-1, keepdims=True)

    def apart(shift: Float[Array, "s 2"]) -> tuple[Float[Array, ""], Float[Array, " s"]]:
        distances = jnp.take_along_axis(_distances(arena, p + shift, q + shift), nearest, axis=-1)[..., 0]
        return jnp.sum(distances), distances

    slope: Array
    slope, distances = jax.grad(apart, has_aux=True)(jnp.zeros_like(p))
    square = jnp.sum(slope * slope, axis=-1, keepdims=True)
    unit = slope / jnp.sqrt(jnp.where(square > 0, square, 1.0))
    normals = jnp.where(square > 0, unit, jnp.asarray([1.0, 0.0], p.dtype))
    support = jnp.minimum(jnp.sum(normals * p, axis=-1), jnp.sum(normals * q, axis=-1))
    return normals, support - distances


def _distances(arena: Arena, p: Float[Array, "s 2"], q: Float[Array, "s 2"]) -> Float[Array, "s n"]:
    """Measure the signed distances [m] of plane segments to every box, cylinder and wall; infinite if overhead."""
    low, high = arena.room[0::2], arena.room[1::2]
    boxes = jnp.where(is_overhead(arena.boxes), jnp.inf, distance_to_boxes(arena.boxes, p, q))
    cylinders = jnp.where(is_overhead(arena.cylinders), jnp.inf, distance_to_cylinders(arena.cylinders, p, q))
    return jnp.concatenate([boxes, cylinders, jnp.minimum(p, q) - low, high - jnp.maximum(p, q)], axis=-1)


def is_overhead(prisms: Prisms) -> Bool[Array | np.ndarray, "*rooms n"]:
    """Tell which prisms hang above the robot."""
    return prisms.bottom >= ROBOT_HEIGHT


def margins(arena: Arena, poses: Float[Array, "n 3"], ahead: float = 0.3) -> Float[Array, " n"]:
    """Measure the room [m] about poses (x, y, yaw), and about the line to `ahead` [m] in front of them."""
    xy, yaw = poses[:, :2], poses[:, 2]
    front = xy + ahead * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    return clearance(arena, xy, front, jnp.zeros_like(yaw))


def free_pose(key: Array, arena: Arena, margin: Float[Array, ""] | float = 0.45) -> Float[Array, "3"]:
    """Draw one pose (x, y, yaw) as `free_poses` does."""
    return free_poses(key, arena, 1, margin)[0]


def free_poses(
    key: Array, arena: Arena, count: int, margin: Float[Array, ""] | float = 0.45
) -> Float[Array, "count 3"]:
    """Draw poses (x, y, yaw), each uniform among those whose `margins` are at least `margin` [m].

    Of 64 candidates the first free one; where none is, the room's own `start`: no pose is a bad one.
    """
    low, high = arena.room[0::2], arena.room[1::2]
    # Drawn in float32 and cast, so that a key means the same poses at any precision.
    draws = jax.random.uniform(key, (count, 64, 3), dtype=jnp.float32).astype(low.dtype)
    xy, yaw = low + draws[..., :2] * (high - low), 2.0 * jnp.pi * draws[..., 2:] - jnp.pi
    poses = jnp.concatenate([xy, yaw], axis=-1)
    free = jax.vmap(lambda row: margins(arena, row) >= margin)(poses)
    first = jnp.take_along_axis(poses, jnp.argmax(free, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.where(jnp.any(free, axis=1)[:, None], first, arena.start)


def validate(arena: Arena) -> Arena:
    """Check a room, or a batch, on the host and hand it back; raises InputError for the first fault."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(arena):
        _require(np.isfinite(leaf), f"finite numbers in {jax.tree_util.keystr(path).strip('.')}", leaf)
    x_min, x_max, y_min, y_max = np.moveaxis(np.asarray(arena.room), -1, 0)
    _require((x_min < x_max) & (y_min < y_max), "room as x_min < x_max, y_min < y_max", arena.room)
    _require(np.asarray(arena.wall_height) >= ROBOT_HEIGHT, "walls above the robot", arena.wall_height)
    _require(np.abs(arena.handedness) == 1, "handedness 1 or -1", arena.handedness)
    _validate_texture("walls", arena.wall_texture)
    _validate_texture("floor", arena.floor_texture)
    _validate_prisms("boxes", arena.boxes)
    _validate_prisms("cylinders", arena.cylinders)
    radii = np.asarray(arena.cylinders.half_size)
    _require(radii[..., 0] == radii[..., 1], "a cylinder's radius twice", radii)
    axes = arena.room.ndim - 1
    rooms = jax.tree.map(lambda leaf: jnp.reshape(leaf, (-1, *leaf.shape[axes:])), at(arena, 0.0))
    space = jax.vmap(lambda room: margins(room, room.start[None], ahead=0.0)[0])(rooms)
    _require(np.asarray(space).reshape(arena.room.shape[:-1]) > 0, "a start pose that is free", arena.start)
    return arena


def _validate_prisms(kind: str, prisms: Prisms) -> None:
    bottom, top = np.asarray(prisms.bottom), np.asarray(prisms.top)
    spans = np.stack([bottom, top], axis=-1)
    stands = (bottom <= 0) & (top >= ROBOT_HEIGHT)
    clear = np.asarray(is_overhead(prisms) | is_parked(prisms))
    _require(np.asarray(prisms.half_size) > 0, f"positive sizes of {kind}", prisms.half_size)
    _require(bottom < top, f"tops of {kind} above their bottoms", spans)
    _require(stands | clear, f"{kind} from the floor to above {ROBOT_HEIGHT} m, or wholly above it", spans)
    _require(prisms.arrives >= prisms.departs, f"{kind} that arrive after they depart", prisms.arrives)
    _validate_texture(kind, prisms.texture)


def _validate_texture(of: str, texture: Array) -> None:
    brightness, contrast, _, scale = np.moveaxis(np.asarray(texture), -1, 0)
    _require((brightness >= 0) & (brightness <= 255), f"brightness of {of} in 0..255", brightness)
    _require((contrast >= 0) & (contrast <= 1), f"contrast of {of} in 0..1", contrast)
    _require(scale > 0, f"texture scales of {of} above 0 m", scale)


def _require(good: ArrayLike, expected: str, got: ArrayLike) -> None:
    """Raise for the first place where it is not `good`."""
    bad = np.argwhere(~np.asarray(good))
    if len(bad):
        place = tuple(int(i) for i in bad[0])
        where = f" at {place}" if place else ""
        raise InputError(f"expected {expected}, got {np.asarray(got)[place]}{where}; mend the room")
