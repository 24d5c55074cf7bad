"""What a locust is shown in the laboratory: pictures as functions of time, for any detector that has a `step`.

Each stimulus is `stimulus(eyes, ..., time) -> picture` for one eye; `jax.vmap` over times makes a film of it, and
`lax.scan` of `functools.partial(step, params)` shows the film to a detector.

| symbol  | name              | unit | meaning                                                          |
| ------- | ----------------- | ---- | ---------------------------------------------------------------- |
| l       | -                 | m    | half the size of a square object                                  |
| v       | -                 | m/s  | its speed towards the eye, constant                               |
| l/|v|   | ratio             | s    | all that the growth of its picture depends on                     |
| t       | time              | s    | before contact negative, which is at 0                            |
| theta/2 | half angle        | rad  | atan(l/|v| / -t)                                                  |

Source: Gabbiani, Krapp & Laurent 1999 for l/|v| and theta; Rind & Simmons 1992 for the movements that a looming
detector should not answer. The pictures are ours. Edges are a pixel soft. Gradient: exact, but for those edges' ends.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.sensors import camera
from lgmdjax.world import texture

DARK, BRIGHT = 40.0, 160.0  # grey
PANORAMA = (120.0, 0.5, 0.0, 0.4)  # texture row of the surroundings that turn: on a sphere of radius 1

Scalar = Float[Array, ""] | float
Picture = Float[Array, "height width"]


def approach(eyes: camera.Params, ratio: Scalar, time: Scalar) -> Picture:
    """Show a dark square that comes straight at the eye with l/|v| = `ratio` [s], until it is everywhere at t = 0."""
    half_angle = jnp.arctan2(jnp.asarray(ratio, float), jnp.maximum(-jnp.asarray(time, float), 0.0))
    return _square(eyes, half_angle, 0.0)


def recession(eyes: camera.Params, ratio: Scalar, time: Scalar) -> Picture:
    """Show the approach backwards: the square leaves at t = 0."""
    return approach(eyes, ratio, -jnp.asarray(time))


def translation(eyes: camera.Params, half_angle: Scalar, rate: Scalar, time: Scalar) -> Picture:
    """Show a dark square of constant size that goes round the eye at `rate` [rad/s], to the left, ahead at t = 0."""
    return _square(eyes, jnp.asarray(half_angle, float), rate * jnp.asarray(time, float))


def grating(eyes: camera.Params, period: Scalar, rate: Scalar, time: Scalar) -> Picture:
    """Show upright bars, a sine of `period` [rad], that go round the eye at `rate` [rad/s], to the left."""
    d, _, _ = _directions(eyes)
    turns = (jnp.arctan2(d[1], d[0]) - rate * jnp.asarray(time, float)) / period
    kept = jnp.sinc(eyes.fov / eyes.width / jnp.asarray(period, float))  # of a wave, in a pixel's mean
    return 0.5 * (DARK + BRIGHT) + 0.5 * (BRIGHT - DARK) * kept * jnp.sin(2.0 * jnp.pi * turns)


def yaw(eyes: camera.Params, rate: Scalar, time: Scalar) -> Picture:
    """Show what an eye sees that turns left at `rate` [rad/s] amid far, textured surroundings."""
    return _panorama(eyes, _about_z(rate * jnp.asarray(time, float)))


def sway(eyes: camera.Params, amplitude: Scalar, period: Scalar, time: Scalar) -> Picture:
    """Show what an eye sees that rolls by a sine of `amplitude` [rad] and `period` [s], as a walking trunk does."""
    angle = amplitude * jnp.sin(2.0 * jnp.pi * jnp.asarray(time, float) / period)
    c, s, one, zero = jnp.cos(angle), jnp.sin(angle), jnp.ones_like(angle), jnp.zeros_like(angle)
    return _panorama(eyes, jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3))


def _square(eyes: camera.Params, half_angle: Array, azimuth: Scalar) -> Picture:
    """Draw a square that subtends `half_angle` to either side of its middle, at an azimuth and the eye's height."""
    d, _, _ = _directions(eyes)
    x, y, z = _turned(_about_z(-jnp.asarray(azimuth, float)), d)
    pitch = eyes.fov / eyes.width  # rad a pixel
    across, up = (jnp.clip((half_angle - jnp.abs(jnp.arctan2(side, x))) / pitch + 0.5, 0.0, 1.0) for side in (y, z))
    return BRIGHT + (DARK - BRIGHT) * across * up


def _panorama(eyes: camera.Params, rotation: Float[Array, "3 3"]) -> Picture:
    """Draw far surroundings from an eye that is turned by `rotation`."""
    point, across, down = (_turned(rotation, vectors) for vectors in _directions(eyes))
    pattern = texture.prepare(jnp.asarray(PANORAMA, float))

    def scaled(vector: texture.Vector) -> texture.Vector:
        x, y, z = vector
        return pattern.frequency * x, pattern.frequency * y, pattern.frequency * z

    return texture.grey(pattern, scaled(point), scaled(across), scaled(down), bands=len(texture.WAVES))


def _about_z(angle: Array) -> Float[Array, "3 3"]:
    c, s, one, zero = jnp.cos(angle), jnp.sin(angle), jnp.ones_like(angle), jnp.zeros_like(angle)
    return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)


def _turned(rotation: Float[Array, "3 3"], vectors: Float[np.ndarray, "3 ..."]) -> texture.Vector:
    x, y, z = (
        rotation[i, 0] * vectors[0] + rotation[i, 1] * vectors[1] + rotation[i, 2] * vectors[2] for i in range(3)
    )
    return x, y, z


@lru_cache(maxsize=8)
def _directions(eyes: camera.Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions of an eye's pixels in its frame (3, height, width), and their changes along a row and a column."""
    v, u = np.mgrid[: eyes.height, : eyes.width] + 0.5
    f = eyes.width / eyes.fov
    return camera.equidistant(u - 0.5 * eyes.width, v - 0.5 * eyes.height, f)
