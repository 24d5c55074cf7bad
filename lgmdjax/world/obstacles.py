"""Upright prisms as padded arrays, boxes (rotated about the vertical) or cylinders, and the distance to them.

The distance between two convex shapes is that of the origin from their Minkowski difference. For a segment and a box
this is a hexagon with the normals of the box and of the segment. The greatest separation along these three normals
therefore decides whether the two overlap, and gives the depth of the overlap. For a segment and a disc it is a stadium.

| symbol | name                                      | unit | where                                         |
| ------ | ----------------------------------------- | ---- | --------------------------------------------- |
| c(t)   | centre of a prism at time t               | m    | c + s (goal - c), s clipped to 0..1           |
| s      | completed fraction of the motion          | 1    | (t - departs)/(arrives - departs)             |
| a, b   | half sizes of a box in its own frame      | m    | a cylinder stores its radius twice            |
| psi    | yaw of a prism                            | rad  |                                               |
| p, q   | ends of a segment, in the box's frame     | m    |                                               |
| m, h   | midpoint of the segment, (q - p)/2        | m    |                                               |
| n      | its unit normal (of the box if p = q)     | 1    |                                               |
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from lgmdjax.errors import InputError
from lgmdjax.geometry import rotate, safe_norm

CAPACITY = 12
"""Default number of rows of a set."""
INACTIVE_POSITION = 1.0e3
"""Position of inactive prisms: x = y = 1 km [m]."""
TEXTURE_COLUMNS = ("brightness", "contrast", "phase", "scale")
"""Columns of a texture row: mean grey level 0..255, contrast 0..1, phase [rad], longest wavelength [m]."""
PLAIN_TEXTURE = (128.0, 0.0, 0.0, 0.5)
ROBOT_HEIGHT = 0.35
"""Upper bound of the height of every part of the robot [m]. Obstacles that begin above it are overhead."""


@struct.dataclass(kw_only=True)
class Prisms:
    """A padded set of upright prisms of one kind, each of which may move once from `centre` to `goal`.

    The motion is straight and uniform, from time `departs` to time `arrives` [s].
    """

    centre: Float[Array, "n 2"]  # m
    half_size: Float[Array, "n 2"]  # m; the radius twice for a cylinder
    yaw: Float[Array, " n"]  # rad
    bottom: Float[Array, " n"]  # m above the floor
    top: Float[Array, " n"]
    texture: Float[Array, "n 4"]  # columns as in `TEXTURE_COLUMNS`
    goal: Float[Array, "n 2"]  # m
    departs: Float[Array, " n"]  # s
    arrives: Float[Array, " n"]


def is_overhead(prisms: Prisms) -> Bool[Array | np.ndarray, "*rooms n"]:
    """Return which prisms begin above the robot."""
    return prisms.bottom >= ROBOT_HEIGHT


def make_prisms(
    centre: ArrayLike,
    half_size: ArrayLike,
    top: ArrayLike,
    *,
    yaw: ArrayLike = 0.0,
    bottom: ArrayLike = 0.0,
    texture: ArrayLike = PLAIN_TEXTURE,
    goal: ArrayLike | None = None,
    departs: ArrayLike = 0.0,
    arrives: ArrayLike = 0.0,
    capacity: int = CAPACITY,
) -> Prisms:
    """Make prisms at `centre` (n, 2); other values are broadcast to n rows. Pad with inactive prisms to `capacity`.

    Raises InputError if n exceeds `capacity`.

    >>> is_inactive(make_prisms([[1.0, 0.0]], 0.1, 0.8, capacity=3)).tolist()
    [False, True, True]
    """
    centre = jnp.asarray(centre, dtype=float).reshape(-1, 2)
    rows = centre.shape[0]
    if rows > capacity:
        raise InputError(f"expected at most {capacity} prisms of one kind, got {rows}; increase `capacity`")

    def broadcast(value: ArrayLike, *width: int) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype=float), (rows, *width))

    active = Prisms(
        centre=centre,
        half_size=broadcast(half_size, 2),
        yaw=broadcast(yaw),
        bottom=broadcast(bottom),
        top=broadcast(top),
        texture=broadcast(texture, 4),
        goal=centre if goal is None else broadcast(goal, 2),
        departs=broadcast(departs),
        arrives=broadcast(arrives),
    )
    return concatenate(active, inactive(capacity - rows))


def inactive(count: int = CAPACITY) -> Prisms:
    """Return `count` inactive prisms: small, plain, far away and below the floor, out of reach of rays and robots."""
    far = jnp.full((count, 2), INACTIVE_POSITION, dtype=float)
    zero = jnp.zeros(count, dtype=float)
    return Prisms(
        centre=far,
        half_size=jnp.full((count, 2), 0.05, dtype=float),
        yaw=zero,
        bottom=zero - 0.2,
        top=zero - 0.1,
        texture=jnp.broadcast_to(jnp.asarray(PLAIN_TEXTURE, dtype=float), (count, 4)),
        goal=far,
        departs=zero,
        arrives=zero,
    )


def is_inactive(prisms: Prisms) -> Bool[Array | np.ndarray, "*rooms n"]:
    """Return which prisms are padding."""
    return prisms.top <= 0


def concatenate(first: Prisms, second: Prisms) -> Prisms:
    """Concatenate two sets of one kind."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def move_prisms(prisms: Prisms, time: ArrayLike) -> Prisms:
    """Return the prisms at rest at their positions at `time` [s]. A prism with arrives = departs jumps."""
    duration = prisms.arrives - prisms.departs
    is_gradual = duration > 0
    elapsed = jnp.asarray(time, dtype=duration.dtype) - prisms.departs
    fraction = jnp.clip(elapsed / jnp.where(is_gradual, duration, 1.0), 0.0, 1.0)
    fraction = jnp.where(is_gradual, fraction, jnp.where(elapsed >= 0, 1.0, 0.0))
    centre = prisms.centre + fraction[..., None] * (prisms.goal - prisms.centre)
    return dataclasses.replace(prisms, centre=centre, goal=centre)


def raise_prisms(prisms: Prisms, samples: Float[Array, "n 4"], share: Float[Array, ""] | float) -> Prisms:
    """Return the prisms with a share of them raised above the robot and widened, like table tops and crowns of trees.

    Bottoms are 0.6 to 2 m above the floor, thicknesses 0.05 to 1.5 m, and sizes 1 to 3 times the former ones.

    Args:
        prisms: of one kind; inactive ones stay inactive.
        samples: numbers in 0 .. 1, which determine whether a prism is raised, its bottom, thickness and size.
        share: fraction of the prisms that is raised.
    """
    chosen, height, thickness, size = (samples[:, column] for column in range(4))
    raised = (chosen < share) & ~is_inactive(prisms)
    bottom = jnp.where(raised, 0.6 + 1.4 * height, prisms.bottom)
    return dataclasses.replace(
        prisms,
        bottom=bottom,
        top=jnp.where(raised, bottom + 0.05 + 1.45 * thickness, prisms.top),
        half_size=jnp.where(raised[:, None], (1 + 2 * size[:, None]) * prisms.half_size, prisms.half_size),
    )


def mirror_prisms(prisms: Prisms) -> Prisms:
    """Return the mirror image of prisms in the x axis."""
    flip = jnp.asarray([1.0, -1.0], dtype=prisms.yaw.dtype)
    return dataclasses.replace(prisms, centre=prisms.centre * flip, goal=prisms.goal * flip, yaw=-prisms.yaw)


def distance_to_boxes(boxes: Prisms, starts: Float[Array, "s 2"], ends: Float[Array, "s 2"]) -> Float[Array, "s n"]:
    """Return the signed distance [m] of plane segments to the footprints of boxes, negative where they overlap.

    The depth of an overlap is the length of the shortest shift that separates the two. A segment may be a point.

    Gradient: one of the one-sided gradients where two features are equally near.
    """
    p = rotate(starts[:, None] - boxes.centre, -boxes.yaw)
    q = rotate(ends[:, None] - boxes.centre, -boxes.yaw)
    m, h = 0.5 * (p + q), 0.5 * (q - p)
    along_box = jnp.max(jnp.abs(m) - boxes.half_size - jnp.abs(h), axis=-1)
    length = safe_norm(h)
    is_point = length == 0
    n = jnp.stack([-h[..., 1], h[..., 0]], axis=-1) / jnp.where(is_point, 1.0, length)[..., None]
    n = jnp.where(is_point[..., None], jnp.asarray([1.0, 0.0], dtype=n.dtype), n)
    along_segment = jnp.abs(jnp.sum(n * m, axis=-1)) - jnp.sum(boxes.half_size * jnp.abs(n), axis=-1)
    separation = jnp.maximum(along_box, along_segment)
    return jnp.where(separation > 0, _distance_outside(p, q, boxes.half_size), separation)


def _distance_outside(p: Array, q: Array, half_size: Array) -> Array:
    """Return the distance of a segment to a box at the origin that it does not overlap.

    The nearest point is an end of the segment or a corner of the box.
    """
    from_ends = jnp.minimum(*(safe_norm(jnp.maximum(jnp.abs(end) - half_size, 0.0)) for end in (p, q)))
    signs = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]
    corners = half_size[..., None, :] * jnp.asarray(signs, dtype=half_size.dtype)
    from_corners = _point_to_segment(corners, p[..., None, :], q[..., None, :])
    return jnp.minimum(from_ends, jnp.min(from_corners, axis=-1))


def distance_to_cylinders(
    cylinders: Prisms, starts: Float[Array, "s 2"], ends: Float[Array, "s 2"]
) -> Float[Array, "s n"]:
    """Return the signed distance [m] of plane segments to the footprints of cylinders, negative where they overlap.

    Gradient: zero where the cylinder's axis lies on the segment.
    """
    to_axis = _point_to_segment(cylinders.centre, starts[:, None], ends[:, None])
    return to_axis - cylinders.half_size[:, 0]


def _point_to_segment(point: Array, start: Array, end: Array) -> Array:
    """Return the distance of points to segments; a segment may be a point."""
    axis = end - start
    square = jnp.sum(axis * axis, axis=-1)
    fraction = jnp.sum((point - start) * axis, axis=-1) / jnp.where(square > 0, square, 1.0)
    return safe_norm(point - start - jnp.clip(fraction, 0.0, 1.0)[..., None] * axis)
