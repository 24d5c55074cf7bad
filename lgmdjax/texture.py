"""Patterns that fill space: contrast at several scales, and what is left of it in a pixel.

A pattern is a sum of plane waves in the frame of the thing that wears it, so it runs on over corners and rims, and one
function serves sides, tops, walls and floor. A pixel sees the mean over its footprint: of a wave whose phase changes by
g turns from a pixel to the next, sinc(pi g) is left, in rows and columns alike. Every wave so fades out before its
length falls below a pixel, and the mean brightness is kept.

| symbol | name                                   | unit     | where                                          |
| ------ | -------------------------------------- | -------- | ---------------------------------------------- |
| f      | pattern                                | 1, +-1   | sum_b w_b wave(k_b . p / scale + phase s_b)    |
| p      | point in the wearer's frame (x, h y, z) | m        |                                                |
| k_b    | wave vector of band b                  | turns    | `WAVES`                                        |
| w_b    | weight of band b, sum 1                | 1        | `WEIGHTS`                                      |
| g      | change of phase from pixel to pixel    | turns    | k_b . dp / scale                               |
| B, C   | brightness, contrast                   | grey, 1  | grey = B + min(C B, 255 - B) f                 |

wave(x) = 8 x (1 - 2 |x|) for x in [-1/2, 1/2], the parabolas that look like a sine (1 % of their power is not in it).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

WAVES = ((0.62, 0.59, 0.52), (-1.66, 1.49, 0.86), (1.72, 2.62, -3.91))
"""Wave vectors k_b in turns a coarsest wavelength: about 1, 2.4 and 5 of them, no two along one line."""
WEIGHTS = (0.4, 0.33, 0.27)
PHASES = (1.0, 2.3, 3.7)
"""What a texture's phase is multiplied with in each band, so that it moves the bands against each other."""
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
    amplitude = jnp.minimum(contrast * brightness, 255.0 - brightness)
    return Texture(brightness, amplitude, phase * _TURN, 1.0 / scale)


def grey(texture: Texture, point: Vector, across: Vector, down: Vector) -> Array:
    """Evaluate the mean grey of a pixel that sees `point`, whose neighbours see it moved `across` and `down` [m].

    Gradient: exact but for the kinks where a wave's length is a pixel (it vanishes there).
    """
    frequency = texture.frequency
    bands = zip(WAVES, WEIGHTS, PHASES, strict=True)
    pattern = sum(
        weight
        * _kept(_dot(k, across) * frequency)
        * _kept(_dot(k, down) * frequency)
        * wave(_dot(k, point) * frequency + texture.phase * s)
        for k, weight, s in bands
    )
    return texture.brightness + texture.amplitude * pattern


def wave(turns: Array) -> Array:
    """Evaluate the periodic wave: +-1, odd, smooth but for its second derivative."""
    x = turns - jnp.round(turns)
    return 8.0 * x * (1.0 - 2.0 * jnp.abs(x))


def _kept(turns: Array) -> Array:
    """What a box one pixel wide leaves of a wave that turns so far in it: sinc to 0.02, nothing above one turn."""
    square = jnp.minimum(turns * turns, 1.0)
    return (1.0 - square) * (1.0 - 0.645 * square)


def _dot(k: tuple[float, float, float], vector: Vector) -> Array:
    return k[0] * vector[0] + k[1] * vector[1] + k[2] * vector[2]
