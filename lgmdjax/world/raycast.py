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

from lgmdjax.minmax import maximum, amin, minimum
from lgmdjax.world.arena import Arena
from lgmdjax.world.obstacles import Prisms, turned

_TINY = 1.0e-7
"""Direction components below this count as this: an axis-parallel ray then meets a face 1e7 lengths away."""


def distance(arena: Arena, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays"]:
    """Measure how far rays go to floor, walls or obstacles: t in lengths of d, inf where nothing is.

    Hard: no footprint, no blending. Gradient: that of the surface hit; zero where nothing is.
    """
    d = jnp.moveaxis(directions, -1, 0)
    room = minimum(to_floor(origin, directions), to_walls(arena, origin, directions))
    boxes = amin(_to_boxes(arena.boxes, origin, d), axis=0)
    cylinders = amin(_to_cylinders(arena.cylinders, origin, d), axis=0)
    return minimum(room, minimum(boxes, cylinders))


def to_floor(origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays"]:
    """Measure t to the plane z = 0, from above only."""
    d_z = directions[..., 2]
    falls = d_z < -_TINY
    t = -origin[2] / jnp.where(falls, d_z, -1.0)
    return jnp.where(falls & (t >= 0), t, jnp.inf)


def to_walls(arena: Arena, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays"]:
    """Measure t to the walls' inner faces: where the ray leaves the room, if below the walls' tops."""
    x_min, x_max, y_min, y_max = arena.room
    x_in, x_out = _slab(origin[0], directions[..., 0], x_min, x_max)
    y_in, y_out = _slab(origin[1], directions[..., 1], y_min, y_max)
    t_in, t_out = maximum(x_in, y_in), minimum(x_out, y_out)
    z = origin[2] + t_out * directions[..., 2]
    hit = (t_out >= maximum(t_in, 0.0)) & (z >= 0) & (z <= arena.wall_height)
    return jnp.where(hit, t_out, jnp.inf)


def to_boxes(boxes: Prisms, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays n"]:
    """Measure t to every box, inf where it is missed."""
    return jnp.moveaxis(_to_boxes(boxes, origin, jnp.moveaxis(directions, -1, 0)), 0, -1)


def to_cylinders(
    cylinders: Prisms, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]
) -> Float[Array, "*rays n"]:
    """Measure t to every cylinder, inf where it is missed."""
    return jnp.moveaxis(_to_cylinders(cylinders, origin, jnp.moveaxis(directions, -1, 0)), 0, -1)


# Here d is (3, *rays) and hits are (n, *rays): with the rays as the fastest axis a scan takes about half the
# time that it takes with the prisms there.


def _to_boxes(boxes: Prisms, o: Array, d: Array) -> Array:
    """Distance to every box: the overlap of three slabs in its own frame."""
    x, y = _leading(turned(o[:2] - boxes.centre, -boxes.yaw).T, d)
    cosine, sine = _leading(jnp.stack([jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)]), d)
    a, b = _leading(boxes.half_size.T, d)
    low, high = _leading(jnp.stack([boxes.bottom, boxes.top]), d)
    x_in, x_out = _slab(x, cosine * d[0] + sine * d[1], -a, a)
    y_in, y_out = _slab(y, cosine * d[1] - sine * d[0], -b, b)
    z_in, z_out = _slab(o[2], d[2], low, high)
    return _first(maximum(maximum(x_in, y_in), z_in), minimum(minimum(x_out, y_out), z_out))


def _to_cylinders(cylinders: Prisms, o: Array, d: Array) -> Array:
    """Distance to every cylinder: the overlap of its disc's interval and its slab.

    The disc's is t_0 +- sqrt(r^2 - c^2/|d|^2)/|d| about the nearest approach t_0 = -o.d/|d|^2, in the plane,
    with the moment c: the usual discriminant b^2 - a c cancels in float32.
    """
    x, y = _leading((o[:2] - cylinders.centre).T, d)
    radius, low, high = _leading(jnp.stack([cylinders.half_size[:, 0], cylinders.bottom, cylinders.top]), d)
    square = jnp.sum(d[:2] * d[:2], axis=0)
    level = square > _TINY**2
    square = maximum(square, _TINY**2)
    c = x * d[1] - y * d[0]
    # A vertical ray is inside the disc for ever, or never.
    margin: Array = radius**2 - jnp.where(level, c * c / square, x * x + y * y)
    meets = margin > 0
    half = jnp.sqrt(jnp.where(meets, margin, 1.0) / square)
    along: Array = x * d[0] + y * d[1]
    middle = jnp.where(level, -along / square, 0.0)
    z_in, z_out = _slab(o[2], d[2], low, high)
    t = _first(maximum(middle - half, z_in), minimum(middle + half, z_out))
    return jnp.where(meets, t, jnp.inf)


def _leading(rows: Array, d: Array) -> Array:
    """Give columns (k, n) of prisms an axis of one for each axis of rays, to stand before them."""
    return rows.reshape(*rows.shape, *(1 for _ in d.shape[1:]))


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
    caps = minimum(_to_spheres(o, d, radii), _to_spheres(origin - ends, d, radii))
    return minimum(side, caps)


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
    return minimum(t_low, t_high), maximum(t_low, t_high)


def _first(t_in: Array, t_out: Array) -> Array:
    """First t >= 0 on a surface whose inside is [t_in, t_out]; from inside that is the way out."""
    t = jnp.where(t_in >= 0, t_in, t_out)
    return jnp.where((t_out >= t_in) & (t >= 0), t, jnp.inf)
