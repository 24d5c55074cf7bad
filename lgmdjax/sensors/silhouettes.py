"""Upright prisms as an eye sees them: a wedge of directions, limited above and below, over faces of inverse depth.

From an eye, the plane n . x = c is at 1/t = s . d on the ray d, with s = n/c: inverse depth is linear in the
direction, so a box needs no division a ray, and an outline is where two such functions are equal. Where a ray meets
a cylinder, the plane that touches it there takes the face's place.

| symbol   | name                                               | unit | where                              |
| -------- | -------------------------------------------------- | ---- | ---------------------------------- |
| o        | centre of the prism from the eye, in the plane     | m    |                                    |
| d        | direction of a ray                                 | 1    |                                    |
| s        | face as inverse depth                              | 1/m  | 1/t = s . d                        |
| z_t, z_b | top and bottom above the eye                       | m    |                                    |
| n_l, n_r | inward normals of the upright planes that touch it | 1    | inside if n_l . d > 0, n_r . d > 0 |
| c        | power of the eye to a cylinder                     | m2   | o^2 - r^2                          |

An eye sees at most one lid, the top from above or the bottom from below. The lid ends where its far sides begin,
the opposite end of the prism where its near sides end.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgmdjax.minmax import maximum, minimum
from lgmdjax.world import texture
from lgmdjax.world.arena import Arena
from lgmdjax.world.obstacles import Prisms, is_parked, turned

NEAR = 1.0e-4
"""Nothing is nearer to an eye than this [m]; what is, counts as this."""

Pair = tuple[Array, Array]


class Silhouette(NamedTuple):
    """One prism, or an array of them, as an eye sees it; plane vectors in world axes. All zero: nothing.

    No more numbers than it takes, and the rest from these in `layers`: every tile's loop reads them from memory once
    for each of its prisms, and from about 250 such numbers on LLVM no longer vectorises it (ten times slower).
    """

    left: Pair
    """n_l; zero where the eye is above or below the prism, within its wedge."""
    right: Pair
    open: Array
    """1/2: the wedge counts; 1: it is all around; 0: there is no prism."""
    lid_end: Array
    """z of the end with the lid; of the top if no lid is seen."""
    other_end: Array
    lid: Array
    """1/z of the lid, negative for a top; 0 where none is seen."""
    axis: Pair
    """A box's x axis."""
    ahead: Pair
    """1/distance along the box's axes of the faces that rays along the axes meet; negative: the eye is beyond."""
    behind: Pair
    """The same of the opposite faces; positive: the eye is beyond."""
    centre: Pair
    """o."""
    radius_square: Array
    """r^2 of a cylinder, 0 for a box."""
    limb: Array
    """r |o|: times 2 p, what q^2 is a pixel inside the limb (`layers`)."""
    power: Array
    """1/c."""
    texture: texture.Texture


class Bounds(NamedTuple):
    """What sorts out where a prism may be seen: its least distance [m] and its range of elevations [rad]."""

    nearest: Array
    lowest: Array
    highest: Array
    within: Array


def look(arena: Arena, eye: Float[Array, "3"]) -> tuple[Silhouette, Bounds]:
    """Look at all prisms of a room from an eye, the nearest first."""
    seen = (_of_boxes(arena.boxes, eye), _of_cylinders(arena.cylinders, eye))
    silhouettes, bounds = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *seen)
    order = jnp.argsort(lax.stop_gradient(bounds.nearest))
    return jax.tree.map(lambda a: a[order], (silhouettes, bounds))


def may_show(
    silhouettes: Silhouette, bounds: Bounds, axes: Float[Array, "*cones 3"], radii: Float[Array, "*cones"]
) -> Array:
    """Tell which prisms (last axis) may show in cones of directions: no side of the outline shuts the cone out."""
    radius = radii[..., None]
    x, y, z = (axes[..., i, None] for i in range(3))
    elevation = jnp.arcsin(jnp.clip(z, -1.0, 1.0))
    slack = jnp.sin(minimum(radius, 0.5 * jnp.pi))
    from_left = silhouettes.left[0] * x + silhouettes.left[1] * y > -slack
    from_right = silhouettes.right[0] * x + silhouettes.right[1] * y > -slack
    level = (elevation + radius > bounds.lowest) & (elevation - radius < bounds.highest)
    return ((from_left & from_right) | bounds.within) & level & (silhouettes.open > 0)


def pick(silhouettes: Silhouette, shows: Array, slots: int) -> list[Silhouette]:
    """Give each cone the first `slots` prisms that may show in it: silhouettes of (cones,) each, zero where unused.

    Sorting one by one would be slow: their number in the queue is a product with a triangle of ones, and what they
    hand over a product with the one-hot numbers, exact and differentiable.
    """
    leaves, structure = jax.tree.flatten(silhouettes)
    table = jnp.stack(leaves, axis=-1)
    present = shows.astype(table.dtype)
    count = table.shape[0]
    number = present @ jnp.triu(jnp.ones((count, count), dtype=table.dtype))
    numbers = jnp.arange(1, min(slots, count) + 1, dtype=table.dtype)[:, None]
    chosen = jnp.where((number[:, None] == numbers) & shows[:, None], 1.0, 0.0).astype(table.dtype)
    picked = jnp.einsum("tkn,nf->tkf", chosen, table, precision=lax.Precision.HIGHEST)
    fields = lax.split(picked, [1] * len(leaves), axis=2)  # indexed one by one, each would be padded on the way back
    return [jax.tree.unflatten(structure, [field[:, k, 0] for field in fields]) for k in range(numbers.shape[0])]


def _of_boxes(boxes: Prisms, eye: Array) -> tuple[Silhouette, Bounds]:
    o = boxes.centre - eye[:2]
    x_axis, y_axis = (turned(jnp.asarray(e, dtype=o.dtype), boxes.yaw) for e in ([1.0, 0.0], [0.0, 1.0]))
    local = -turned(o, -boxes.yaw)
    signs = jnp.asarray([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]], dtype=o.dtype)
    offsets = boxes.half_size[:, None, :] * signs
    corners = o[:, None, :] + offsets[..., :1] * x_axis[:, None] + offsets[..., 1:] * y_axis[:, None]
    gap = maximum(jnp.abs(local) - boxes.half_size, 0.0)
    zero = jnp.zeros_like(boxes.yaw)
    return _silhouette(
        boxes,
        eye,
        jnp.all(jnp.abs(local) < boxes.half_size, axis=-1),
        _outermost(o, corners),
        (_norm(gap), jnp.max(_norm(corners), axis=-1)),
        axis=_xy(x_axis),
        ahead=_xy(1.0 / _away_from_zero(boxes.half_size - local)),
        behind=_xy(-1.0 / _away_from_zero(boxes.half_size + local)),
        radius_square=zero,
        limb=zero,
        power=zero,
    )


def _of_cylinders(cylinders: Prisms, eye: Array) -> tuple[Silhouette, Bounds]:
    o, radius = cylinders.centre - eye[:2], cylinders.half_size[:, 0]
    distance = maximum(_norm(o), NEAR)
    within = distance < radius
    sine = jnp.where(within, 0.5, radius / jnp.where(within, 1.0, distance))
    cosine = jnp.sqrt(maximum(1.0 - sine * sine, 1e-8))
    along = o / distance[:, None]
    aside = jnp.stack([-along[:, 1], along[:, 0]], axis=-1)
    along, aside = along * sine[:, None], aside * cosine[:, None]
    zero = jnp.zeros_like(radius)
    return _silhouette(
        cylinders,
        eye,
        within,
        (along - aside, along + aside),
        (maximum(distance - radius, 0.0), distance + radius),
        axis=(zero, zero),
        ahead=(zero, zero),
        behind=(zero, zero),
        radius_square=radius**2,
        limb=radius * distance,
        power=1.0 / _away_from_zero((distance - radius) * (distance + radius)),
    )


def _silhouette(
    prisms: Prisms, eye: Array, within: Array, normals: Pair, reach: Pair, **shape
) -> tuple[Silhouette, Bounds]:
    """Fill in what boxes and cylinders have in common."""
    # Nothing is seen under the floor, where padding is parked.
    z_t, z_b = prisms.top - eye[2], maximum(prisms.bottom, 0.0) - eye[2]
    from_above, from_below = z_t < 0, z_b > 0
    lid_end, other_end = jnp.where(from_below, z_b, z_t), jnp.where(from_below, z_t, z_b)
    sides = jnp.where(within, 0.0, 1.0)[:, None]
    silhouette = Silhouette(
        left=_xy(normals[0] * sides),
        right=_xy(normals[1] * sides),
        open=jnp.where(is_parked(prisms), 0.0, jnp.where(within, 1.0, 0.5)),
        lid_end=lid_end,
        other_end=other_end,
        lid=jnp.where(from_above | from_below, 1.0 / _away_from_zero(lid_end), 0.0),
        centre=_xy(prisms.centre - eye[:2]),
        texture=texture.prepare(prisms.texture),
        **shape,
    )
    nearest, farthest = maximum(reach[0], NEAR), reach[1]
    highest = jnp.arctan2(z_t, jnp.where(from_above, farthest, nearest))
    lowest = jnp.arctan2(z_b, jnp.where(from_below, farthest, nearest))
    return silhouette, lax.stop_gradient(Bounds(nearest, lowest, highest, within))


def _outermost(o: Array, corners: Float[Array, "n 4 2"]) -> Pair:
    """Inward normals of the upright planes through the eye and the outermost corners."""
    along = o[:, None, 0] * corners[..., 0] + o[:, None, 1] * corners[..., 1]
    aside = o[:, None, 0] * corners[..., 1] - o[:, None, 1] * corners[..., 0]
    angle = jnp.arctan2(*lax.stop_gradient((aside, along)))
    unit = corners / maximum(_norm(corners), NEAR)[..., None]
    left = jnp.take_along_axis(unit, jnp.argmax(angle, axis=1)[:, None, None], axis=1)[:, 0]
    right = jnp.take_along_axis(unit, jnp.argmin(angle, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.stack([left[:, 1], -left[:, 0]], axis=-1), jnp.stack([-right[:, 1], right[:, 0]], axis=-1)


def _away_from_zero(x: Array) -> Array:
    """x with at least the magnitude NEAR: a divisor that is safe in both directions of differentiation."""
    return jnp.where(jnp.abs(x) < NEAR, jnp.where(x < 0, -NEAR, NEAR), x)


def _norm(vector: Array) -> Array:
    """Length, with gradient zero at zero."""
    square = jnp.sum(vector * vector, axis=-1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _xy(vector: Array) -> Pair:
    return vector[..., 0], vector[..., 1]
