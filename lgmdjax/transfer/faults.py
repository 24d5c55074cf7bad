"""Faults of cameras, servos and body for the study `transfer`, each drawn with a random key.

| name       | fault                                                                              |
| ---------- | ---------------------------------------------------------------------------------- |
| noise      | photon and read noise of the sensor (`camera_faults`: 20 electrons a grey level)    |
| exposure   | gamma 0.7 to 1.4, and automatic exposure that drifts by 20 %                        |
| vignetting | half the light lost at the edges                                                   |
| blur       | the shutter is open for the whole frame                                            |
| jpeg       | JPEG at quality 50                                                                 |
| drops      | 5 % of the pictures are lost                                                       |
| latency    | 1, 2 or 3 frames                                                                   |
| rate       | 25 pictures a second instead of 30                                                 |
| lens       | off by 3 % at the edge, either way                                                 |
| turn       | each eye turned by 2 degrees about a random axis                                   |
| gains      | of each servo, within 10 %                                                         |
| backlash   | 1 degree                                                                           |
| delay      | 20 ms to the servos                                                                |
| friction   | 0.5 to 1.5                                                                         |
| payload    | -0.3 to 0.3 kg                                                                     |

The study's `together` is all of them at once.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.body import servo_faults
from lgmdjax.sensors import camera_faults
from lgmdjax.transfer.names import FaultName

FRAME_RATE, SLOW_RATE = 30.0, 25.0  # Hz


@struct.dataclass(kw_only=True)
class Faults:
    """All differences from the calibrated robot."""

    camera: camera_faults.Params = struct.field(default_factory=camera_faults.Params)
    lens: camera_faults.LensError = struct.field(default_factory=camera_faults.LensError)
    servos: servo_faults.Params = struct.field(default_factory=servo_faults.Params)
    body: servo_faults.BodyFaults = struct.field(default_factory=servo_faults.BodyFaults)
    rate: float = struct.field(pytree_node=False, default=FRAME_RATE)  # Hz, of the camera


def _noise(faults: Faults, key: Array) -> Faults:
    return replace(faults, camera=replace(faults.camera, noise=1.0))


def _exposure(faults: Faults, key: Array) -> Faults:
    gamma = jnp.exp(_uniform(key, jnp.log(0.7), jnp.log(1.4)))
    return replace(faults, camera=replace(faults.camera, gamma=gamma, auto_exposure=1.0, drift=0.2))


def _vignetting(faults: Faults, key: Array) -> Faults:
    return replace(faults, camera=replace(faults.camera, vignetting=0.5))


def _blur(faults: Faults, key: Array) -> Faults:
    return replace(faults, camera=replace(faults.camera, blur=1.0))


def _jpeg(faults: Faults, key: Array) -> Faults:
    return replace(faults, camera=replace(faults.camera, quality=50.0))


def _drops(faults: Faults, key: Array) -> Faults:
    return replace(faults, camera=replace(faults.camera, dropped=0.05))


def _latency(faults: Faults, key: Array) -> Faults:
    latency = jax.random.randint(key, (), 1, camera_faults.MAX_LATENCY + 1)
    return replace(faults, camera=replace(faults.camera, latency=latency))


def _rate(faults: Faults, key: Array) -> Faults:
    return replace(faults, rate=SLOW_RATE)


def _lens(faults: Faults, key: Array) -> Faults:
    sign = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
    return replace(faults, lens=replace(faults.lens, distortion=0.03 * sign))


def _turn(faults: Faults, key: Array) -> Faults:
    axes = jax.random.normal(key, (2, 3))
    turn = jnp.deg2rad(2.0) * axes / jnp.linalg.norm(axes, axis=1, keepdims=True)
    return replace(faults, lens=replace(faults.lens, turn=turn))


def _gains(faults: Faults, key: Array) -> Faults:
    return replace(faults, body=replace(faults.body, gain=_uniform(key, 0.9, 1.1, (6, 3))))


def _backlash(faults: Faults, key: Array) -> Faults:
    return replace(faults, servos=replace(faults.servos, backlash=jnp.deg2rad(1.0)))


def _delay(faults: Faults, key: Array) -> Faults:
    return replace(faults, servos=replace(faults.servos, delay=0.02))


def _friction(faults: Faults, key: Array) -> Faults:
    return replace(faults, body=replace(faults.body, friction=_uniform(key, 0.5, 1.5)))


def _payload(faults: Faults, key: Array) -> Faults:
    return replace(faults, body=replace(faults.body, payload=_uniform(key, -0.3, 0.3)))


FAULTS: Mapping[FaultName, Callable[[Faults, Array], Faults]] = {
    "noise": _noise,
    "exposure": _exposure,
    "vignetting": _vignetting,
    "blur": _blur,
    "jpeg": _jpeg,
    "drops": _drops,
    "latency": _latency,
    "rate": _rate,
    "lens": _lens,
    "turn": _turn,
    "gains": _gains,
    "backlash": _backlash,
    "delay": _delay,
    "friction": _friction,
    "payload": _payload,
}


def draw(key: Array, *names: FaultName) -> Faults:
    """Return the named faults of one robot, drawn with a key; the draw of a fault does not depend on the others.

    >>> draw(jax.random.key(0), "jpeg").camera.quality
    50.0
    """
    faults = Faults()
    for index, (name, add) in enumerate(FAULTS.items()):
        if name in names:
            faults = add(faults, jax.random.fold_in(key, index))
    return faults


def _uniform(
    key: Array, low: Float[Array, ""] | float, high: Float[Array, ""] | float, shape: tuple[int, ...] = ()
) -> Array:
    return jax.random.uniform(key, shape, jnp.float32, low, high)
