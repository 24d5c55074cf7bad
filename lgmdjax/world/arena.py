"""A walled room with upright boxes and cylinders as a pytree of arrays.

Every obstacle is an upright prism (`lgmdjax.world.obstacles`). It may hang overhead, as a table top or the crown of a
tree. Each kind is padded to a static number of rows with inactive prisms. All rooms then have the same shapes, and
`vmap` over a batched `Arena` gives each robot of a batch its own room.

World frame: x forward, y left, z up, floor at z = 0; metres, radians, seconds.

A texture row is brightness, contrast, phase, scale (`obstacles.TEXTURE_COLUMNS`). The pattern is a function of
(x, h y, z), with h = 1 or -1 the room's `handedness`. The coordinates are relative to the centre of the prism; for
walls and floor they are those of the world.

A robot cannot step onto, step over or crawl under an obstacle. An obstacle on the floor is higher than the robot; any
other obstacle begins above the robot (`validate`). Contact is therefore a problem in the plane with an exact solution.

Source: sec. 5 of the paper (its figure 10 shows the rooms; `lgmdjax.world.scenes` builds them).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.world import floor_plan
from lgmdjax.world.obstacles import (
    CAPACITY,
    INACTIVE_POSITION,
    ROBOT_HEIGHT,
    Prisms,
    distance_to_boxes,
    distance_to_cylinders,
    inactive,
    is_inactive,
    is_overhead,
    make_prisms,
    mirror_prisms,
    move_prisms,
)

__all__ = [
    "CAPACITY",
    "INACTIVE_POSITION",
    "ROBOT_HEIGHT",
    "Arena",
    "Prisms",
    "at_time",
    "clearance",
    "empty_room",
    "inactive",
    "is_inactive",
    "is_overhead",
    "make_prisms",
    "mirror",
    "pose_clearances",
    "sample_free_pose",
    "sample_free_poses",
    "separating_lines",
    "validate",
]

PICTURES = 4  # rooms of a batch that notebooks show


@struct.dataclass(kw_only=True)
class Arena(NotebookTable):
    """A room: obstacles, four walls that are visible from inside, a floor, and a uniform sky (or ceiling)."""

    boxes: Prisms
    cylinders: Prisms
    bounds: Float[Array, "4"]
    """x_min, x_max, y_min, y_max of the inner faces of the walls [m]."""
    wall_height: Float[Array, ""]
    """Height of the walls [m]."""
    wall_texture: Float[Array, "4 4"]
    """One row for each wall, in the order of `bounds`."""
    floor_texture: Float[Array, "4"]
    sky: Float[Array, ""]
    """Grey level 0..255 of rays that hit nothing."""
    start: Float[Array, "3"]
    """A free start pose: x, y, yaw [m, m, rad]."""
    handedness: Float[Array, ""]
    """1, or -1 in a mirrored room. Textures use h y in place of y, so that their patterns are mirrored too."""

    def _picture(self) -> str:
        if np.ndim(self.bounds) == 1:
            return floor_plan.svg(self)
        arenas = (jax.tree.map(lambda leaf, k=k: leaf[k], self) for k in range(min(len(self.bounds), PICTURES)))
        return "".join(floor_plan.svg(arena) for arena in arenas)


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
    """Build a room of `size` (x, y) [m] centred at the origin, which contains the given prisms only.

    >>> empty_room((6.0, 4.0)).bounds.tolist()
    [-3.0, 3.0, -2.0, 2.0]
    """
    x, y = 0.5 * jnp.asarray(size, dtype=float)
    return Arena(
        boxes=inactive() if boxes is None else boxes,
        cylinders=inactive() if cylinders is None else cylinders,
        bounds=jnp.stack([-x, x, -y, y]),
        wall_height=jnp.asarray(wall_height, dtype=float),
        wall_texture=jnp.broadcast_to(jnp.asarray(wall_texture, dtype=float), (4, 4)),
        floor_texture=jnp.asarray(floor_texture, dtype=float),
        sky=jnp.asarray(sky, dtype=float),
        start=jnp.asarray(start, dtype=float),
        handedness=jnp.asarray(1.0, dtype=float),
    )


def at_time(arena: Arena, time: ArrayLike) -> Arena:
    """Return the room with its obstacles at their positions at `time` [s]; in the result nothing moves."""
    return dataclasses.replace(
        arena, boxes=move_prisms(arena.boxes, time), cylinders=move_prisms(arena.cylinders, time)
    )


def mirror(arena: Arena) -> Arena:
    """Return the mirror image of a room in its x axis, textures included: y -> -y, yaw -> -yaw, side walls swapped."""
    order = jnp.asarray([0, 1, 3, 2])
    flip = jnp.asarray([1.0, 1.0, -1.0, -1.0], dtype=arena.bounds.dtype)
    return dataclasses.replace(
        arena,
        boxes=mirror_prisms(arena.boxes),
        cylinders=mirror_prisms(arena.cylinders),
        bounds=(arena.bounds * flip)[order],
        wall_texture=arena.wall_texture[order],
        start=arena.start * flip[1:],
        handedness=-arena.handedness,
    )


def clearance(
    arena: Arena, starts: Float[Array, "s axes"], ends: Float[Array, "s axes"], radii: Float[Array, " s"]
) -> Float[Array, " s"]:
    """Return the signed distance [m] of capsules to the nearest obstacle or wall, negative where they overlap.

    The distance is exact. It is computed in the plane, since obstacles on the floor are higher than the robot and those
    overhead are out of its reach. The floor is not an obstacle. Only x and y of `starts` and `ends` are used.

    Gradient: that of the nearest feature; zero where the axis of a cylinder intersects that of a capsule.

    >>> point = jnp.array([[1.0, 0.5]])
    >>> clearance(empty_room((6.0, 6.0)), point, point, jnp.array([0.5])).tolist()
    [1.5]
    """
    return jnp.min(_distances(arena, starts[..., :2], ends[..., :2]), axis=-1) - radii


def separating_lines(
    arena: Arena, starts: Float[Array, "s axes"], ends: Float[Array, "s axes"]
) -> tuple[Float[Array, "s 2"], Float[Array, " s"]]:
    """Return the line n . x = c that separates each plane segment from the obstacle or wall nearest to it.

    d(t) is the signed distance of that obstacle from the segment shifted by t. Then n = dd/dt at t = 0, and
    c = min(n . p, n . q) - d(0) for the ends p and q. The whole obstacle lies at n . x <= c, since it is convex. Where
    the segment overlaps the obstacle, n is the direction of the shortest shift that separates the two, and the mean of
    both directions if two are equally short. Where no direction is defined, as on a cylinder's axis, n is the x axis.

    Gradient: that of the nearest feature. The nearer a corner is, the faster the line rotates.

    Returns:
        n, of length 1, and c [m].
    """
    p, q = starts[..., :2], ends[..., :2]
    nearest = jnp.argmin(_distances(arena, p, q), axis=-1, keepdims=True)

    def distance(shift: Float[Array, "s 2"]) -> tuple[Float[Array, ""], Float[Array, " s"]]:
        distances = jnp.take_along_axis(_distances(arena, p + shift, q + shift), nearest, axis=-1)[..., 0]
        return jnp.sum(distances), distances

    gradient: Array
    gradient, distances = jax.grad(distance, has_aux=True)(jnp.zeros_like(p))
    square = jnp.sum(gradient * gradient, axis=-1, keepdims=True)
    unit = gradient / jnp.sqrt(jnp.where(square > 0, square, 1.0))
    normals = jnp.where(square > 0, unit, jnp.asarray([1.0, 0.0], p.dtype))
    support = jnp.minimum(jnp.sum(normals * p, axis=-1), jnp.sum(normals * q, axis=-1))
    return normals, support - distances


def _distances(arena: Arena, p: Float[Array, "s 2"], q: Float[Array, "s 2"]) -> Float[Array, "s n"]:
    """Return the signed distances [m] of plane segments to every box, cylinder and wall; infinite if overhead."""
    low, high = arena.bounds[0::2], arena.bounds[1::2]
    boxes = jnp.where(is_overhead(arena.boxes), jnp.inf, distance_to_boxes(arena.boxes, p, q))
    cylinders = jnp.where(is_overhead(arena.cylinders), jnp.inf, distance_to_cylinders(arena.cylinders, p, q))
    return jnp.concatenate([boxes, cylinders, jnp.minimum(p, q) - low, high - jnp.maximum(p, q)], axis=-1)


def pose_clearances(arena: Arena, poses: Float[Array, "n 3"], ahead: float = 0.3) -> Float[Array, " n"]:
    """Return the clearance [m] of the line from each pose (x, y, yaw) to the point `ahead` [m] in front of it."""
    xy, yaw = poses[:, :2], poses[:, 2]
    front = xy + ahead * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    return clearance(arena, xy, front, jnp.zeros_like(yaw))


def sample_free_pose(key: Array, arena: Arena, margin: Float[Array, ""] | float = 0.45) -> Float[Array, "3"]:
    """Sample one pose (x, y, yaw) as `sample_free_poses` does."""
    return sample_free_poses(key, arena, 1, margin)[0]


def sample_free_poses(
    key: Array, arena: Arena, count: int, margin: Float[Array, ""] | float = 0.45
) -> Float[Array, "count 3"]:
    """Sample poses (x, y, yaw), each uniform among those whose `pose_clearances` are at least `margin` [m].

    Each is the first free one of 64 candidates. If none is free, it is the room's `start`, which is free.
    """
    low, high = arena.bounds[0::2], arena.bounds[1::2]
    # Sampled in float32 and cast, so that a key gives the same poses in both precisions.
    samples = jax.random.uniform(key, (count, 64, 3), dtype=jnp.float32).astype(low.dtype)
    xy, yaw = low + samples[..., :2] * (high - low), 2.0 * jnp.pi * samples[..., 2:] - jnp.pi
    poses = jnp.concatenate([xy, yaw], axis=-1)
    is_free = jax.vmap(lambda row: pose_clearances(arena, row) >= margin)(poses)
    first = jnp.take_along_axis(poses, jnp.argmax(is_free, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.where(jnp.any(is_free, axis=1)[:, None], first, arena.start)


def validate(arena: Arena) -> Arena:
    """Check a room, or a batch of rooms, on the host and return it; raises InputError for the first fault."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(arena):
        _require(np.isfinite(leaf), f"finite numbers in {jax.tree_util.keystr(path).strip('.')}", leaf)
    x_min, x_max, y_min, y_max = np.moveaxis(np.asarray(arena.bounds), -1, 0)
    _require((x_min < x_max) & (y_min < y_max), "bounds with x_min < x_max and y_min < y_max", arena.bounds)
    _require(np.asarray(arena.wall_height) >= ROBOT_HEIGHT, "walls higher than the robot", arena.wall_height)
    _require(np.abs(arena.handedness) == 1, "handedness 1 or -1", arena.handedness)
    _validate_texture("walls", arena.wall_texture)
    _validate_texture("floor", arena.floor_texture)
    _validate_prisms("boxes", arena.boxes)
    _validate_prisms("cylinders", arena.cylinders)
    radii = np.asarray(arena.cylinders.half_size)
    _require(radii[..., 0] == radii[..., 1], "the radius of a cylinder twice in half_size", radii)
    axes = arena.bounds.ndim - 1
    rooms = jax.tree.map(lambda leaf: jnp.reshape(leaf, (-1, *leaf.shape[axes:])), at_time(arena, 0.0))
    margin = jax.vmap(lambda room: pose_clearances(room, room.start[None], ahead=0.0)[0])(rooms)
    _require(np.asarray(margin).reshape(arena.bounds.shape[:-1]) > 0, "a free start pose", arena.start)
    return arena


def _validate_prisms(kind: str, prisms: Prisms) -> None:
    bottom, top = np.asarray(prisms.bottom), np.asarray(prisms.top)
    spans = np.stack([bottom, top], axis=-1)
    is_standing = (bottom <= 0) & (top >= ROBOT_HEIGHT)
    is_out_of_reach = np.asarray(is_overhead(prisms) | is_inactive(prisms))
    _require(np.asarray(prisms.half_size) > 0, f"positive sizes of {kind}", prisms.half_size)
    _require(bottom < top, f"tops of {kind} above their bottoms", spans)
    _require(
        is_standing | is_out_of_reach, f"{kind} from the floor to above {ROBOT_HEIGHT} m or wholly above it", spans
    )
    _require(prisms.arrives >= prisms.departs, f"{kind} with arrives >= departs", prisms.arrives)
    _validate_texture(kind, prisms.texture)


def _validate_texture(surface: str, texture: Array) -> None:
    brightness, contrast, _, scale = np.moveaxis(np.asarray(texture), -1, 0)
    _require((brightness >= 0) & (brightness <= 255), f"brightness of {surface} in 0..255", brightness)
    _require((contrast >= 0) & (contrast <= 1), f"contrast of {surface} in 0..1", contrast)
    _require(scale > 0, f"texture scales of {surface} above 0 m", scale)


def _require(is_valid: ArrayLike, expected: str, got: ArrayLike) -> None:
    """Raise InputError for the first element that is not valid."""
    invalid = np.argwhere(~np.asarray(is_valid))
    if len(invalid):
        index = tuple(int(i) for i in invalid[0])
        where = f" at {index}" if index else ""
        raise InputError(f"expected {expected}, got {np.asarray(got)[index]}{where}; correct the room")
