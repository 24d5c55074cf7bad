"""Upright prisms as an eye sees them: a wedge of directions, closed above and below, over faces of inverse depth.

From an eye, the plane n . x = c is 1/t = s . d on the ray d, with s = n/c: inverse depth is linear in the direction. So
a box needs no division a ray: it is entered where the greatest ... of its near faces, and every outline of a prism is
where two such functions are equal. A cylinder's side is locally such a plane too.

| symbol      | name                                               | unit | where                              |
| ----------- | -------------------------------------------------- | ---- | ---------------------------------- |
| o           | centre of the prism from the eye, in the plane     | m    |                                    |
| d           | direction of a ray, h its part in the plane        | 1    |                                    |
| s           | face as inverse depth                              | 1/m  | 1/t = s . d                        |
| z_t, z_b    | top and bottom above the eye                       | m    |                                    |
| n_l, n_r    | inward normals of the upright planes that touch it | 1    | inside if n_l . d > 0, n_r . d > 0 |
| c           | power of the eye to a cylinder                     | m2   | o^2 - r^2                          |
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax import texture
from lgmdjax.prisms import Prisms, is_parked, turned

_NEAR = 1.0e-4
"""Nothing is nearer to an eye than this [m]; what is, counts as this."""
_OPEN = 1.0e4
"""A margin in pixels, or an inverse depth, that stands for no limit at all."""


class Silhouette(NamedTuple):
    """One prism, or an array of them, as an eye sees it; all plane vectors in world axes."""

    left: tuple[Array, Array]
    """n_l; zero where the eye is above or below the prism."""
    right: tuple[Array, Array]
    open: Array
    """Margin [px] added to n . d: half a pixel; 1 where there are no sides, 0 where there is no prism."""
    top: Array
    bottom: Array
    lid: Array
    """1/z of the top or the bottom, whichever the eye sees; 0 if neither."""
    unclosed_top: Array
    """Margin [px] that takes the upper limit away, where the eye looks up from within the wedge."""
    unclosed_bottom: Array
    within: Array
    """_OPEN where the eye is above or below the prism, where it can enter by the lid only; else 0."""
    axis: tuple[Array, Array]
    """The box's own x axis."""
    near_x: tuple[Array, Array]
    """s of the box's near face across its x axis; that of the other pair of faces where there is none."""
    near_y: tuple[Array, Array]
    far_x: tuple[Array, Array]
    """1/distance of the one or two faces across the box's x axis through which rays leave."""
    far_y: tuple[Array, Array]
    round: Array
    """1 for a cylinder, 0 for a box."""
    centre: tuple[Array, Array]
    radius_square: Array
    polar: tuple[Array, Array]
    """o/c of a cylinder."""
    texture: texture.Texture


class Bounds(NamedTuple):
    """What is needed to sort out which prisms may be seen where: distance [m] and elevations [rad] of each."""

    nearest: Array
    lowest: Array
    highest: Array


def of_boxes(boxes: Prisms, eye: Float[Array, "3"]) -> tuple[Silhouette, Bounds]:
    """Look at boxes from an eye."""
    o = boxes.centre - eye[:2]
    x_axis = turned(jnp.asarray([1.0, 0.0], dtype=o.dtype), boxes.yaw)
    y_axis = turned(jnp.asarray([0.0, 1.0], dtype=o.dtype), boxes.yaw)
    local = -turned(o, -boxes.yaw)
    ahead, behind = boxes.half_size - local, boxes.half_size + local
    near, far_a, far_b, between = _pair_of_faces(ahead, behind)
    near_x, near_y = near[:, :1] * x_axis, near[:, 1:] * y_axis
    near_x, near_y = jnp.where(between[:, :1], near_y, near_x), jnp.where(between[:, 1:], near_x, near_y)
    signs = jnp.asarray([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]], dtype=o.dtype)
    corners = boxes.half_size[:, None, :] * signs
    seen = o[:, None, :] + corners[..., :1] * x_axis[:, None] + corners[..., 1:] * y_axis[:, None]
    within = jnp.all(between, axis=-1)
    left, right = _tangents(o, seen)
    gap = jnp.maximum(jnp.abs(local) - boxes.half_size, 0.0)
    one = jnp.ones_like(boxes.yaw)
    return _silhouette(
        boxes,
        eye,
        within,
        (left, right),
        (_norm(gap), jnp.max(_norm(seen), axis=-1)),
        axis=_xy(x_axis),
        near_x=_xy(near_x),
        near_y=_xy(near_y),
        far_x=(far_a[:, 0], far_b[:, 0]),
        far_y=(far_a[:, 1], far_b[:, 1]),
        round=0.0 * one,
        centre=_xy(o),
        radius_square=one,
        polar=(0.0 * one, 0.0 * one),
    )


def of_cylinders(cylinders: Prisms, eye: Float[Array, "3"]) -> tuple[Silhouette, Bounds]:
    """Look at cylinders from an eye."""
    o = cylinders.centre - eye[:2]
    radius = cylinders.half_size[:, 0]
    distance = _norm(o)
    within = distance < radius
    power = _away_from_zero((distance - radius) * (distance + radius))
    sine = jnp.where(within, 0.5, radius / jnp.where(within, 1.0, jnp.maximum(distance, _NEAR)))
    cosine = jnp.sqrt(jnp.maximum(1.0 - sine * sine, 1e-8))
    unit = o / jnp.maximum(distance, _NEAR)[:, None]
    normal = jnp.stack([-unit[:, 1], unit[:, 0]], axis=-1)
    left = unit * sine[:, None] - normal * cosine[:, None]
    right = unit * sine[:, None] + normal * cosine[:, None]
    zero = jnp.zeros_like(radius)
    return _silhouette(
        cylinders,
        eye,
        within,
        (left, right),
        (jnp.maximum(distance - radius, 0.0), distance + radius),
        axis=(jnp.cos(cylinders.yaw), jnp.sin(cylinders.yaw)),
        near_x=(zero, zero),
        near_y=(zero, zero),
        far_x=(zero, zero),
        far_y=(zero, zero),
        round=zero + 1.0,
        centre=_xy(o),
        radius_square=radius**2,
        polar=_xy(o / power[:, None]),
    )


def _silhouette(
    prisms: Prisms, eye: Array, within: Array, tangents: tuple[Array, Array], reach: tuple[Array, Array], **shape
) -> tuple[Silhouette, Bounds]:
    """Fill in what boxes and cylinders have in common."""
    # Nothing is seen under the floor, where padding is parked.
    z_t, z_b = prisms.top - eye[2], jnp.maximum(prisms.bottom, 0.0) - eye[2]
    from_above, from_below = z_t < 0, z_b > 0
    sides = jnp.where(within, 0.0, 1.0)[:, None]
    lid = jnp.where(from_above, 1.0 / _away_from_zero(z_t), jnp.where(from_below, 1.0 / _away_from_zero(z_b), 0.0))
    unclosed = jnp.where(within, _OPEN, 0.0)
    left, right = tangents
    nearest, farthest = reach
    silhouette = Silhouette(
        left=_xy(left * sides),
        right=_xy(right * sides),
        open=jnp.where(is_parked(prisms), 0.0, jnp.where(within, 1.0, 0.5)),
        top=z_t,
        bottom=z_b,
        lid=lid,
        unclosed_top=jnp.where(from_above, 0.0, unclosed),
        unclosed_bottom=jnp.where(from_below, 0.0, unclosed),
        within=unclosed,
        texture=texture.prepare(prisms.texture),
        **shape,
    )
    nearest = jnp.maximum(nearest, _NEAR)
    highest = jnp.arctan2(z_t, jnp.where(from_above, farthest, nearest))
    lowest = jnp.arctan2(z_b, jnp.where(from_below, farthest, nearest))
    return silhouette, Bounds(nearest=nearest, lowest=lowest, highest=highest)


def _pair_of_faces(ahead: Array, behind: Array) -> tuple[Array, Array, Array, Array]:
    """1/distance, along an axis, of the near face and of the far ones (twice the same unless the eye is between)."""
    plus, minus = 1.0 / _away_from_zero(ahead), -1.0 / _away_from_zero(behind)
    between = (ahead > 0) & (behind > 0)
    beyond = ahead <= 0
    near = jnp.where(beyond, plus, minus)
    far = jnp.where(beyond, minus, plus)
    return near, far, jnp.where(between, minus, far), between


def _tangents(o: Array, corners: Float[Array, "n 4 2"]) -> tuple[Array, Array]:
    """Inward normals of the upright planes through the eye and the outermost corners."""
    along = jnp.sum(o[:, None] * corners, axis=-1)
    aside = o[:, None, 0] * corners[..., 1] - o[:, None, 1] * corners[..., 0]
    angle = jnp.arctan2(aside, jax.lax.stop_gradient(jnp.where((aside == 0) & (along == 0), 1.0, along)))
    angle = jax.lax.stop_gradient(angle)
    unit = corners / jnp.maximum(_norm(corners), _NEAR)[..., None]
    l = jnp.take_along_axis(unit, jnp.argmax(angle, axis=1)[:, None, None], axis=1)[:, 0]  # noqa: E741
    r = jnp.take_along_axis(unit, jnp.argmin(angle, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.stack([l[:, 1], -l[:, 0]], axis=-1), jnp.stack([-r[:, 1], r[:, 0]], axis=-1)


def _away_from_zero(x: Array) -> Array:
    """x, with at least the magnitude _NEAR; as a divisor safe in both directions of differentiation."""
    return jnp.where(jnp.abs(x) < _NEAR, jnp.where(x < 0, -_NEAR, _NEAR), x)


def _norm(vector: Array) -> Array:
    """Length, with gradient zero at zero."""
    square = jnp.sum(vector * vector, axis=-1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _xy(vector: Array) -> tuple[Array, Array]:
    return vector[..., 0], vector[..., 1]
