"""Exact ray casting: the first hit of rays with the room or with the robot.

A ray is x = o + t d. It is inside an upright prism where it is inside the footprint and inside the range of heights.
The interval of t inside the prism is therefore the intersection of an interval in the plane and one in height. This
holds for boxes and cylinders and covers sides, top and bottom.

| symbol         | name                                       | unit                  |
| -------------- | ------------------------------------------ | --------------------- |
| o, d           | origin, direction (of any length)          | m, m per unit of t    |
| t              | distance along the ray, in lengths of d    | m for unit directions |
| c = o x d      | moment of the ray about a cylinder's axis  | m                     |
| t_in, t_out    | interval inside a shape                    | as t                  |

From an origin inside an obstacle the hit is on its far side, as in MuJoCo's `mj_ray`, against which this is tested.
Walls are visible from inside only, so that a camera above or beyond a wall looks into the room. The floor extends
beyond the walls.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.geometry import rotate
from lgmdjax.minmax import amin, maximum, minimum
from lgmdjax.world.arena import Arena
from lgmdjax.world.obstacles import Prisms

_MIN_COMPONENT = 1.0e-7
"""Smaller components of directions are replaced by this: an axis-parallel ray then meets a face 1e7 lengths away."""


def distance(arena: Arena, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays"]:
    """Return t of the first hit of each ray with floor, walls or obstacles; inf where there is none.

    Single rays without footprint: edges are not antialiased.

    Gradient: that of the surface hit; zero where there is none.

    >>> from lgmdjax.world.arena import empty_room
    >>> ahead_and_down = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    >>> distance(empty_room((6.0, 6.0)), jnp.array([0.0, 0.0, 0.5]), ahead_and_down).tolist()
    [3.0, 0.5]
    """
    d = jnp.moveaxis(directions, -1, 0)
    room = minimum(to_floor(origin, directions), to_walls(arena, origin, directions))
    boxes = amin(_to_boxes(arena.boxes, origin, d), axis=0)
    cylinders = amin(_to_cylinders(arena.cylinders, origin, d), axis=0)
    return minimum(room, minimum(boxes, cylinders))


def to_floor(origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays"]:
    """Return t at the plane z = 0, from above only; inf where it is missed."""
    d_z = directions[..., 2]
    is_downward = d_z < -_MIN_COMPONENT
    t = -origin[2] / jnp.where(is_downward, d_z, -1.0)
    return jnp.where(is_downward & (t >= 0), t, jnp.inf)


def to_walls(arena: Arena, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays"]:
    """Return t at the inner faces of the walls, where the ray leaves the room; inf if that is above the walls."""
    x_min, x_max, y_min, y_max = arena.bounds
    x_in, x_out = _slab_interval(origin[0], directions[..., 0], x_min, x_max)
    y_in, y_out = _slab_interval(origin[1], directions[..., 1], y_min, y_max)
    t_in, t_out = maximum(x_in, y_in), minimum(x_out, y_out)
    z = origin[2] + t_out * directions[..., 2]
    hit = (t_out >= maximum(t_in, 0.0)) & (z >= 0) & (z <= arena.wall_height)
    return jnp.where(hit, t_out, jnp.inf)


def to_boxes(boxes: Prisms, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays n"]:
    """Return t at every box, inf where it is missed."""
    return jnp.moveaxis(_to_boxes(boxes, origin, jnp.moveaxis(directions, -1, 0)), 0, -1)


def to_cylinders(
    cylinders: Prisms, origin: Float[Array, "3"], directions: Float[Array, "*rays 3"]
) -> Float[Array, "*rays n"]:
    """Return t at every cylinder, inf where it is missed."""
    return jnp.moveaxis(_to_cylinders(cylinders, origin, jnp.moveaxis(directions, -1, 0)), 0, -1)


# In the functions below d is (3, *rays) and hits are (n, *rays). With the rays as the fastest axis a laser scan takes
# about half the time that it takes with the prisms as the fastest axis.


def _to_boxes(boxes: Prisms, o: Array, d: Array) -> Array:
    """Return t at every box: the intersection of three slabs in its own frame."""
    x, y = _expand_to_rays(rotate(o[:2] - boxes.centre, -boxes.yaw).T, d)
    cosine, sine = _expand_to_rays(jnp.stack([jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)]), d)
    a, b = _expand_to_rays(boxes.half_size.T, d)
    low, high = _expand_to_rays(jnp.stack([boxes.bottom, boxes.top]), d)
    x_in, x_out = _slab_interval(x, cosine * d[0] + sine * d[1], -a, a)
    y_in, y_out = _slab_interval(y, cosine * d[1] - sine * d[0], -b, b)
    z_in, z_out = _slab_interval(o[2], d[2], low, high)
    return _first_hit(maximum(maximum(x_in, y_in), z_in), minimum(minimum(x_out, y_out), z_out))


def _to_cylinders(cylinders: Prisms, o: Array, d: Array) -> Array:
    """Return t at every cylinder: the intersection of the interval of its disc and of its slab.

    The interval of the disc is t_0 +- sqrt(r^2 - c^2/|d|^2)/|d|, all in the plane, with the closest approach at
    t_0 = -o.d/|d|^2 and the moment c. The usual discriminant b^2 - a c suffers from cancellation in float32.
    """
    x, y = _expand_to_rays((o[:2] - cylinders.centre).T, d)
    radius, low, high = _expand_to_rays(jnp.stack([cylinders.half_size[:, 0], cylinders.bottom, cylinders.top]), d)
    square = jnp.sum(d[:2] * d[:2], axis=0)
    is_inclined = square > _MIN_COMPONENT**2
    square = maximum(square, _MIN_COMPONENT**2)
    c = x * d[1] - y * d[0]
    # A vertical ray is inside the disc for all t, or for none.
    margin: Array = radius**2 - jnp.where(is_inclined, c * c / square, x * x + y * y)
    is_hit = margin > 0
    half = jnp.sqrt(jnp.where(is_hit, margin, 1.0) / square)
    along: Array = x * d[0] + y * d[1]
    middle = jnp.where(is_inclined, -along / square, 0.0)
    z_in, z_out = _slab_interval(o[2], d[2], low, high)
    t = _first_hit(maximum(middle - half, z_in), minimum(middle + half, z_out))
    return jnp.where(is_hit, t, jnp.inf)


def _expand_to_rays(rows: Array, d: Array) -> Array:
    """Append an axis of length one to columns (k, n) of prisms for each axis of the rays, so that they broadcast."""
    return rows.reshape(*rows.shape, *(1 for _ in d.shape[1:]))


def to_capsules(
    origin: Float[Array, "3"],
    directions: Float[Array, "*rays 3"],
    starts: Float[Array, "n 3"],
    ends: Float[Array, "n 3"],
    radii: Float[Array, " n"],
) -> Float[Array, "*rays n"]:
    """Return t at every capsule, from outside; inf where it is missed. A sphere has start = end.

    A capsule is a cylinder between its two ends with a sphere at either end: the result is the first of three hits.
    """
    d = directions[..., None, :]
    axis = ends - starts
    length_square = jnp.sum(axis * axis, axis=-1)
    has_length = length_square > 0
    scaled_axis = axis / jnp.where(has_length, length_square, 1.0)[..., None]
    o = origin - starts
    # Across its axis the capsule is a circle: remove the components of o and d along it.
    o_across = o - jnp.sum(o * scaled_axis, axis=-1)[..., None] * axis
    d_across = d - jnp.sum(d * scaled_axis, axis=-1)[..., None] * axis
    t = _to_spheres(o_across, d_across, radii)
    is_hit = jnp.isfinite(t)
    height = jnp.sum((o + jnp.where(is_hit, t, 0.0)[..., None] * d) * scaled_axis, axis=-1)
    side = jnp.where(has_length & is_hit & (height >= 0) & (height <= 1), t, jnp.inf)
    caps = minimum(_to_spheres(o, d, radii), _to_spheres(origin - ends, d, radii))
    return minimum(side, caps)


def _to_spheres(o: Array, d: Array, radii: Array) -> Array:
    """Return the first t >= 0 at which o + t d enters a ball at the origin; inf where it misses or starts inside."""
    square = jnp.sum(d * d, axis=-1)
    has_length = square > _MIN_COMPONENT**2
    square = jnp.where(has_length, square, 1.0)
    middle = -jnp.sum(o * d, axis=-1) / square
    nearest = o + middle[..., None] * d
    margin = radii**2 - jnp.sum(nearest * nearest, axis=-1)
    is_hit = has_length & (margin > 0)
    t = middle - jnp.sqrt(jnp.where(is_hit, margin, 1.0) / square)
    return jnp.where(is_hit & (t >= 0), t, jnp.inf)


def _slab_interval(o: Array, d: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the interval of t in which o + t d is between `low` and `high`, for one coordinate."""
    d = jnp.where(jnp.abs(d) < _MIN_COMPONENT, _MIN_COMPONENT, d)
    t_low, t_high = (low - o) / d, (high - o) / d
    return minimum(t_low, t_high), maximum(t_low, t_high)


def _first_hit(t_in: Array, t_out: Array) -> Array:
    """Return the first t >= 0 on the surface of a shape whose inside is [t_in, t_out]; from inside that is t_out."""
    t = jnp.where(t_in >= 0, t_in, t_out)
    return jnp.where((t_out >= t_in) & (t >= 0), t, jnp.inf)
