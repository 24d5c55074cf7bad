"""Faults of servos and body: gains, backlash and delay of the servos; friction of the ground, and payload.

`step` applies backlash and delay to the set points, as a pure function of (parameters, state, set points), once per
physics step of a robot. `apply_to_model` applies gains, friction and payload to a copy of the robot's model.

| symbol | name                                         | unit | where                                           |
| ------ | -------------------------------------------- | ---- | ----------------------------------------------- |
| q*     | set points                                   | rad  | (6, 3)                                          |
| tau    | delay                                        | s    | q*(t - tau), linear between two physics steps   |
| b      | backlash, full width of the play             | rad  | y = clip(y, q* - b/2, q* + b/2)                 |
| k_p    | position gain of a servo                     | N m/rad | multiplied by `gain`                         |

The play operator of backlash keeps its output until the set point has crossed the play.
"""

import copy

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.minmax import clip

MAX_STEPS = 12  # largest delay of a set point, in physics steps


@struct.dataclass(kw_only=True)
class Params:
    """Faults of the servos; by default there are none."""

    backlash: Float[Array, ""] | float = 0.0  # b
    delay: Float[Array, ""] | float = 0.0  # tau, less than `MAX_STEPS` physics steps


@struct.dataclass(kw_only=True)
class BodyFaults:
    """How a body differs from its model; by default it does not."""

    gain: Float[Array, "6 3"] | float = 1.0  # factor of k_p
    friction: Float[Array, ""] | float = 1.0  # factor of the friction of feet and floor
    payload: Float[Array, ""] | float = 0.0  # kg, of the trunk; may be negative


@struct.dataclass(kw_only=True)
class State:
    """Delayed set points, the latest first, and the set points after backlash."""

    waiting: Float[Array, "steps 6 3"]
    output: Float[Array, "6 3"]


def init(params: Params, targets: Float[Array, "6 3"]) -> State:
    """Return the state of servos at rest at their set points."""
    return State(waiting=jnp.broadcast_to(targets, (MAX_STEPS + 1, 6, 3)), output=targets)


def step(
    params: Params, state: State, targets: Float[Array, "6 3"], interval: float
) -> tuple[State, Float[Array, "6 3"]]:
    """Return the set points that arrive at the joints in a physics step of `interval` [s].

    Gradient: one where the set point pushes, zero within the play.
    """
    waiting = jnp.concatenate([targets[None], state.waiting[:-1]])
    late = clip(jnp.asarray(params.delay / interval, targets.dtype), 0.0, float(MAX_STEPS - 1))
    whole = jnp.floor(late).astype(jnp.int32)
    newer, older = jnp.take(waiting, whole, axis=0), jnp.take(waiting, whole + 1, axis=0)
    arrived = newer + (late - whole.astype(late.dtype)) * (older - newer)
    half = 0.5 * jnp.asarray(params.backlash, targets.dtype)
    output = clip(state.output, arrived - half, arrived + half)
    return State(waiting=waiting, output=output), output


def apply_to_model(model: mujoco.MjModel, body: BodyFaults) -> mujoco.MjModel:
    """Return a copy of a robot's model whose servos, friction and mass differ; `hexapod.build` converts it to MJX.

    The payload is in the middle of the trunk, whose inertia grows in proportion.
    """
    model = copy.deepcopy(model)
    gain = np.broadcast_to(np.asarray(body.gain, float), (6, 3)).reshape(-1)
    model.actuator_gainprm[:, 0] *= gain
    model.actuator_biasprm[:, 1] *= gain
    model.geom_friction[:, 0] *= float(body.friction)
    model.pair_friction[:, :2] *= float(body.friction)
    trunk = model.body("trunk").id
    factor = 1.0 + float(body.payload) / model.body_mass[trunk]
    model.body_mass[trunk] *= factor
    model.body_inertia[trunk] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
