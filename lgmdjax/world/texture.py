"""Patterns that fill space: contrast at several scales, and what is left of it in a pixel.

A pattern is a sum of plane waves about the thing that wears it, so it runs on over corners and rims, and one
function serves sides, tops, walls and floor. A pixel sees the mean over its footprint: of a wave whose phase
changes by g turns from a pixel to the next, sinc(pi g) is left, in rows and columns alike. Every wave so fades out
before its length falls below a pixel, and the mean brightness is kept.

| symbol | name                                                | unit    | where                                       |
| ------ | --------------------------------------------------- | ------- | ------------------------------------------- |
| f      | pattern                                             | 1, +-1  | sum_b w_b wave(k_b . p / scale + phase s_b) |
| p      | point from the wearer's centre, (x, h y, z)         | m       | world axes, z from the floor                |
| k_b    | wave vector of band b                               | turns   | `WAVES`                                     |
| w_b    | weight of band b, sum 1                             | 1       | `WEIGHTS`                                   |
| s_b    | by how much the phase shifts band b                 | 1       | `PHASES`                                    |
| g_u    | change of phase from column to column; g_v: rows    | turns   | k_b . dp / scale                            |
| B, C   | brightness, contrast                                | grey, 1 | grey = B + min(C B, 255 - B) f              |

wave(x) = 8 x (1 - 2 |x|) for x in [-1/2, 1/2]: parabolas that look like a sine, at a third of its price.
"""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.minmax import maximum, minimum

WAVES = ((0.83, 0.61, 0.0), (0.0, 1.62, 1.47), (3.6, 0.0, 3.1), (0.0, -7.3, 5.9))
"""k_b in turns a coarsest wavelength. Each lies in a plane of two axes: a product less, and no face is left plain."""
WEIGHTS = (0.36, 0.29, 0.2, 0.15)
PHASES = (1.0, 2.3, 3.7, 5.1)
_TURN = 0.15915494309189535

Vector = tuple[Array, Array, Array]


class Texture(NamedTuple):
    """A texture row made ready: mean grey, amplitude in grey, phase in turns, coarsest waves a metre."""

    brightness: Array
    amplitude: Array
    phase: Array
    frequency: Array


def prepare(row: Float[Array, "*n 4"]) -> Texture:
    """Turn texture rows (brightness, contrast, phase, scale) into what `grey` takes."""
    brightness, contrast, phase, scale = (row[..., i] for i in range(4))
    amplitude = minimum(contrast * brightness, 255.0 - brightness)
    return Texture(brightness, amplitude, phase * _TURN, 1.0 / scale)


def grey(texture: Texture, point: Vector, across: Vector, down: Vector, bands: int) -> Array:
    """Evaluate the mean grey of a pixel that sees `point`, whose neighbours see it moved `across` and `down`.

    All three in coarsest wavelengths; of `WAVES` the first `bands` are used. The mean of a wave over the pixel is
    taken as max(0, 1 - pi^2 (g_u^2 + g_v^2)/12)^2 of it, which is sinc(pi g_u) sinc(pi g_v) to 0.06.
    Gradient: exact but for the kink where a wave vanishes.
    """
    chosen = list(zip(WAVES, WEIGHTS, PHASES, strict=True))[:bands]
    total = sum(weight for _, weight, _ in chosen)
    pattern = sum(
        weight / total * _kept(_dot(k, across), _dot(k, down)) * wave(_dot(k, point) + texture.phase * s)
        for k, weight, s in chosen
    )
    return texture.brightness + texture.amplitude * pattern


def wave(turns: Array) -> Array:
    """Evaluate the periodic wave: +-1, odd, smooth but for its second derivative."""
    x = turns - jnp.round(turns)
    return 8.0 * x * (1.0 - 2.0 * jnp.abs(x))


def _kept(across: Array, down: Array) -> Array:
    left = maximum(1.0 - 0.8224670334 * (across * across + down * down), 0.0)
    return left * left


def _dot(k: tuple[float, float, float], vector: Vector) -> Array:
    return functools.reduce(operator.add, (a * b for a, b in zip(k, vector, strict=True) if a != 0.0))
