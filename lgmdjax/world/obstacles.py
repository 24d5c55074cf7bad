"""Upright prisms as padded arrays: boxes turned about the vertical, or cylinders; and the distance to them.

Two convex shapes are as far apart as the origin is from their Minkowski sum (one of them mirrored). For a
segment and a box that sum is a hexagon with the normals of the box and of the segment, so the greatest
separation along these three normals tells whether they overlap and, if so, how deep; a segment and a disc
make a stadium.

| symbol | name                                      | unit | where                                         |
| ------ | ----------------------------------------- | ---- | --------------------------------------------- |
| c(t)   | centre of a prism at time t               | m    | c + s (goal - c), s clipped to 0..1           |
| s      | share of the way that is done             | 1    | (t - departs)/(arrives - departs)             |
| a, b   | half sizes of a box in its own frame      | m    | a cylinder has its radius twice               |
| psi    | yaw of a prism                            | rad  |                                               |
| p, q   | ends of a segment, in the box's frame     | m    |                                               |
| m, h   | its middle, half of q - p                 | m    |                                               |
| n      | its unit normal (one of the box if p = q) | 1    |                                               |
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from lgmdjax.errors import InputError

COUNT = 12
"""Rows of a set, unless said otherwise."""
PARKED = 1.0e3
"""Where padding is parked: x = y = 1 km [m]."""
TEXTURE = ("brightness", "contrast", "phase", "scale")
"""Columns of a texture row: mean grey 0..255, contrast 0..1, pattern offset [rad], longest wavelength [m]."""
PLAIN = (128.0, 0.0, 0.0, 0.5)


@struct.dataclass(kw_only=True)
class Prisms:
    """A padded set of upright prisms of one kind; at time t each is on its way from `centre` to `goal`."""

    centre: Float[Array, "n 2"]
    half_size: Float[Array, "n 2"]
    yaw: Float[Array, " n"]
    bottom: Float[Array, " n"]
    top: Float[Array, " n"]
    texture: Float[Array, "n 4"]
    goal: Float[Array, "n 2"]
    departs: Float[Array, " n"]
    arrives: Float[Array, " n"]


def place(
    centre: ArrayLike,
    half_size: ArrayLike,
    top: ArrayLike,
    *,
    yaw: ArrayLike = 0.0,
    bottom: ArrayLike = 0.0,
    texture: ArrayLike = PLAIN,
    goal: ArrayLike | None = None,
    departs: ArrayLike = 0.0,
    arrives: ArrayLike = 0.0,
    count: int = COUNT,
) -> Prisms:
    """Set up prisms at `centre` (n, 2), the rest broadcast to n rows, padded with parked ones to `count`.

    Raises InputError if there are more than `count`.
    """
    centre = jnp.asarray(centre, dtype=float).reshape(-1, 2)
    rows = centre.shape[0]
    if rows > count:
        raise InputError(f"expected at most {count} prisms of a kind, got {rows}; raise `count`")

    def fill(value: ArrayLike, *width: int) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype=float), (rows, *width))

    real = Prisms(
        centre=centre,
        half_size=fill(half_size, 2),
        yaw=fill(yaw),
        bottom=fill(bottom),
        top=fill(top),
        texture=fill(texture, 4),
        goal=centre if goal is None else fill(goal, 2),
        departs=fill(departs),
        arrives=fill(arrives),
    )
    return join(real, parked(count - rows))


def parked(count: int = COUNT) -> Prisms:
    """Padding: `count` small plain prisms far away under the floor, where no ray or robot meets them."""
    far = jnp.full((count, 2), PARKED, dtype=float)
    zero = jnp.zeros(count, dtype=float)
    return Prisms(
        centre=far,
        half_size=jnp.full((count, 2), 0.05, dtype=float),
        yaw=zero,
        bottom=zero - 0.2,
        top=zero - 0.1,
        texture=jnp.broadcast_to(jnp.asarray(PLAIN, dtype=float), (count, 4)),
        goal=far,
        departs=zero,
        arrives=zero,
    )


def is_parked(prisms: Prisms) -> Bool[Array | np.ndarray, "*rooms n"]:
    """Tell which prisms are padding."""
    return prisms.top <= 0


def join(first: Prisms, second: Prisms) -> Prisms:
    """Append one set to another of its kind."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def moved(prisms: Prisms, time: ArrayLike) -> Prisms:
    """Move prisms to where they are at `time` [s]; they stand there. They jump if arrives = departs."""
    duration = prisms.arrives - prisms.departs
    walks = duration > 0
    late = jnp.asarray(time, dtype=duration.dtype) - prisms.departs
    share = jnp.clip(late / jnp.where(walks, duration, 1.0), 0.0, 1.0)
    share = jnp.where(walks, share, jnp.where(late >= 0, 1.0, 0.0))
    centre = prisms.centre + share[..., None] * (prisms.goal - prisms.centre)
    return dataclasses.replace(prisms, centre=centre, goal=centre)


def mirrored(prisms: Prisms) -> Prisms:
    """Reflect prisms in the x axis."""
    flip = jnp.asarray([1.0, -1.0], dtype=prisms.yaw.dtype)
    return dataclasses.replace(prisms, centre=prisms.centre * flip, goal=prisms.goal * flip, yaw=-prisms.yaw)


def distance_to_boxes(boxes: Prisms, starts: Float[Array, "s 2"], ends: Float[Array, "s 2"]) -> Float[Array, "s n"]:
    """Measure the signed distance [m] of plane segments to boxes' footprints, negative where they overlap.

    Depth is the shortest shift that parts them. A segment may be a point.
    Gradient: one of the one-sided ones where two features are equally near.
    """
    p = turned(starts[:, None] - boxes.centre, -boxes.yaw)
    q = turned(ends[:, None] - boxes.centre, -boxes.yaw)
    m, h = 0.5 * (p + q), 0.5 * (q - p)
    along_box = jnp.max(jnp.abs(m) - boxes.half_size - jnp.abs(h), axis=-1)
    length = _norm(h)
    point = length == 0
    n = jnp.stack([-h[..., 1], h[..., 0]], axis=-1) / jnp.where(point, 1.0, length)[..., None]
    n = jnp.where(point[..., None], jnp.asarray([1.0, 0.0], dtype=n.dtype), n)
    along_segment = jnp.abs(jnp.sum(n * m, axis=-1)) - jnp.sum(boxes.half_size * jnp.abs(n), axis=-1)
    separation = jnp.maximum(along_box, along_segment)
    return jnp.where(separation > 0, _distance_apart(p, q, boxes.half_size), separation)


def _distance_apart(p: Array, q: Array, half_size: Array) -> Array:
    """Distance of a segment to a box about the origin, apart from it: an end or a corner is nearest."""
    from_ends = jnp.minimum(*(_norm(jnp.maximum(jnp.abs(end) - half_size, 0.0)) for end in (p, q)))
    signs = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]
    corners = half_size[..., None, :] * jnp.asarray(signs, dtype=half_size.dtype)
    from_corners = _point_to_segment(corners, p[..., None, :], q[..., None, :])
    return jnp.minimum(from_ends, jnp.min(from_corners, axis=-1))


def distance_to_cylinders(
    cylinders: Prisms, starts: Float[Array, "s 2"], ends: Float[Array, "s 2"]
) -> Float[Array, "s n"]:
    """Measure the signed distance [m] of plane segments to cylinders' footprints, negative inside.

    Gradient: zero where the cylinder's axis lies on the segment.
    """
    to_axis = _point_to_segment(cylinders.centre, starts[:, None], ends[:, None])
    return to_axis - cylinders.half_size[:, 0]


def _point_to_segment(point: Array, start: Array, end: Array) -> Array:
    along = end - start
    square = jnp.sum(along * along, axis=-1)
    share = jnp.sum((point - start) * along, axis=-1) / jnp.where(square > 0, square, 1.0)
    return _norm(point - start - jnp.clip(share, 0.0, 1.0)[..., None] * along)


def _norm(vector: Array) -> Array:
    """Length of plane vectors, with gradient zero at zero, where there is none."""
    square = jnp.sum(vector * vector, axis=-1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def turned(vector: Float[Array, "*#shape 2"], angle: Float[Array, "*#shape"]) -> Float[Array, "*shape 2"]:
    """Turn plane vectors by `angle` [rad], counter-clockwise."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
