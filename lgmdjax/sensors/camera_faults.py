"""Faults of a stereo camera: changes of its pictures between lens and detector, sampled with a random key.

A picture passes, in this order, vignetting, motion blur, automatic exposure, noise, the sensor's gamma, rounding to 8
bits, and JPEG; then it may be dropped, and it arrives late. Without a fault, `step` returns the picture unchanged, but
rounded. A picture smaller than the sensor's is the average of the sensor's pixels: it has less noise, and is rounded to
1/sqrt(n) grey levels, the error that remains of theirs. JPEG's blocks are those of the picture. All numbers are arrays,
so that `vmap` gives each robot of a batch its own camera.

| symbol | name                                           | unit      | where                                       |
| ------ | ---------------------------------------------- | --------- | ------------------------------------------- |
| L      | picture                                        | grey      | 0..255                                      |
| rho    | distance of a pixel from the middle            | 1         | 1 at the left and right edge                |
| c      | loss of light                                  | 1         | L (1 - c min(rho, 1)^2)                     |
| s      | open part of the frame interval                | 1         | L - s/2 (L - previous L): linear in time    |
| g      | logarithm of the gain of the exposure          | 1         | g += w (a - log(mean L / M) - g)            |
| a      | target of g, which drifts (Ornstein-Uhlenbeck) | 1         |                                             |
| n      | sensor pixels averaged in one of the picture   | 1         | (`SENSOR_WIDTH` / width)^2                  |
| e, r   | electrons per grey level, read noise           | 1/grey, 1 | variance (L/e + (r/e)^2) / n                |
| gamma  | gamma of the sensor                            | 1         | 255 (L/255)^gamma                           |
| q      | quality of JPEG                                | 1..100    | steps of ITU-T T.81, scaled as libjpeg does |

Errors of lens and pose are not operations on a picture, because the picture lacks what they bring into view.
`LensError` is for code that casts the rays; `warp` approximates the distortion on a picture.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from lgmdjax.minmax import clip

MAX_LATENCY = 3  # frames
BLOCK = 8  # px, of JPEG
SENSOR_WIDTH = 320  # px, of the robot's camera (paper sec. 3.1)
MEAN_GREY = 118.0  # M, to which automatic exposure brings a picture
EXPOSURE_RATE, DRIFT_TIME = 0.05, 150.0  # w, per frame; time constant of the exposure's drift, frames
LUMINANCE = np.array(
    [
        [16, 11, 10, 16, 24, 40, 51, 61],
        [12, 12, 14, 19, 26, 58, 60, 55],
        [14, 13, 16, 24, 40, 57, 69, 56],
        [14, 17, 22, 29, 51, 87, 80, 62],
        [18, 22, 37, 56, 68, 109, 103, 77],
        [24, 35, 55, 64, 81, 104, 113, 92],
        [49, 64, 78, 87, 103, 121, 120, 101],
        [72, 92, 95, 98, 112, 100, 103, 99],
    ]
)
"""Steps of JPEG's coefficients at quality 50 (ITU-T T.81, table K.1)."""


@struct.dataclass(kw_only=True)
class LensError:
    """How the eyes differ from the calibration: focal length towards the edge, and pose."""

    distortion: Float[Array, ""] | float = 0.0  # at the left and right edge, as a part of the distance from the middle
    turn: Float[Array, "2 3"] | Float[np.ndarray, "2 3"] = struct.field(default_factory=lambda: np.zeros((2, 3)))
    """rotation vector of each eye in its own frame [rad]"""


@struct.dataclass(kw_only=True)
class Params:
    """Faults of both cameras of a robot; by default there are none."""

    vignetting: Float[Array, ""] | float = 0.0  # c
    blur: Float[Array, ""] | float = 0.0  # s
    auto_exposure: Float[Array, ""] | float = 0.0  # 1: the exposure adapts to the picture
    drift: Float[Array, ""] | float = 0.0  # standard deviation of the drift of g
    noise: Float[Array, ""] | float = 0.0  # 1: there is noise
    electrons: Float[Array, ""] | float = 20.0  # e; a full well of 5,100 electrons
    read: Float[Array, ""] | float = 10.0  # r, electrons
    averaged: Float[Array, ""] | float = 1.0  # n
    gamma: Float[Array, ""] | float = 1.0
    quality: Float[Array, ""] | float = 0.0  # q; 0: no JPEG
    dropped: Float[Array, ""] | float = 0.0  # probability that a picture is lost
    latency: Int[Array, ""] | int = 0  # frames, at most `MAX_LATENCY`


@struct.dataclass(kw_only=True)
class State:
    """What the cameras carry from one picture to the next."""

    previous: Float[Array, "2 height width"]
    gain: Float[Array, ""]  # g
    exposure_target: Float[Array, ""]  # a, which drifts
    waiting: Float[Array, "late 2 height width"]  # pictures, the latest first
    arrives: Bool[Array, " late"]  # those that were not dropped
    key: Array


class Delivery(NamedTuple):
    """What the detector is given in a frame."""

    pictures: Float[Array, "2 height width"]
    arrived: Bool[Array, ""]  # whether there is a new picture


def average(params: Params, width: int) -> Params:
    """Return the faults of a sensor of `SENSOR_WIDTH` columns for pictures of `width` columns; sets n, at least 1.

    >>> average(Params(), 80).averaged
    16.0
    """
    return replace(params, averaged=max(SENSOR_WIDTH / width, 1.0) ** 2)


def init(params: Params, pictures: Float[Array, "2 height width"], key: Array) -> State:
    """Return the state before the first pictures, with no picture in transit."""
    late = MAX_LATENCY + 1
    return State(
        previous=pictures,
        gain=jnp.zeros((), pictures.dtype),
        exposure_target=jnp.zeros((), pictures.dtype),
        waiting=jnp.broadcast_to(pictures, (late, *pictures.shape)),
        arrives=jnp.zeros(late, bool),
        key=key,
    )


def step(params: Params, state: State, pictures: Float[Array, "2 height width"]) -> tuple[State, Delivery]:
    """Take a stereo picture, and return what arrives at the detector: that picture, an earlier one, or none.

    Gradient: that of an unrounded picture; none through drops and latency.

    Args:
        params: of the faults.
        state: of the cameras.
        pictures: as the scene gives them, grey levels 0..255.
    """
    key, noise_key, drift_key, drop_key = jax.random.split(state.key, 4)
    light = expose(params, state, pictures)
    exposure_target, gain = adapt(params, state, light, drift_key)
    light = jnp.exp(params.auto_exposure * gain) * light
    light = light + params.noise * _noise(params, light, noise_key)
    levels = jnp.sqrt(jnp.asarray(params.averaged, light.dtype))  # per grey level
    grey = _round(levels * clip(apply_gamma(light, params.gamma), 0.0, 255.0)) / levels
    grey = jnp.where(jnp.asarray(params.quality) > 0, compress(grey, jnp.maximum(params.quality, 1.0)), grey)
    kept = ~jax.random.bernoulli(drop_key, params.dropped)
    waiting = jnp.concatenate([grey[None], state.waiting[:-1]])
    arrives = jnp.concatenate([kept[None], state.arrives[:-1]])
    after = State(
        previous=pictures, gain=gain, exposure_target=exposure_target, waiting=waiting, arrives=arrives, key=key
    )
    return after, Delivery(jnp.take(waiting, params.latency, axis=0), jnp.take(arrives, params.latency))


def expose(params: Params, state: State, pictures: Float[Array, "2 height width"]) -> Float[Array, "2 height width"]:
    """Return the pictures after vignetting and motion blur."""
    height, width = pictures.shape[-2:]
    v, u = jnp.meshgrid(*(_centred(count, pictures.dtype) for count in (height, width)), indexing="ij")
    rho_squared = (u * u + v * v) / (0.5 * width) ** 2
    blurred = pictures - 0.5 * params.blur * (pictures - state.previous)
    return blurred * (1.0 - params.vignetting * clip(rho_squared, 0.0, 1.0))


def adapt(params: Params, state: State, light: Array, key: Array) -> tuple[Array, Array]:
    """Return a and g after a picture: g follows the picture's mean with a lag, and a is a slow Gaussian process."""
    keep = 1.0 - 1.0 / DRIFT_TIME
    jump = params.drift * jnp.sqrt(1.0 - keep * keep) * jax.random.normal(key, (), light.dtype)
    exposure_target = keep * state.exposure_target + jump
    wanted = exposure_target - jnp.log(jnp.maximum(jnp.mean(light), 1.0) / MEAN_GREY)
    return exposure_target, state.gain + EXPOSURE_RATE * (wanted - state.gain)


def _noise(params: Params, light: Array, key: Array) -> Array:
    """Return photon and read noise in grey levels; above twenty electrons Poisson's is nearly normal."""
    variance = (jnp.maximum(light, 0.0) / params.electrons + (params.read / params.electrons) ** 2) / params.averaged
    return jnp.sqrt(variance) * jax.random.normal(key, light.shape, light.dtype)


def apply_gamma(light: Array, gamma: Float[Array, ""] | float) -> Array:
    """Return 255 (L/255)^gamma; black stays black.

    >>> apply_gamma(jnp.asarray(255.0), 0.5).item()
    255.0
    """
    return 255.0 * jnp.maximum(light / 255.0, 1e-6) ** gamma


def _round(grey: Array) -> Array:
    return grey + jax.lax.stop_gradient(jnp.round(grey) - grey)


def compress(pictures: Float[Array, "*eyes height width"], quality: Float[Array, ""] | float) -> Array:
    """Return grey pictures after JPEG at a quality of 1..100: their 8 x 8 cosine transform rounded to its steps.

    The rest of JPEG is lossless. Sides that are not multiples of 8 are padded with their last pixels.

    Gradient: that of the unrounded transform, the identity.
    """
    height, width = pictures.shape[-2:]
    padding = [(0, 0)] * (pictures.ndim - 2) + [(0, -height % BLOCK), (0, -width % BLOCK)]
    padded = jnp.pad(pictures, padding, mode="edge")
    rows, columns = padded.shape[-2] // BLOCK, padded.shape[-1] // BLOCK
    blocks = padded.reshape(*padded.shape[:-2], rows, BLOCK, columns, BLOCK) - 128.0
    basis = jnp.asarray(_cosines(), pictures.dtype)
    transformed = jnp.einsum("ui,...rics,vs->...rucv", basis, blocks, basis)
    steps = _steps(jnp.asarray(quality, pictures.dtype))[:, None, :]
    rounded = steps * _round(transformed / steps)
    restored = jnp.einsum("ui,...rucv,vs->...rics", basis, rounded, basis)
    whole = _round(clip(restored + 128.0, 0.0, 255.0)).reshape(padded.shape)
    return whole[..., :height, :width]


def _steps(quality: Array) -> Float[Array, "8 8"]:
    """Return the steps of the coefficients as libjpeg scales them."""
    scale = jnp.where(quality < 50, 5000.0 / quality, 200.0 - 2.0 * quality)
    return clip(jnp.floor((jnp.asarray(LUMINANCE, quality.dtype) * scale + 50.0) / 100.0), 1.0, 255.0)


def _cosines() -> np.ndarray:
    """Return the orthonormal cosine transform of a block."""
    u, i = np.mgrid[:BLOCK, :BLOCK]
    return np.sqrt(np.where(u == 0, 1, 2) / BLOCK) * np.cos((2 * i + 1) * u * np.pi / (2 * BLOCK))


def _centred(count: int, dtype: jnp.dtype) -> Array:
    return jnp.arange(count, dtype=dtype) + 0.5 - 0.5 * count


def distort(u: np.ndarray, v: np.ndarray, edge: float, distortion: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the undistorted positions of pixels (u, v) from the middle, for `distortion` at the distance `edge`.

    rho grows by distortion (rho/edge)^2, as in the first radial term of every lens model.
    """
    factor = 1.0 + distortion * (u * u + v * v) / edge**2
    return u * factor, v * factor


def warp(
    pictures: Float[Array, "*eyes height width"], distortion: Float[Array, ""] | float
) -> Float[Array, "*eyes height width"]:
    """Return pictures as a lens with `distortion` would show them, by bilinear interpolation, with edges extended.

    Gradient: exact between pixels.
    """
    height, width = pictures.shape[-2:]
    v, u = jnp.meshgrid(*(_centred(count, pictures.dtype) for count in (height, width)), indexing="ij")
    factor = 1.0 + distortion * (u * u + v * v) / (0.5 * width) ** 2
    places = [v * factor + 0.5 * (height - 1), u * factor + 0.5 * (width - 1)]

    def one(picture: Array) -> Array:
        return jax.scipy.ndimage.map_coordinates(picture, places, order=1, mode="nearest")

    flat = pictures.reshape(-1, height, width)
    return jax.vmap(one)(flat).reshape(pictures.shape)


def turn_matrix(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a rotation vector [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
