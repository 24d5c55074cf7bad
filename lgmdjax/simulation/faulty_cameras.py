"""Cameras with faults in the closed loop: what arrives at the detectors, and when.

The faults are those of `lgmdjax.sensors.camera_faults`, for the part of each picture that a detector sees; each robot
of a batch has its own (`closed_loop.Room.faults`). A picture that is lost or late leaves detectors and responses as
they were. Until the first one after a start or reset arrives, the responses are those at rest.

Vignetting depends on the whole picture, which the closed loop does not render: `check` refuses it.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from lgmdjax.errors import InputError
from lgmdjax.sensors import camera_faults

Pictures = Float[Array, "2 height columns"]


@struct.dataclass(kw_only=True)
class State:
    """State of both cameras."""

    cameras: camera_faults.State  # its key as numbers: a program on disk cannot return keys from several devices
    arrived: Bool[Array, ""]  # a picture arrived in this frame
    is_waiting: Bool[Array, ""]  # none did between the start or reset and this frame


def init(faults: camera_faults.Params, pictures: Pictures, key: Array) -> State:
    """Return the state at a start, where `pictures` are the first ones."""
    cameras = _without_key(camera_faults.init(faults, pictures, key))
    return State(cameras=cameras, arrived=jnp.asarray(False), is_waiting=jnp.asarray(True))


def step(
    faults: camera_faults.Params, state: State, pictures: Pictures, is_first: Bool[Array, ""]
) -> tuple[State, Pictures]:
    """Take both pictures; return the state, and the pictures that arrive if any do.

    If they are the first ones after a reset, the cameras start again; their random numbers go on.
    """
    key = jax.random.wrap_key_data(state.cameras.key)
    started = init(faults, pictures, key)
    state = jax.tree.map(lambda new, old: jnp.where(is_first, new, old), started, state)
    cameras, delivery = camera_faults.step(faults, replace(state.cameras, key=key), pictures)
    is_waiting = state.is_waiting & ~state.arrived
    return State(cameras=_without_key(cameras), arrived=delivery.arrived, is_waiting=is_waiting), delivery.pictures


def _without_key(cameras: camera_faults.State) -> camera_faults.State:
    return replace(cameras, key=jax.random.key_data(cameras.key))


def check(faults: camera_faults.Params) -> None:
    """Raise `InputError` for vignetting, and for a latency that is too long."""
    if np.any(np.asarray(faults.vignetting) != 0):
        raise InputError("camera faults: expected no vignetting in the closed loop, got some; see lgmdjax.transfer")
    if np.any(np.asarray(faults.latency) > camera_faults.MAX_LATENCY):
        raise InputError(
            f"camera faults latency: expected up to {camera_faults.MAX_LATENCY} frames, got {np.max(faults.latency)}"
        )
