"""Edges within a pixel: how much of it lies on either side of a straight one, and where the middle of that is.

| symbol   | name                                         | unit | where                                          |
| -------- | -------------------------------------------- | ---- | ---------------------------------------------- |
| d        | direction of a ray in the world              | 1    |                                                |
| d_u, d_v | its change from column to column, row to row | 1/px |                                                |
| m        | margin by which a ray is inside an outline   |      |                                                |
| p, q     | the larger and the smaller slope of m        | 1/px | of abs(dm/du), abs(dm/dv)                      |
| k        | slant of an edge                             | 1    | q/p: 0 along rows or columns, 1 halfway        |
| a        | part of a pixel that is inside               | 1    | `part` of m/p and k, exact; at the ends of     |
|          |                                              |      | prisms `ramp`, to 0.07                         |
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from lgmdjax.minmax import maximum, minimum, clip
from lgmdjax.sensors.silhouettes import Pair
from lgmdjax.world.texture import Vector


class Slant(NamedTuple):
    """How an edge lies in a pixel: p, 1/p, k/2 and 1/k."""

    p: Array
    per_p: Array
    half: Array
    inverse: Array


class Rays(NamedTuple):
    """One ray a pixel, and how it turns from pixel to pixel."""

    d: Vector
    d_u: Vector
    d_v: Vector
    slant: Slant
    """Of upright edges."""
    across: Pair
    """(d_x, d_y)/p for upright edges: times a plane's unit normal, the margin in pixels."""
    rightward: Pair
    """Columns and rows to the right, across upright edges, for a pixel of margin."""
    turn: Pair
    """What that adds to d_x and d_y."""


def rays(d: Vector, d_u: Vector, d_v: Vector) -> Rays:
    """Complete rays given by their directions and how these change."""
    m_u, m_v = d[1] * d_u[0] - d[0] * d_u[1], d[1] * d_v[0] - d[0] * d_v[1]
    slant = _slant(m_u, m_v)
    inverse = slant.per_p
    per_pixel = once(jnp.sqrt(d[0] * d[0] + d[1] * d[1] + 1e-12)) * inverse
    across, (right_u, right_v) = (d[0] * per_pixel, d[1] * per_pixel), (m_u * inverse, m_v * inverse)
    turn = right_u * d_u[0] + right_v * d_v[0], right_u * d_u[1] + right_v * d_v[1]
    return Rays(d, d_u, d_v, slant, across, (right_u, right_v), turn)


def slopes(s: Pair, pixels: Rays) -> Vector:
    """1/t on an upright face, and its change from column to column and row to row."""
    x, y, z = (s[0] * d[0] + s[1] * d[1] for d in (pixels.d, pixels.d_u, pixels.d_v))
    return x, y, z


def _slant(m_u: Array, m_v: Array) -> Slant:
    """Take p, q and k of an edge from the slopes of its margin."""
    m_u, m_v = jnp.abs(m_u), jnp.abs(m_v)
    p = maximum(m_u, m_v) + 1e-9
    q = maximum(minimum(m_u, m_v), 1e-3 * p)
    both = once(1.0 / (p * q))  # one division for all
    return Slant(p, q * both, 0.5 * q * q * both, p * p * both)


def part(margin: Array, slant: Slant) -> Array:
    """a: part of a pixel on the inner side of a straight edge that is m/p inside of its middle.

    The other part, or where it is the larger this one, is a corner: a triangle of height x, cut at k.
    """
    x = maximum(0.5 + slant.half - jnp.abs(margin), 0.0)
    cut = minimum(x, 2.0 * slant.half)
    corner = slant.inverse * (x - 0.5 * cut) * cut
    return jnp.where(margin > 0, 1.0 - corner, corner)


def ramp(margin: Array) -> Array:
    """`part` at half its price, for an edge whose margin is in units of its smear."""
    return clip(0.5 + margin, 0.0, 1.0)


def part_and_way(margin: Vector) -> tuple[Array, Pair]:
    """Part of a pixel where a margin, given with its slopes, is positive, and the way to more of it."""
    m, m_u, m_v = margin
    slant = _slant(m_u, m_v)
    return part(m * slant.per_p, slant), (m_u * slant.per_p, m_v * slant.per_p)


def part_below(z: Array, slopes: Vector, pixels: Rays) -> tuple[Array, Pair]:
    """Part of a pixel that is below the height z on a face, and the way to more of it."""
    return part_and_way(_below(z, slopes, pixels))


def rise(z: Array, slopes: Vector, pixels: Rays) -> tuple[Array, Pair]:
    """Margin in pixels by which rays pass below the height z on a face, and the way to more of it."""
    m, m_u, m_v = _below(z, slopes, pixels)
    across, along = jnp.abs(m_u), jnp.abs(m_v)
    # Aslant an edge is smeared farther; of straight ramps this one is the nearest.
    inverse = once(1.0 / (maximum(across, along) + 0.2 * minimum(across, along) + 1e-9))
    return m * inverse, (m_u * inverse, m_v * inverse)


def _below(z: Array, slopes: Vector, pixels: Rays) -> Vector:
    """m = z/t - d_z on a face, and its slopes."""
    m, m_u, m_v = (z * a - d[2] for a, d in zip(slopes, (pixels.d, pixels.d_u, pixels.d_v), strict=True))
    return m, m_u, m_v


@jax.custom_jvp
def once(quotient: Array) -> Array:
    """Give a division a single user, a bound that is never reached: XLA would not fuse it into several, nor anything
    before it, and write them all to memory."""
    return jnp.minimum(quotient, 1e30)


once.defjvps(lambda change, _, quotient: change)
