"""Rays against the room and against the robot: the first hit, hard and exact.

A ray is x = o + t d. It meets an upright prism where it is inside its footprint and inside its span of height
at once, so a hit is an interval in the plane intersected with one in height, for boxes and cylinders alike:
their sides, tops and bottoms come out of the same two intervals.

| symbol         | name                                       | unit                  |
| -------------- | ------------------------------------------ | --------------------- |
| o, d           | origin, direction (of any length)          | m, m per unit of t    |
| t              | distance along the ray, in lengths of d    | m for unit directions |
| c = o x d      | moment of the ray about a cylinder's axis  | m                     |
| t_in, t_out    | interval inside a shape                    | as t                  |

As MuJoCo's `mj_ray`, against which it is tested: an origin inside an obstacle sees its far side. Walls are
seen from inside only, so a camera above or beyond a wall looks into the room; the floor goes on
beyond the walls.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.arena import Arena
from lgmdjax.prisms import Prisms, turned

_TINY = 1.0e-7
"""Direction components below this count as this: an axis-parallel ray then meets a face 1e7 lengths away."""


def distance(
    arena: Arena, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]
) -> Float[Array, "*rays"]:
    """Measure how far rays go to floor, walls or obstacles: t in lengths of d, inf where nothing is.

    Hard: no footprint, no blending. Gradient: that of the surface hit; zero where nothing is.
    """
    hits = [
        to_floor(origin, directions),
        to_walls(arena, origin, directions),
        jnp.min(to_boxes(arena.boxes, origin, directions), axis=-1),
        jnp.min(to_cylinders(arena.cylinders, origin, directions), axis=-1),
    ]
    return jnp.min(jnp.stack(hits, axis=-1), axis=-1)


def to_floor(origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays"]:
    """Measure t to the plane z = 0, from above only."""
    falls = directions[..., 2] < -_TINY
    t = -origin[2] / jnp.where(falls, directions[..., 2], -1.0)
    return jnp.where(falls & (t >= 0), t, jnp.inf)


def to_walls(
    arena: Arena, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]
) -> Float[Array, "*rays"]:
    """Measure t to the walls' inner faces: where the ray leaves the room, if below the walls' tops."""
    low, high = arena.room[0::2], arena.room[1::2]
    t_in, t_out = _slab(origin[:2], directions[..., :2], low, high)
    t_in, t_out = jnp.max(t_in, axis=-1), jnp.min(t_out, axis=-1)
    z = origin[2] + t_out * directions[..., 2]
    hit = (t_out >= jnp.maximum(t_in, 0.0)) & (z >= 0) & (z <= arena.wall_height)
    return jnp.where(hit, t_out, jnp.inf)


def to_boxes(
    boxes: Prisms, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]
) -> Float[Array, "*rays n"]:
    """Measure t to every box, inf where it is missed."""
    o = turned(origin[:2] - boxes.centre, -boxes.yaw)
    d = turned(directions[..., None, :2], -boxes.yaw)
    t_in, t_out = _slab(o, d, -boxes.half_size, boxes.half_size)
    z_in, z_out = _slab(origin[2], directions[..., None, 2], boxes.bottom, boxes.top)
    return _first(jnp.maximum(jnp.max(t_in, axis=-1), z_in), jnp.minimum(jnp.min(t_out, axis=-1), z_out))


def to_cylinders(
    cylinders: Prisms, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]
) -> Float[Array, "*rays n"]:
    """Measure t to every cylinder, inf where it is missed.

    The footprint's interval is t_0 +- sqrt(r^2 - c^2/|d|^2)/|d| about the nearest approach t_0 = -o.d/|d|^2,
    with the moment c: the usual discriminant b^2 - a c cancels in float32.
    """
    o = origin[:2] - cylinders.centre
    d = directions[..., None, :2]
    square = jnp.sum(d * d, axis=-1)
    level = square > _TINY**2
    square = jnp.where(level, square, _TINY**2)
    c = o[..., 0] * d[..., 1] - o[..., 1] * d[..., 0]
    # A vertical ray is inside the footprint for ever, or never.
    radius = cylinders.half_size[..., 0]
    margin = radius**2 - jnp.where(level, c * c / square, jnp.sum(o * o, axis=-1))
    meets = margin > 0
    half = jnp.sqrt(jnp.where(meets, margin, 1.0) / square)
    middle = jnp.where(level, -jnp.sum(o * d, axis=-1) / square, 0.0)
    z_in, z_out = _slab(origin[2], directions[..., None, 2], cylinders.bottom, cylinders.top)
    t = _first(jnp.maximum(middle - half, z_in), jnp.minimum(middle + half, z_out))
    return jnp.where(meets, t, jnp.inf)


def to_capsules(
    origin: Float[Array, "3"],
    directions: Float[Array, "*rays 3"],
    starts: Float[Array, "n 3"],
    ends: Float[Array, "n 3"],
    radii: Float[Array, " n"],
) -> Float[Array, "*rays n"]:
    """Measure t to every capsule, inf where missed: the robot from outside. A sphere has start = end.

    A capsule is its cylinder between the two ends and a sphere at each: the first of three hits.
    """
    d = directions[..., None, :]
    along = ends - starts
    length_square = jnp.sum(along * along, axis=-1)
    long = length_square > 0
    share = along / jnp.where(long, length_square, 1.0)[..., None]
    o = origin - starts
    # Across the axis the capsule's side is a circle: drop what o and d have along it.
    o_across = o - jnp.sum(o * share, axis=-1)[..., None] * along
    d_across = d - jnp.sum(d * share, axis=-1)[..., None] * along
    t = _to_spheres(o_across, d_across, radii)
    reached = jnp.isfinite(t)
    height = jnp.sum((o + jnp.where(reached, t, 0.0)[..., None] * d) * share, axis=-1)
    side = jnp.where(long & reached & (height >= 0) & (height <= 1), t, jnp.inf)
    caps = jnp.minimum(_to_spheres(o, d, radii), _to_spheres(origin - ends, d, radii))
    return jnp.minimum(side, caps)


def _to_spheres(o: Array, d: Array, radii: Array) -> Array:
    """First t >= 0 at which o + t d enters a ball about the origin; inf where it misses or starts inside."""
    square = jnp.sum(d * d, axis=-1)
    moves = square > _TINY**2
    square = jnp.where(moves, square, 1.0)
    middle = -jnp.sum(o * d, axis=-1) / square
    nearest = o + middle[..., None] * d
    margin = radii**2 - jnp.sum(nearest * nearest, axis=-1)
    meets = moves & (margin > 0)
    t = middle - jnp.sqrt(jnp.where(meets, margin, 1.0) / square)
    return jnp.where(meets & (t >= 0), t, jnp.inf)


def _slab(o: Array, d: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Interval of t in which o + t d is between `low` and `high`, for each coordinate alone."""
    d = jnp.where(jnp.abs(d) < _TINY, _TINY, d)
    t_low, t_high = (low - o) / d, (high - o) / d
    return jnp.minimum(t_low, t_high), jnp.maximum(t_low, t_high)


def _first(t_in: Array, t_out: Array) -> Array:
    """First t >= 0 on a surface whose inside is [t_in, t_out]; from inside that is the way out."""
    t = jnp.where(t_in >= 0, t_in, t_out)
    return jnp.where((t_out >= t_in) & (t >= 0), t, jnp.inf)
