"""The eta function: how a locust's LGMD fires, as a function of an object's true size and expansion.

An ideal observer: it is given the geometry that other detectors must see, so it is an upper bound for them.

| symbol | name                | unit   | equation                                               |
| ------ | ------------------- | ------ | ------------------------------------------------------ |
| theta  | geometry.size       | rad    | full angle of the object                               |
| theta' | geometry.rate       | rad/s  | its derivative                                         |
| alpha  | size_weight         | 1/rad  | 1 / tan(theta_t / 2) for the angular threshold theta_t |
| delta  | delay               | s      | -                                                      |
| eta(t) | response.excitation | rad/s  | max(theta'(t - delta), 0) exp(-alpha theta(t - delta)) |
| u      | response.u          | 0.5..1 | 1 / (1 + exp(-gain eta))                               |

For an object of half size l that approaches with the speed v, eta peaks alpha l/|v| - delta before contact: a fixed
time after the object has reached theta_t, for all l/|v|.

Source: Gabbiani, Krapp & Laurent, "Computation of object approach by a wide-field, motion-sensitive neuron", J.
Neurosci. 19, 1999; Hatsopoulos, Gabbiani & Laurent 1995 for the function. theta_t = 24 degrees, thus alpha = 4.7, and
delta = 27 ms are the means over neurons that are usually cited; the firing rate is C eta, and C differs from animal to
animal. gain = 10 s is chosen here. Delays between two frames are interpolated, and `check` rejects those of more than
HISTORY frames.

Gradient: exact almost everywhere; zero for an object that recedes.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import Scalar, rectify
from lgmdjax.detectors.protocol import Geometry
from lgmdjax.errors import InputError

HISTORY = 8  # frames


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the observer."""

    size_weight: Scalar = 4.7  # alpha, 1/rad
    delay: Scalar = 0.027  # delta, s
    gain: Scalar = 10.0  # s
    frame_time: float = struct.field(pytree_node=False, default=1 / 30)  # s


@struct.dataclass(kw_only=True)
class State:
    """The last values of eta, undelayed, the newest first."""

    history: Float[Array, "frames"]


@struct.dataclass(kw_only=True)
class Response:
    """Response of the observer to one frame."""

    u: Float[Array, ""]
    excitation: Float[Array, ""]  # eta [rad/s]


def init(params: Params, geometry: Geometry) -> State:
    """Return the state before anything moved."""
    return State(history=jnp.zeros(HISTORY + 1, jnp.asarray(geometry.size).dtype))


def step(params: Params, state: State, geometry: Geometry) -> tuple[State, Response]:
    """Process the geometry of the next frame.

    >>> geometry = Geometry(size=jnp.asarray(0.2), rate=jnp.asarray(1.0))
    >>> _, response = step(Params(delay=0.0), init(Params(), geometry), geometry)
    >>> round(float(response.excitation), 4)
    0.3906
    """
    now = rectify(jnp.asarray(geometry.rate)) * jnp.exp(-params.size_weight * geometry.size)
    history = jnp.concatenate([now[None], state.history[:-1]])
    ages = jnp.arange(HISTORY + 1, dtype=history.dtype)
    eta = jnp.dot(history, rectify(1.0 - jnp.abs(ages - params.delay / params.frame_time)))
    return State(history=history), Response(u=jax.nn.sigmoid(params.gain * eta), excitation=eta)


def check(params: Params) -> None:
    """Raise `InputError` for a delay that is negative or longer than the history."""
    longest = HISTORY * params.frame_time
    if not 0 <= float(params.delay) <= longest:
        raise InputError(f"eta delay: expected 0..{longest:.3g} s, got {params.delay}; the published one is 0.027")
