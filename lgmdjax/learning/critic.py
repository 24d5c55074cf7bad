"""The critic of `lgmdjax.learning.shac`: what a robot can expect from where it is, and the returns that teach it.

| symbol | name     | unit   | what                                                                     |
| ------ | -------- | ------ | ------------------------------------------------------------------------ |
| x_t    | features | 1/m, 1 | nearness of the nearest and of what is in the way, either side; velocity |
| V(x_t) | value    | cells  | discounted reward to come; two layers of tanh units                      |
| R_t    | returns  | cells  | r_t + gamma ((1 - lambda) V'(x_{t+1}) + lambda R_{t+1})                  |
"""

import jax
import jax.numpy as jnp
from flax import nnx, struct
from jaxtyping import Array, Bool, Float, PyTree

from lgmdjax.environments import functional
from lgmdjax.minmax import maximum

FEATURES = 6
MIN_DISTANCE = 0.2  # m; what is nearer counts as this near
Weights = dict[str, PyTree]


@struct.dataclass(kw_only=True)
class Sample:
    """What the critic learns from a frame, or from many."""

    features: Float[Array, "*axes features"]  # before the frame
    following: Float[Array, "*axes features"]  # after it
    reward: Float[Array, "*axes"]
    terminated: Bool[Array, "*axes"]
    truncated: Bool[Array, "*axes"]
    begins: Bool[Array, "*axes"]  # the frame begins an episode, and belongs to none


class _Network(nnx.Module):
    def __init__(self, units: int, rngs: nnx.Rngs):
        self.first, self.second = nnx.Linear(FEATURES, units, rngs=rngs), nnx.Linear(units, units, rngs=rngs)
        self.head = nnx.Linear(units, 1, rngs=rngs)

    def __call__(self, features: Array) -> Array:
        return self.head(jnp.tanh(self.second(jnp.tanh(self.first(features)))))[..., 0]


def create(key: Array, units: int) -> Weights:
    """Return random weights of a network with two layers of `units`."""
    weights = nnx.to_pure_dict(nnx.split(_Network(units, nnx.Rngs(key)))[1])
    return jax.tree.map(lambda weight: jnp.asarray(weight, float), weights)


def value(weights: Weights, features: Float[Array, "*axes features"]) -> Float[Array, "*axes"]:
    """Return V, the discounted reward to come [cells]."""
    units = weights["head"]["kernel"].shape[0]
    graph, template = nnx.split(nnx.eval_shape(lambda: _Network(units, nnx.Rngs(0))))
    state: nnx.State = template
    nnx.replace_by_pure_dict(state, weights)
    return nnx.merge(graph, state)(features)


def features(state: functional.State, velocity: Float[Array, "2"]) -> Float[Array, " features"]:
    """Return what the critic sees (x), of a robot that commanded this velocity last."""
    nearest, corridor = (1 / maximum(d, MIN_DISTANCE) for d in (state.sensed.distances, state.sensed.corridor))
    return jnp.concatenate([nearest, corridor, velocity])


def returns(
    samples: Sample, following: Float[Array, " frames"], *, discount: float, trace: float
) -> Float[Array, " frames"]:
    """Return R of each of a robot's frames [cells].

    Args:
        samples: of a window.
        following: V' after each frame.
        discount: gamma.
        trace: lambda.
    """
    is_last = jnp.arange(len(following)) == len(following) - 1
    stops = is_last | samples.truncated

    def frame(after: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
        reward, beyond, terminated, stops = now
        mixed = (1 - trace) * beyond + trace * after
        found = reward + discount * jnp.where(terminated, 0.0, jnp.where(stops, beyond, mixed))
        return found, found

    inputs = samples.reward, following, samples.terminated, stops
    return jax.lax.scan(frame, jnp.zeros((), following.dtype), inputs, reverse=True)[1]
