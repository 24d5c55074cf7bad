"""Area coverage of a pixel by a half-plane: which part is on the inner side of a straight edge, and where.

| symbol   | name                                         | unit | where                                           |
| -------- | -------------------------------------------- | ---- | ----------------------------------------------- |
| d        | direction of a ray in the world              | 1    |                                                 |
| d_u, d_v | its change from column to column, row to row | 1/px |                                                 |
| m        | margin by which a ray is inside an outline   |      |                                                 |
| p, q     | larger and smaller derivative of m           | 1/px | of abs(dm/du), abs(dm/dv)                       |
| k        | obliqueness of an edge                       | 1    | q/p: 0 along rows or columns, 1 on the diagonal |
| a        | coverage: part of a pixel that is inside     | 1    | `edge_coverage` of m/p and k, exact; at top and |
|          |                                              |      | bottom of prisms `linear_coverage`, to 0.07     |
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from lgmdjax.minmax import clip, maximum, minimum
from lgmdjax.sensors.fusion import fusible
from lgmdjax.sensors.silhouettes import Pair
from lgmdjax.world.texture import Vector


class EdgeOrientation(NamedTuple):
    """Orientation of a straight edge relative to the pixel grid: p, 1/p, k/2 and 1/k."""

    p: Array
    inverse_p: Array
    half_k: Array
    inverse_k: Array


class PixelRays(NamedTuple):
    """One ray per pixel, with its change from pixel to pixel."""

    d: Vector
    d_u: Vector
    d_v: Vector
    upright: EdgeOrientation
    """Orientation of vertical edges at the pixel."""
    pixel_scale: Pair
    """(d_x, d_y)/p for vertical edges: its product with a vertical plane's unit normal is the margin in pixels."""
    rightward: Pair
    """Shift in columns and rows that raises the margin of a vertical edge by one pixel towards the right."""
    rightward_d: Pair
    """Change of d_x and d_y over that shift."""


def pixel_rays(d: Vector, d_u: Vector, d_v: Vector) -> PixelRays:
    """Return rays, given their directions and the derivatives of these by column and row."""
    m_u, m_v = d[1] * d_u[0] - d[0] * d_u[1], d[1] * d_v[0] - d[0] * d_v[1]
    upright = _edge_orientation(m_u, m_v)
    inverse = upright.inverse_p
    per_pixel = fusible(jnp.sqrt(d[0] * d[0] + d[1] * d[1] + 1e-12)) * inverse
    pixel_scale, (right_u, right_v) = (d[0] * per_pixel, d[1] * per_pixel), (m_u * inverse, m_v * inverse)
    rightward_d = right_u * d_u[0] + right_v * d_v[0], right_u * d_u[1] + right_v * d_v[1]
    return PixelRays(d, d_u, d_v, upright, pixel_scale, (right_u, right_v), rightward_d)


def inverse_depth(s: Pair, rays: PixelRays) -> Vector:
    """Return 1/t on a vertical face, and its change from column to column and row to row."""
    x, y, z = (s[0] * d[0] + s[1] * d[1] for d in (rays.d, rays.d_u, rays.d_v))
    return x, y, z


def _edge_orientation(m_u: Array, m_v: Array) -> EdgeOrientation:
    """Return p, 1/p, k/2 and 1/k of an edge from the derivatives of its margin."""
    m_u, m_v = jnp.abs(m_u), jnp.abs(m_v)
    p = maximum(m_u, m_v) + 1e-9
    q = maximum(minimum(m_u, m_v), 1e-3 * p)
    both = fusible(1.0 / (p * q))  # a single division for both quotients
    return EdgeOrientation(p, q * both, 0.5 * q * q * both, p * p * both)


def edge_coverage(margin: Array, edge: EdgeOrientation) -> Array:
    """Return a, the part of a pixel on the inner side of a straight edge, given the margin m/p of the pixel's centre.

    The smaller of the two parts is a corner of the pixel: a triangle of height x, cut off at k.
    """
    x = maximum(0.5 + edge.half_k - jnp.abs(margin), 0.0)
    cut = minimum(x, 2.0 * edge.half_k)
    corner = edge.inverse_k * (x - 0.5 * cut) * cut
    return jnp.where(margin > 0, 1.0 - corner, corner)


def linear_coverage(margin: Array) -> Array:
    """Return an approximation to `edge_coverage` at half its cost, for a margin in units of the edge's width."""
    return clip(0.5 + margin, 0.0, 1.0)


def edge_coverage_and_direction(margin: Vector) -> tuple[Array, Pair]:
    """Return the part of a pixel where a margin is positive, and the direction (columns, rows) in which it grows.

    Args:
        margin: m, dm/du and dm/dv.
    """
    m, m_u, m_v = margin
    edge = _edge_orientation(m_u, m_v)
    return edge_coverage(m * edge.inverse_p, edge), (m_u * edge.inverse_p, m_v * edge.inverse_p)


def coverage_below(z: Array, inverse_depth: Vector, rays: PixelRays) -> tuple[Array, Pair]:
    """Return the part of a pixel that is below the height z on a face, and the direction in which it grows."""
    return edge_coverage_and_direction(_height_margin(z, inverse_depth, rays))


def margin_below(z: Array, inverse_depth: Vector, rays: PixelRays) -> tuple[Array, Pair]:
    """Return by how many pixels rays pass below the height z on a face, and the direction in which this grows."""
    m, m_u, m_v = _height_margin(z, inverse_depth, rays)
    across, along = jnp.abs(m_u), jnp.abs(m_v)
    # The transition of an oblique edge is wider; 0.2 is the best factor for a linear one.
    inverse = fusible(1.0 / (maximum(across, along) + 0.2 * minimum(across, along) + 1e-9))
    return m * inverse, (m_u * inverse, m_v * inverse)


def _height_margin(z: Array, inverse_depth: Vector, rays: PixelRays) -> Vector:
    """Return m = z/t - d_z on a face, and its derivatives."""
    m, m_u, m_v = (z * a - d[2] for a, d in zip(inverse_depth, (rays.d, rays.d_u, rays.d_v), strict=True))
    return m, m_u, m_v
