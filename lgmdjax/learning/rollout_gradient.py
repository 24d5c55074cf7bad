"""The imitation loss of a rollout, and its gradient through time with respect to all parameters of the controller.

Robots walk in their rooms under the navigator's control, and the teacher's rule labels every frame. The loss of a
window of frames is

    L = mean over its frames and both sides of |v - v*|^2.

Reverse mode differentiates it with respect to everything between the cameras and the servos (`controller.Params`).
`grad_path` chooses what the derivative passes through (`closed_loop.step`):

| grad_path  | the derivative passes through                                   | held constant   |
| ---------- | --------------------------------------------------------------- | --------------- |
| controller | the navigator, its recurrent state and its own past commands    | u, v*, the body |
| body       | also CPG, shaping network, servos, body, laser, teacher's rule  | u               |
| everything | also cameras and LGMD: the full derivative of the loss          | nothing         |

Recorded walks only show which command suits a given u. The loss of a rollout also contains what a command, a step or a
threshold changes in all frames that follow.

Between windows the states are passed on without their derivative.

Parameters differ by orders of magnitude, and their derivatives by more. The gradient is therefore expressed in units
of `param_scales` (`lgmdjax.learning.finetuning.param_scales`).

| symbol | name            | unit                      | equation |
| ------ | --------------- | ------------------------- | -------- |
| v      | record.velocity | nominal                   | 17       |
| v*     | record.label    | nominal                   | 22       |
| L      | loss            | nominal^2                 | sec. 5.1 |
| dL/dp  | grad            | nominal^2 per param_scale | -        |

Gradient: a reset cuts it, so that no frame depends on what came before the reset. A robot that fell adds nothing.
Hard thresholds have none (`lgmd.Params.smooth`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree

from lgmdjax.control import controller, policies
from lgmdjax.detectors import lgmd
from lgmdjax.runtime.export_cache import cached_jit
from lgmdjax.runtime.mjx import mjx
from lgmdjax.simulation import closed_loop, rollout, sharding
from lgmdjax.simulation.closed_loop import GradPath, Params, Record, Room, State

SMOOTH_WIDTH = 0.3  # of a smooth threshold, relative to the threshold


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Length of a window, and how its derivative is taken."""

    frames: int = 30
    grad_path: GradPath = "everything"
    remat: bool = True  # recompute each frame in the backward pass, to save memory; physics steps always are
    clip: float = math.inf  # largest norm of one robot's gradient, relative to the median of all robots
    render: bool = True  # the camera images; without them the LGMDs see black


@struct.dataclass(kw_only=True)
class Gradient:
    """Loss and gradient of a window, over a batch of robots. Robots with `nonfinite` are left out of the means."""

    loss: Float[Array, ""]  # mean
    grad: controller.Params  # mean of the clipped gradients, in units of param_scales
    norms: Float[Array, " robots"]  # of each robot's gradient, before clipping
    standard_error: Float[Array, ""]  # of the mean gradient; the norm expected by chance if the true gradient is zero
    nonfinite: Bool[Array, " robots"]  # robots whose loss or gradient is not finite


def losses(
    controller_params: controller.Params,
    params: Params,
    model: mjx.Model,
    rooms: Room,
    states: State,
    *,
    settings: Settings,
) -> tuple[Float[Array, " robots"], tuple[State, Record]]:
    """Roll out a batch of robots for a window; return each robot's loss, and (states after the window, record).

    Args:
        controller_params: one set per robot, to differentiate with respect to; they replace those in `params`, and
            their policy is a navigator.
        params: the robot.
        model: the body in MJX.
        rooms: one per robot.
        states: from `closed_loop.init`, or as the last window left them.
        settings: of the window.
    """

    def frame(inputs: tuple[controller.Params, Room], state: State, _: None) -> tuple[State, Record]:
        own, room = replace(params, controller=inputs[0]), inputs[1]
        return closed_loop.step(
            own, model, room, state, policies.LEARNED, render=settings.render, grad_path=settings.grad_path
        )

    # The recomputed frame is inside a loop, where XLA cannot merge it with the first one.
    step = jax.checkpoint(frame, prevent_cse=False) if settings.remat else frame
    states, record = rollout.scan_batch(step, (controller_params, rooms), states, length=settings.frames)
    error = jnp.mean((record.velocity - record.label) ** 2, axis=-1)
    return jnp.mean(jnp.where(record.ok, error, 0.0), axis=-1), (states, record)


def loss(
    controller_params: controller.Params,
    params: Params,
    model: mjx.Model,
    room: Room,
    state: State,
    *,
    settings: Settings,
) -> tuple[Float[Array, ""], tuple[State, Record]]:
    """Roll out one robot for a window; return its loss and the rest as `losses` does for a batch."""
    add_axis = partial(jax.tree.map, lambda leaf: jnp.asarray(leaf)[None])
    values, aux = losses(add_axis(controller_params), params, model, add_axis(room), add_axis(state), settings=settings)
    return values[0], jax.tree.map(lambda leaf: leaf[0], aux)


@partial(cached_jit, donate_argnames=("states",))
def gradient(
    params: Params, model: mjx.Model, rooms: Room, states: State, param_scales: controller.Params, *, settings: Settings
) -> tuple[Gradient, State, Record]:
    """Roll out a batch of robots for a window, and take the gradient of their mean loss, on all devices.

    Args:
        params: the robot; its policy is a navigator.
        model: the body in MJX.
        rooms: one per robot.
        states: from `rollout.reset_batch`, or as the last window left them; their buffers are donated.
        param_scales: units of the gradient, one per parameter; zero gives a zero gradient.
        settings: of the window.

    Returns:
        The gradient, the states after the window, and the record.
    """

    def work(rooms: Room, states: State) -> PyTree:
        copies = broadcast_params(params.controller, rooms.starts.shape[0])
        return per_robot_grad(lambda own: losses(own, params, model, rooms, states, settings=settings), copies)

    (values, (states, record)), grads = sharding.shard_robots(work, rooms, states)
    return _average(values, jax.tree.map(jnp.multiply, grads, param_scales), settings.clip), states, record


def per_robot_grad(
    losses: Callable[[controller.Params], tuple[Float[Array, " robots"], PyTree]], controller_params: controller.Params
) -> tuple[tuple[Float[Array, " robots"], PyTree], controller.Params]:
    """Return (losses, auxiliary output), and the gradient of each robot's loss with respect to its own parameters.

    Robots do not interact, so one backward pass of the sum of all losses gives all gradients.
    """

    def total(controller_params: controller.Params) -> tuple[Float[Array, ""], PyTree]:
        values, aux = losses(controller_params)
        return jnp.sum(values), (values, aux)

    grads, found = jax.grad(total, has_aux=True)(controller_params)
    return found, grads


def broadcast_params(controller_params: controller.Params, robots: int) -> controller.Params:
    """Return a copy of the parameters for each robot of a batch."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (robots, *jnp.shape(leaf))), controller_params)


def learned_only(params: Params) -> Params:
    """Return a robot with the navigator as its only policy, from one that switches between all five."""
    learned = params.controller.policy.policies[policies.POLICIES.index(policies.LEARNED)]
    return replace(params, controller=replace(params.controller, policy=learned))


def smooth_thresholds(params: Params) -> Params:
    """Return a robot whose LGMDs have differentiable thresholds of relative width `SMOOTH_WIDTH`.

    Raises InputError for a robot with another detector.
    """
    own = controller.require_lgmd(params.controller, "smooth thresholds")
    smoothed = lgmd.with_smooth_thresholds(own, SMOOTH_WIDTH)
    return replace(params, controller=replace(params.controller, detector=smoothed))


def _average(values: Float[Array, " robots"], grads: controller.Params, clip: float) -> Gradient:
    """Average losses and clipped gradients over the robots for which both are finite."""
    norms: Array = jax.vmap(optax.tree.norm)(grads)
    nonfinite = ~(jnp.isfinite(values) & jnp.isfinite(norms))
    count = jnp.maximum(jnp.sum(~nonfinite), 1)
    weights = jnp.where(nonfinite, 0.0, _clip_factors(norms, nonfinite, clip)) / count

    def mean(leaf: Float[Array, "robots *shape"]) -> Float[Array, "*shape"]:
        finite = jnp.where(nonfinite.reshape(-1, *[1] * (leaf.ndim - 1)), 0.0, leaf)
        return jnp.tensordot(weights.astype(leaf.dtype), finite, axes=1)

    grad = jax.tree.map(mean, grads)
    # The mean's variance is the mean of the squared norms, minus the mean's squared norm, over n - 1.
    squares = count * jnp.sum((weights * jnp.where(nonfinite, 0.0, norms)) ** 2)
    excess = jnp.maximum(squares - optax.tree.norm(grad, squared=True), 0.0)
    standard_error = jnp.sqrt(excess / jnp.maximum(count - 1, 1))
    return Gradient(
        loss=jnp.sum(values, where=~nonfinite) / count,
        grad=grad,
        norms=norms,
        standard_error=standard_error,
        nonfinite=nonfinite,
    )


def _clip_factors(
    norms: Float[Array, " robots"], nonfinite: Bool[Array, " robots"], clip: float
) -> Float[Array, " robots"]:
    """Return factors that shorten gradients to `clip` times the median norm of the robots that have not fallen."""
    if math.isinf(clip):
        return jnp.ones_like(norms)
    median = jnp.nan_to_num(jnp.nanmedian(jnp.where(nonfinite | (norms == 0), jnp.nan, norms)))
    return jnp.minimum(1.0, clip * median / jnp.maximum(norms, 1e-30))
