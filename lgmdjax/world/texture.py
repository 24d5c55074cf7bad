"""Solid textures with contrast at several scales, averaged over the footprint of a pixel.

A pattern is a sum of plane waves in the space around an object. It is therefore continuous over corners and rims, and
one function serves sides, tops, walls and floor. A pixel sees the mean over its footprint. This multiplies a wave whose
phase changes by g turns from one pixel to the next by sinc(pi g), for rows and columns alike. Every wave thus fades out
before its wavelength falls below a pixel, and the mean brightness is preserved.

| symbol | name                                                | unit    | where                                       |
| ------ | --------------------------------------------------- | ------- | ------------------------------------------- |
| f      | pattern                                             | 1, +-1  | sum_b w_b wave(k_b . p / scale + phase s_b) |
| p      | point from the object's centre, (x, h y, z)         | m       | world axes, z from the floor                |
| k_b    | wave vector of band b                               | turns   | `WAVES`                                     |
| w_b    | weight of band b, sum 1                             | 1       | `WEIGHTS`                                   |
| s_b    | factor of the phase in band b                       | 1       | `PHASES`                                    |
| g_u    | phase change between columns (g_v: between rows)    | turns   | k_b . dp / scale                            |
| B, C   | brightness, contrast                                | grey, 1 | grey = B + min(C B, 255 - B) f              |

wave(x) = 8 x (1 - 2 |x|) for x in [-1/2, 1/2]: two parabolas that approximate a sine at a third of its cost.
"""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.minmax import maximum, minimum

WAVES = ((0.83, 0.61, 0.0), (0.0, 1.62, 1.47), (3.6, 0.0, 3.1), (0.0, -7.3, 5.9))
"""k_b in turns per longest wavelength. Each lies in a plane of two axes: this saves a product, and every face has
contrast."""
WEIGHTS = (0.36, 0.29, 0.2, 0.15)
PHASES = (1.0, 2.3, 3.7, 5.1)
_TURNS_PER_RADIAN = 0.15915494309189535

Vector = tuple[Array, Array, Array]


class Texture(NamedTuple):
    """Texture rows in the form that `grey_level` uses."""

    brightness: Array  # mean grey level
    amplitude: Array  # grey levels
    phase: Array  # turns
    frequency: Array  # longest wavelengths per metre


def prepare(row: Float[Array, "*n 4"]) -> Texture:
    """Convert texture rows (brightness, contrast, phase, scale) to the form that `grey_level` uses."""
    brightness, contrast, phase, scale = (row[..., i] for i in range(4))
    amplitude = minimum(contrast * brightness, 255.0 - brightness)
    return Texture(brightness, amplitude, phase * _TURNS_PER_RADIAN, 1.0 / scale)


def grey_level(texture: Texture, point: Vector, across: Vector, down: Vector, bands: int) -> Array:
    """Return the mean grey level of a pixel that sees `point`.

    The factor sinc(pi g_u) sinc(pi g_v) is approximated by max(0, 1 - pi^2 (g_u^2 + g_v^2)/12)^2, to 0.06.

    Gradient: exact except at the kink where a wave fades out.

    Args:
        texture: from `prepare`.
        point: in longest wavelengths.
        across: displacement of the point between neighbouring columns, in longest wavelengths.
        down: the same between neighbouring rows.
        bands: number of waves used, the first of `WAVES`.

    >>> plain = prepare(jnp.array([128.0, 0.0, 0.0, 0.5]))
    >>> zero = jnp.zeros(3)
    >>> float(grey_level(plain, (zero[0], zero[1], zero[2]), (zero[0],) * 3, (zero[0],) * 3, bands=4))
    128.0
    """
    used = list(zip(WAVES, WEIGHTS, PHASES, strict=True))[:bands]
    total = sum(weight for _, weight, _ in used)
    pattern = sum(
        weight
        / total
        * _attenuation(_dot(k, across), _dot(k, down))
        * parabolic_wave(_dot(k, point) + texture.phase * s)
        for k, weight, s in used
    )
    return texture.brightness + texture.amplitude * pattern


def parabolic_wave(turns: Array) -> Array:
    """Return the periodic wave of period 1 and range -1 .. 1: odd, with a continuous first derivative.

    >>> parabolic_wave(jnp.array([0.0, 0.25, 0.5, 0.75])).tolist()
    [0.0, 1.0, 0.0, -1.0]
    """
    x = turns - jnp.round(turns)
    return 8.0 * x * (1.0 - 2.0 * jnp.abs(x))


def _attenuation(across: Array, down: Array) -> Array:
    """Return the factor by which averaging over a pixel reduces a wave; arguments in turns per pixel."""
    root = maximum(1.0 - 0.8224670334 * (across * across + down * down), 0.0)
    return root * root


def _dot(k: tuple[float, float, float], vector: Vector) -> Array:
    return functools.reduce(operator.add, (a * b for a, b in zip(k, vector, strict=True) if a != 0.0))
