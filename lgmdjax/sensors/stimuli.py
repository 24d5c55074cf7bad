"""Laboratory stimuli: images as functions of time, for testing a looming detector.

Each stimulus is `stimulus(params, ..., time) -> image` for one eye. `jax.vmap` over times gives a sequence of images,
and `lax.scan` of `functools.partial(step, detector_params)` runs a detector on it.

| symbol  | name              | unit | meaning                                                          |
| ------- | ----------------- | ---- | ---------------------------------------------------------------- |
| l       | -                 | m    | half the size of a square object                                  |
| v       | -                 | m/s  | its speed of approach, constant                                   |
| l/|v|   | l_over_v          | s    | determines the growth of the image                                |
| t       | time              | s    | 0 at contact, negative before                                     |
| theta/2 | half_angle        | rad  | atan(l/|v| / -t)                                                  |

Source: Gabbiani, Krapp & Laurent 1999 for l/|v| and theta; Rind & Simmons 1992 for the movements to which a looming
detector should not respond. The images are ours. Edges are one pixel wide.

Gradient: exact, except at the two ends of those edges, where the grey level has a kink.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.sensors import camera
from lgmdjax.world import texture

DARK, BRIGHT = 40.0, 160.0  # grey
PANORAMA_TEXTURE = (120.0, 0.5, 0.0, 0.4)  # texture row of the surroundings, a sphere of radius 1
OBJECT_TEXTURE = (120.0, 0.5, 2.0, 0.8)  # of a textured square of half size 1, as bright as the surroundings
LARGEST_ANGLE = 1.5  # rad, half size beyond which an object's texture grows no more

Scalar = Float[Array, ""] | float
Image = Float[Array, "height width"]


def approach(params: camera.Params, l_over_v: Scalar, time: Scalar) -> Image:
    """Return the image of a dark square on a collision course, which fills the field of view at t = 0.

    >>> image = approach(camera.Params(width=9, height=5), l_over_v=0.1, time=-0.1)
    >>> image[2].round().tolist()
    [160.0, 160.0, 54.0, 40.0, 40.0, 40.0, 54.0, 160.0, 160.0]

    Args:
        params: of the camera.
        l_over_v: l/|v| of the square [s].
        time: t [s].
    """
    return _square(params, _half_angle(l_over_v, time), 0.0)


def recession(params: camera.Params, l_over_v: Scalar, time: Scalar) -> Image:
    """Return the image of a square that moves away from contact at t = 0: `approach` in reverse."""
    return approach(params, l_over_v, -jnp.asarray(time))


def translation(params: camera.Params, half_angle: Scalar, rate: Scalar, time: Scalar) -> Image:
    """Return the image of a dark square of constant size that circles the eye to the left, straight ahead at t = 0.

    Args:
        params: of the camera.
        half_angle: half the size of the square [rad].
        rate: angular velocity [rad/s].
        time: t [s].
    """
    return _square(params, jnp.asarray(half_angle, float), rate * jnp.asarray(time, float))


def elongation(params: camera.Params, half_height: Scalar, l_over_v: Scalar, time: Scalar) -> Image:
    """Return the image of a dark bar that gets longer to both sides, as an approaching square gets wider.

    Args:
        params: of the camera.
        half_height: half the height of the bar, which is constant [rad].
        l_over_v: l/|v| of the square [s].
        time: t [s].
    """
    half_width = _half_angle(l_over_v, time)
    return BRIGHT + (DARK - BRIGHT) * _coverage(params, half_width, jnp.asarray(half_height, float), 0.0)


def textured_approach(params: camera.Params, l_over_v: Scalar, time: Scalar) -> Image:
    """Return the image of a textured square on a collision course, in front of equally bright surroundings.

    Args:
        params: of the camera.
        l_over_v: l/|v| of the square [s].
        time: t [s].
    """
    half_angle = _half_angle(l_over_v, time)
    covered = _coverage(params, half_angle, half_angle, 0.0)
    ground = _panorama(params, _about_z(jnp.zeros_like(half_angle)))
    return ground + (_plate(params, jnp.minimum(half_angle, LARGEST_ANGLE)) - ground) * covered


def flash(params: camera.Params, time: Scalar) -> Image:
    """Return the image of a dark room in which a light goes on at t = 0."""
    light = jnp.where(jnp.asarray(time, float) >= 0.0, BRIGHT, DARK)
    return jnp.full((params.height, params.width), light)


def grating(params: camera.Params, period: Scalar, rate: Scalar, time: Scalar) -> Image:
    """Return the image of a vertical sine grating that circles the eye to the left.

    Args:
        params: of the camera.
        period: of the grating [rad].
        rate: angular velocity [rad/s].
        time: t [s].
    """
    d, _, _ = _directions(params)
    turns = (jnp.arctan2(d[1], d[0]) - rate * jnp.asarray(time, float)) / period
    attenuation = jnp.sinc(params.fov / params.width / jnp.asarray(period, float))  # of the grating by a pixel's mean
    return 0.5 * (DARK + BRIGHT) + 0.5 * (BRIGHT - DARK) * attenuation * jnp.sin(2.0 * jnp.pi * turns)


def yaw(params: camera.Params, rate: Scalar, time: Scalar) -> Image:
    """Return the image of an eye that turns left at `rate` [rad/s] in distant textured surroundings."""
    return _panorama(params, _about_z(rate * jnp.asarray(time, float)))


def roll(params: camera.Params, amplitude: Scalar, period: Scalar, time: Scalar) -> Image:
    """Return the image of an eye that rolls sinusoidally, as the trunk of a walking robot does.

    Args:
        params: of the camera.
        amplitude: of the roll angle [rad].
        period: of the roll [s].
        time: t [s].
    """
    angle = amplitude * jnp.sin(2.0 * jnp.pi * jnp.asarray(time, float) / period)
    c, s, one, zero = jnp.cos(angle), jnp.sin(angle), jnp.ones_like(angle), jnp.zeros_like(angle)
    return _panorama(params, jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3))


def _square(params: camera.Params, half_angle: Array, azimuth: Scalar) -> Image:
    """Return the image of a square with half size `half_angle` [rad], at an azimuth [rad] and at the eye's height."""
    return BRIGHT + (DARK - BRIGHT) * _coverage(params, half_angle, half_angle, azimuth)


def _half_angle(l_over_v: Scalar, time: Scalar) -> Float[Array, ""]:
    return jnp.arctan2(jnp.asarray(l_over_v, float), jnp.maximum(-jnp.asarray(time, float), 0.0))


def _coverage(params: camera.Params, half_width: Array, half_height: Array, azimuth: Scalar) -> Image:
    """Return the part of each pixel that a rectangle covers, at an azimuth [rad] and at the eye's height."""
    d, _, _ = _directions(params)
    x, y, z = _rotate(_about_z(-jnp.asarray(azimuth, float)), d)
    pitch = params.fov / params.width  # rad per pixel
    sides = ((half_width, y), (half_height, z))
    width, height = (jnp.clip((half - jnp.abs(jnp.arctan2(side, x))) / pitch + 0.5, 0.0, 1.0) for half, side in sides)
    return width * height


def _plate(params: camera.Params, half_angle: Array) -> Image:
    """Return the image of an endless textured plate ahead, at the distance where a half size has `half_angle`."""
    surface = texture.prepare(jnp.asarray(OBJECT_TEXTURE, float))
    d, d_u, d_v = _directions(params)
    x, scale = np.maximum(d[0], 0.05), surface.frequency / jnp.tan(half_angle)  # nearly all rays below it miss

    def on_plate(derivative: np.ndarray) -> texture.Vector:
        y, z = ((derivative[i] * x - d[i] * derivative[0]) / x**2 for i in (1, 2))
        return jnp.zeros_like(scale * y), scale * y, scale * z

    point = (jnp.zeros_like(scale * x), scale * (d[1] / x), scale * (d[2] / x))
    return texture.grey_level(surface, point, on_plate(d_u), on_plate(d_v), bands=len(texture.WAVES))


def _panorama(params: camera.Params, rotation: Float[Array, "3 3"]) -> Image:
    """Return the image of distant surroundings for an eye with the orientation `rotation`."""
    point, across, down = (_rotate(rotation, vectors) for vectors in _directions(params))
    surroundings = texture.prepare(jnp.asarray(PANORAMA_TEXTURE, float))

    def scaled(vector: texture.Vector) -> texture.Vector:
        x, y, z = vector
        return surroundings.frequency * x, surroundings.frequency * y, surroundings.frequency * z

    return texture.grey_level(surroundings, scaled(point), scaled(across), scaled(down), bands=len(texture.WAVES))


def _about_z(angle: Array) -> Float[Array, "3 3"]:
    c, s, one, zero = jnp.cos(angle), jnp.sin(angle), jnp.ones_like(angle), jnp.zeros_like(angle)
    return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)


def _rotate(rotation: Float[Array, "3 3"], vectors: Float[np.ndarray, "3 ..."]) -> texture.Vector:
    x, y, z = (
        rotation[i, 0] * vectors[0] + rotation[i, 1] * vectors[1] + rotation[i, 2] * vectors[2] for i in range(3)
    )
    return x, y, z


@lru_cache(maxsize=8)
def _directions(params: camera.Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels' directions in the eye's frame (3, height, width), and their derivatives by column and row."""
    v, u = np.mgrid[: params.height, : params.width] + 0.5
    f = params.width / params.fov
    return camera.equidistant_directions(u - 0.5 * params.width, v - 0.5 * params.height, f)
