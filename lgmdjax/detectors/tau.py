"""Tau: the time to contact, from an object's true size and expansion.

An ideal observer: it is given the geometry that other detectors must see, so it is an upper bound for them.

| symbol | name                | unit   | equation                                                     |
| ------ | ------------------- | ------ | ------------------------------------------------------------ |
| theta  | geometry.size       | rad    | full angle of the object                                     |
| theta' | geometry.rate       | rad/s  | its derivative                                               |
| 1/tau  | response.excitation | 1/s    | max(theta', 0) / sin(theta); 0 for theta = 0 and theta >= pi |
| u      | response.u          | 0.5..1 | 1 / (1 + exp(-gain / tau))                                   |

Source: Lee, "A theory of visual control of braking based on information about time-to-collision", Perception 5, 1976,
whose tau = theta / theta' is the limit for small angles. sin(theta) / theta' is the time to contact exactly, at every
angle, for a flat object that approaches at constant speed face on: with tan(theta / 2) = l / (v t),
theta' = 2 l v / ((v t)^2 + l^2). gain = 0.5 s is chosen here.

Gradient: exact almost everywhere; zero for an object that recedes.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import Scalar, rectify
from lgmdjax.detectors.protocol import Geometry


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the observer."""

    gain: Scalar = 0.5  # s


@struct.dataclass(kw_only=True)
class State:
    """Nothing is carried from frame to frame."""


@struct.dataclass(kw_only=True)
class Response:
    """Response of the observer to one frame."""

    u: Float[Array, ""]
    excitation: Float[Array, ""]  # 1 / tau [1/s]


def init(params: Params, geometry: Geometry) -> State:
    """Return the empty state."""
    return State()


def step(params: Params, state: State, geometry: Geometry) -> tuple[State, Response]:
    """Process the geometry of the next frame.

    >>> geometry = Geometry(size=jnp.asarray(0.5 * jnp.pi), rate=jnp.asarray(4.0))  # contact in 0.25 s
    >>> float(step(Params(), State(), geometry)[1].excitation)
    4.0
    """
    sine = jnp.sin(jnp.asarray(geometry.size))
    seen = sine > 0
    excitation = jnp.where(seen, rectify(jnp.asarray(geometry.rate)) / jnp.where(seen, sine, 1.0), 0.0)
    return state, Response(u=jax.nn.sigmoid(params.gain * excitation), excitation=excitation)
