"""Silhouettes of upright prisms: the wedge of directions that each fills, and its faces as inverse depths.

From an eye, the plane n . x = c is at 1/t = s . d on the ray d, with s = n/c. Inverse depth is linear in the direction,
so a box needs no division per ray, and an outline is where two such functions are equal. A cylinder is described by
the plane that touches it where a ray meets it.

| symbol   | name                                               | unit | where                              |
| -------- | -------------------------------------------------- | ---- | ---------------------------------- |
| o        | centre of the prism relative to the eye, in plan   | m    |                                    |
| d        | direction of a ray                                 | 1    |                                    |
| s        | face as inverse depth                              | 1/m  | 1/t = s . d                        |
| z_t, z_b | top and bottom relative to the eye                 | m    |                                    |
| n_l, n_r | inward normals of the two vertical tangent planes  | 1    | inside if n_l . d > 0, n_r . d > 0 |
| c        | power of the eye with respect to a cylinder        | m2   | o^2 - r^2                          |

An eye sees at most one horizontal face of a prism, its cap: the top from above or the bottom from below. The cap ends
where the far sides begin; the opposite end of the prism is where the near sides end.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lgmdjax.geometry import rotate, safe_norm
from lgmdjax.minmax import maximum, minimum
from lgmdjax.world import texture
from lgmdjax.world.arena import Arena
from lgmdjax.world.obstacles import Prisms, is_inactive

MIN_DISTANCE = 1.0e-4
"""Smallest distance of a surface from an eye [m]; nearer ones are treated as if at this distance."""

Pair = tuple[Array, Array]


class Silhouette(NamedTuple):
    """One prism, or an array of prisms, as seen from an eye; plane vectors are in world axes. All zero: no prism.

    The fields are as few as possible, and `compositing` computes the rest from them. The loop over a tile reads all of
    them once for each of its prisms, and from about 250 such numbers on LLVM no longer vectorises that loop (ten times
    slower).
    """

    left_normal: Pair
    """n_l; zero where the eye is above or below the prism, within its plan."""
    right_normal: Pair
    """n_r; likewise."""
    wedge: Array
    """1/2: the tangent planes bound the prism; 1: it surrounds the eye in plan; 0: there is no prism."""
    cap_z: Array
    """z of the end with the visible cap; of the top if no cap is visible."""
    opposite_z: Array
    """z of the other end."""
    inverse_cap_z: Array
    """1/z of the cap, negative for a top; 0 where no cap is visible."""
    x_axis: Pair
    """x axis of a box."""
    inverse_front: Pair
    """1/distance, along the box's axes, of the faces on the positive side; negative: the eye is beyond the face."""
    inverse_back: Pair
    """The same of the faces on the negative side; positive: the eye is beyond the face."""
    centre: Pair
    """o."""
    radius_squared: Array
    """r^2 of a cylinder, 0 for a box."""
    contour_scale: Array
    """r |o|; multiplied by 2 p it is the q^2 of a ray one pixel inside the outline (`compositing`)."""
    inverse_power: Array
    """1/c."""
    texture: texture.Texture


class Bounds(NamedTuple):
    """Bounds of where a prism may be visible."""

    min_distance: Array
    """Smallest distance in plan [m]."""
    min_elevation: Array
    """Lowest elevation [rad]."""
    max_elevation: Array
    """Highest elevation [rad]."""
    eye_within: Array
    """Whether the eye is within the prism in plan."""


class _Sides(NamedTuple):
    """The fields of `Silhouette` in which boxes and cylinders differ."""

    x_axis: Pair
    inverse_front: Pair
    inverse_back: Pair
    radius_squared: Array
    contour_scale: Array
    inverse_power: Array


def project_prisms(arena: Arena, eye: Float[Array, "3"]) -> tuple[Silhouette, Bounds]:
    """Return the silhouettes and bounds of all prisms of a room, sorted by distance from the eye."""
    boxes_and_cylinders = (_box_silhouettes(arena.boxes, eye), _cylinder_silhouettes(arena.cylinders, eye))
    silhouettes, bounds = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *boxes_and_cylinders)
    order = jnp.argsort(lax.stop_gradient(bounds.min_distance))
    return jax.tree.map(lambda a: a[order], (silhouettes, bounds))


def may_be_visible(
    silhouettes: Silhouette, bounds: Bounds, axes: Float[Array, "*cones 3"], radii: Float[Array, "*cones"]
) -> Bool[Array, "*cones prisms"]:
    """Return which prisms may be visible within cones of directions: those whose outline excludes no whole cone.

    Args:
        silhouettes: of the prisms.
        bounds: of the same prisms.
        axes: unit vectors along the cones' axes.
        radii: half apex angles of the cones [rad].
    """
    radius = radii[..., None]
    x, y, z = (axes[..., i, None] for i in range(3))
    elevation = jnp.arcsin(jnp.clip(z, -1.0, 1.0))
    slack = jnp.sin(minimum(radius, 0.5 * jnp.pi))
    in_left = silhouettes.left_normal[0] * x + silhouettes.left_normal[1] * y > -slack
    in_right = silhouettes.right_normal[0] * x + silhouettes.right_normal[1] * y > -slack
    in_elevation = (elevation + radius > bounds.min_elevation) & (elevation - radius < bounds.max_elevation)
    return ((in_left & in_right) | bounds.eye_within) & in_elevation & (silhouettes.wedge > 0)


def select_nearest(silhouettes: Silhouette, visible: Bool[Array, "cones prisms"], count: int) -> list[Silhouette]:
    """Return for each cone the nearest `count` prisms that may be visible in it.

    The result is a list of silhouettes of shape (cones,), zero where a cone has fewer prisms. Selection by sorting
    would be slow. Instead the rank of each visible prism is a product with a triangle of ones, and the selected fields
    are a product with the one-hot ranks, which is exact and differentiable.
    """
    leaves, structure = jax.tree.flatten(silhouettes)
    table = jnp.stack(leaves, axis=-1)
    present = visible.astype(table.dtype)
    prisms = table.shape[0]
    rank = present @ jnp.triu(jnp.ones((prisms, prisms), dtype=table.dtype))
    ranks = jnp.arange(1, min(count, prisms) + 1, dtype=table.dtype)[:, None]
    one_hot = jnp.where((rank[:, None] == ranks) & visible[:, None], 1.0, 0.0).astype(table.dtype)
    selected = jnp.einsum("tkn,nf->tkf", one_hot, table, precision=lax.Precision.HIGHEST)
    # Indexed one by one, each field would be padded in the backward pass.
    fields = lax.split(selected, [1] * len(leaves), axis=2)
    return [jax.tree.unflatten(structure, [field[:, k, 0] for field in fields]) for k in range(ranks.shape[0])]


def _box_silhouettes(boxes: Prisms, eye: Array) -> tuple[Silhouette, Bounds]:
    o = boxes.centre - eye[:2]
    x_axis, y_axis = (rotate(jnp.asarray(e, dtype=o.dtype), boxes.yaw) for e in ([1.0, 0.0], [0.0, 1.0]))
    local = -rotate(o, -boxes.yaw)
    signs = jnp.asarray([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]], dtype=o.dtype)
    offsets = boxes.half_size[:, None, :] * signs
    corners = o[:, None, :] + offsets[..., :1] * x_axis[:, None] + offsets[..., 1:] * y_axis[:, None]
    gap = maximum(jnp.abs(local) - boxes.half_size, 0.0)
    zero = jnp.zeros_like(boxes.yaw)
    return _silhouettes(
        boxes,
        eye,
        eye_within=jnp.all(jnp.abs(local) < boxes.half_size, axis=-1),
        normals=_tangent_normals(o, corners),
        distances=(safe_norm(gap), jnp.max(safe_norm(corners), axis=-1)),
        sides=_Sides(
            x_axis=_xy(x_axis),
            inverse_front=_xy(1.0 / _away_from_zero(boxes.half_size - local)),
            inverse_back=_xy(-1.0 / _away_from_zero(boxes.half_size + local)),
            radius_squared=zero,
            contour_scale=zero,
            inverse_power=zero,
        ),
    )


def _cylinder_silhouettes(cylinders: Prisms, eye: Array) -> tuple[Silhouette, Bounds]:
    o, radius = cylinders.centre - eye[:2], cylinders.half_size[:, 0]
    distance = maximum(safe_norm(o), MIN_DISTANCE)
    eye_within = distance < radius
    sine = jnp.where(eye_within, 0.5, radius / jnp.where(eye_within, 1.0, distance))
    cosine = jnp.sqrt(maximum(1.0 - sine * sine, 1e-8))
    along = o / distance[:, None]
    aside = jnp.stack([-along[:, 1], along[:, 0]], axis=-1)
    along, aside = along * sine[:, None], aside * cosine[:, None]
    zero = jnp.zeros_like(radius)
    return _silhouettes(
        cylinders,
        eye,
        eye_within=eye_within,
        normals=(along - aside, along + aside),
        distances=(maximum(distance - radius, 0.0), distance + radius),
        sides=_Sides(
            x_axis=(zero, zero),
            inverse_front=(zero, zero),
            inverse_back=(zero, zero),
            radius_squared=radius**2,
            contour_scale=radius * distance,
            inverse_power=1.0 / _away_from_zero((distance - radius) * (distance + radius)),
        ),
    )


def _silhouettes(
    prisms: Prisms, eye: Array, *, eye_within: Array, normals: Pair, distances: Pair, sides: _Sides
) -> tuple[Silhouette, Bounds]:
    """Add what boxes and cylinders have in common.

    Args:
        prisms: boxes or cylinders.
        eye: position [m].
        eye_within: whether the eye is within each in plan.
        normals: n_l and n_r.
        distances: smallest and largest distance in plan [m].
        sides: the remaining fields.
    """
    # Nothing is visible below the floor, where inactive prisms are.
    z_t, z_b = prisms.top - eye[2], maximum(prisms.bottom, 0.0) - eye[2]
    from_above, from_below = z_t < 0, z_b > 0
    cap_z, opposite_z = jnp.where(from_below, z_b, z_t), jnp.where(from_below, z_t, z_b)
    bounded = jnp.where(eye_within, 0.0, 1.0)[:, None]
    silhouette = Silhouette(
        left_normal=_xy(normals[0] * bounded),
        right_normal=_xy(normals[1] * bounded),
        wedge=jnp.where(is_inactive(prisms), 0.0, jnp.where(eye_within, 1.0, 0.5)),
        cap_z=cap_z,
        opposite_z=opposite_z,
        inverse_cap_z=jnp.where(from_above | from_below, 1.0 / _away_from_zero(cap_z), 0.0),
        centre=_xy(prisms.centre - eye[:2]),
        texture=texture.prepare(prisms.texture),
        **sides._asdict(),
    )
    nearest, farthest = maximum(distances[0], MIN_DISTANCE), distances[1]
    highest = jnp.arctan2(z_t, jnp.where(from_above, farthest, nearest))
    lowest = jnp.arctan2(z_b, jnp.where(from_below, farthest, nearest))
    return silhouette, lax.stop_gradient(Bounds(nearest, lowest, highest, eye_within))


def _tangent_normals(o: Array, corners: Float[Array, "n 4 2"]) -> Pair:
    """Return the inward normals of the vertical planes through the eye and a box's leftmost and rightmost corner."""
    along = o[:, None, 0] * corners[..., 0] + o[:, None, 1] * corners[..., 1]
    aside = o[:, None, 0] * corners[..., 1] - o[:, None, 1] * corners[..., 0]
    angle = jnp.arctan2(*lax.stop_gradient((aside, along)))
    unit = corners / maximum(safe_norm(corners), MIN_DISTANCE)[..., None]
    left = jnp.take_along_axis(unit, jnp.argmax(angle, axis=1)[:, None, None], axis=1)[:, 0]
    right = jnp.take_along_axis(unit, jnp.argmin(angle, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.stack([left[:, 1], -left[:, 0]], axis=-1), jnp.stack([-right[:, 1], right[:, 0]], axis=-1)


def _away_from_zero(x: Array) -> Array:
    """Return x with a magnitude of at least MIN_DISTANCE, a divisor that is safe in forward and reverse mode."""
    return jnp.where(jnp.abs(x) < MIN_DISTANCE, jnp.where(x < 0, -MIN_DISTANCE, MIN_DISTANCE), x)


def _xy(vector: Array) -> Pair:
    return vector[..., 0], vector[..., 1]
