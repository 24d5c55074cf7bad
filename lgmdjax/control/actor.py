"""A feed-forward actor, as reinforcement learning trains it: the last u of both LGMDs to a velocity that is held.

Every `hold` frames the actor reads the last `depth` pairs of u, one from each command, and chooses an action a in
-1..1, which spans the range of the gait:

    x = ((u_{k-depth+1}, ..., u_k) - 0.5) / U_SCALE
    a = tanh f(x),  v = v_min + (v_max - v_min) (a + 1) / 2

| symbol       | name      | unit              |
| ------------ | --------- | ----------------- |
| u            | u         | 1, 0.5..1         |
| x            | inputs    | 1                 |
| f            | layers    | -                 |
| a            | action    | 1, -1..1          |
| v            | velocity  | nominal, 0.05 m/s |

With the default values 8 pairs span a gait cycle of 0.8 s, the period of the sway that u shows. In the first frame all
pairs are the first u.

`POLICY` lets the actor drive the closed loop (`lgmdjax.control.policies`).
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from lgmdjax.control import braitenberg, perceptron
from lgmdjax.control.perceptron import Layers
from lgmdjax.control.policies import GAIT_RANGE, Observation, Policy
from lgmdjax.detectors.cells import U_AT_REST
from lgmdjax.html import NotebookTable

DEPTH = 8  # pairs of u
HOLD = 3  # frames
U_SCALE = 0.1  # as of the navigator's inputs


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Weights of the network, and how its commands are timed."""

    layers: Layers
    depth: int = struct.field(pytree_node=False, default=DEPTH)  # pairs of u
    hold: int = struct.field(pytree_node=False, default=HOLD)  # frames of a command


@struct.dataclass(kw_only=True)
class State:
    """The last u, oldest first, the present command, and the frames since the start."""

    history: Float[Array, "depth 2"]
    velocity: Float[Array, "2"]
    frame: Int[Array, ""]


def init(params: Params) -> State:
    """Return the state before the first frame."""
    return State(
        history=jnp.full((params.depth, 2), U_AT_REST, float),
        velocity=jnp.zeros(2),
        frame=jnp.asarray(0, jnp.int32),
    )


def step(params: Params, state: State, u: Float[Array, "2"]) -> tuple[State, Float[Array, "2"]]:
    """Return the next state, and the velocity for the u of one frame, limited (`braitenberg.limit`)."""
    is_due = state.frame % params.hold == 0
    begun = jnp.where(state.frame == 0, fill(u, params.depth), push(state.history, u))
    history = jnp.where(is_due, begun, state.history)
    action = jnp.tanh(perceptron.apply(params.layers, inputs(history)))
    chosen = braitenberg.limit(GAIT_RANGE, to_velocity(action))
    velocity = jnp.where(is_due, chosen, state.velocity)
    return State(history=history, velocity=velocity, frame=state.frame + 1), velocity


def fill(u: Float[Array, "2"], depth: int) -> Float[Array, "depth 2"]:
    """Return the history at a first u."""
    return jnp.broadcast_to(u, (depth, 2))


def push(history: Float[Array, "depth 2"], u: Float[Array, "2"]) -> Float[Array, "depth 2"]:
    """Return the history with a new u, without the oldest one."""
    return jnp.concatenate([history[1:], u[None]])


def inputs(history: Float[Array, "depth 2"]) -> Float[Array, " inputs"]:
    """Return the inputs of the network."""
    return ((history - U_AT_REST) / U_SCALE).reshape(-1)


def to_velocity(action: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Return the velocity of an action; -1 and 1 are the limits of the gait.

    >>> to_velocity(jnp.asarray([-1.0, 1.0])).tolist()
    [-1.0, 2.0]
    """
    low, high = GAIT_RANGE.min_velocity, GAIT_RANGE.max_velocity
    return low + (high - low) * (action + 1) / 2


def _step_policy(params: Params, state: State, observation: Observation) -> tuple[State, Float[Array, "2"]]:
    return step(params, state, observation.u)


POLICY = Policy("actor", lambda params, key: init(params), _step_policy, uses_camera=True)
