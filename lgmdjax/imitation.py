"""The imitation loss of robots that walk: how far their commands are from the rule's, differentiated through time.

Robots walk in their rooms, the navigator at the wheel, and the rule labels every frame. The loss of a window of
frames is

    L = mean over its frames and both sides of |v - v*|^2,

of which reverse mode takes the derivative by everything between the eyes and the servos (`controller.Params`). What it
passes on the way is chosen by `through` (`simulation.step`):

| through    | the derivative passes                                        | held as they were in the walk |
| ---------- | ------------------------------------------------------------ | ----------------------------- |
| controller | navigator and what it remembers, its own commands among that  | u, v*, the body               |
| nerves     | and CPG, shaping, servos, body, laser, rule                  | u                             |
| everything | and cameras and LGMD: it is the derivative of the loss        | nothing                       |

Unlike recorded walks, which can only tell what to say to a u, the loss of a walk knows what a command, a stride or a
threshold does to all that follows.

A window ends where its states are handed on: the next begins in them, without their derivative.

| symbol | name            | unit      | equation |
| ------ | --------------- | --------- | -------- |
| v      | record.velocity | nominal   | 17       |
| v*     | record.label    | nominal   | 22       |
| L      | loss            | nominal^2 | sec. 5.1 |

Gradient: a robot that is set back starts anew, and what it did before does not count for what comes after. One that
fell counts no longer. Thresholds that are steps have none (`lgmd.Params.smooth`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from lgmdjax import controller, drivers, rollout, simulation
from lgmdjax.simulation import Params, Record, Room, State, Through


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A window, and how its derivative is taken."""

    frames: int = 30
    through: Through = "everything"
    remat: bool = True  # walk each frame again on the way back: its inside need not be kept
    clip: float = math.inf  # largest norm of one robot's gradient
    draw: bool = True  # what the eyes see; else they stay shut


@struct.dataclass(kw_only=True)
class Gradient:
    """What a crowd's window gives."""

    loss: Float[Array, ""]  # mean over the robots that count
    slope: controller.Params  # mean of their gradients, each cut to the largest norm
    norms: Float[Array, " robots"]  # before that
    lost: Bool[Array, " robots"]  # whose loss or gradient is not finite: they do not count


def loss(
    nerves: controller.Params, params: Params, model: mjx.Model, room: Room, state: State, settings: Settings
) -> tuple[Float[Array, ""], tuple[State, Record]]:
    """Walk one robot for a window; give its loss, the state to go on from, and what the window left behind.

    Args:
        nerves: what the derivative is asked of, in place of those in `params`; its driver is a navigator.
        state: as `simulation.init` or the last window left it.
    """
    own = replace(params, controller=nerves)

    def frame(state: State, _: None) -> tuple[State, Record]:
        return simulation.step(own, model, room, state, drivers.LEARNED, settings.draw, settings.through)

    # What is walked again is in a loop, where XLA cannot take it for the same as the first time.
    walked = jax.checkpoint(frame, prevent_cse=False) if settings.remat else frame
    state, record = jax.lax.scan(walked, state, length=settings.frames)
    error = jnp.mean((record.velocity - record.label) ** 2, axis=-1)
    return jnp.mean(jnp.where(record.ok, error, 0.0)), (state, record)


@partial(jax.jit, static_argnames="settings", donate_argnames="states")
def gradient(
    params: Params, model: mjx.Model, rooms: Room, states: State, *, settings: Settings
) -> tuple[Gradient, State, Record]:
    """Walk a crowd for a window, each robot in its own room, and take the gradient of its mean loss.

    The crowd is dealt out to all devices. A robot whose loss or gradient is not finite is left out of the means,
    and flagged.
    """
    slopes = jax.value_and_grad(loss, has_aux=True)

    def share(rooms: Room, states: State) -> tuple[Any, Any]:
        return jax.vmap(lambda room, state: slopes(params.controller, params, model, room, state, settings))(
            rooms, states
        )

    (losses, (states, record)), each = rollout.deal(share, rooms, states)
    norms: Array = jax.vmap(optax.tree.norm)(each)
    lost = ~(jnp.isfinite(losses) & jnp.isfinite(norms))
    count = jnp.maximum(jnp.sum(~lost), 1)
    scale = jnp.where(lost, 0.0, jnp.minimum(1.0, settings.clip / jnp.maximum(norms, 1e-30))) / count

    def mean(leaf: Float[Array, "robots *shape"]) -> Float[Array, "*shape"]:
        sound = jnp.where(lost.reshape(-1, *[1] * (leaf.ndim - 1)), 0.0, leaf)
        return jnp.tensordot(scale.astype(leaf.dtype), sound, axes=1)

    found = Gradient(loss=jnp.sum(losses, where=~lost) / count, slope=jax.tree.map(mean, each), norms=norms, lost=lost)
    return found, states, record


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """How to follow the gradient."""

    learning_rate: float = 1e-3  # of parameters as shares of their sizes; falls to nothing like half a cosine
    windows: int = 30  # in a room, before robots go on to others
    rooms: int = 4  # of each robot, one after the other
    parts: tuple[str, ...] = ("driver",)  # of `controller.Params` that are tuned


def alone(params: Params) -> Params:
    """Leave the navigator alone at the wheel of a robot that all five drivers are aboard of."""
    driver = params.controller.driver.drivers[drivers.ALL.index(drivers.LEARNED)]
    return replace(params, controller=replace(params.controller, driver=driver))


def tune(
    params: Params,
    model: mjx.Model,
    rooms: Callable[[int], Room],
    settings: Settings,
    tuning: Tuning,
    tell: Callable[[Mapping[str, float]], None] = lambda row: None,
) -> tuple[Params, list[dict[str, float]]]:
    """Follow the gradient of the imitation loss (Adam) while the robots walk, window after window.

    Args:
        params: a robot with the navigator alone at the wheel. rooms: of the crowd, by number.
        tell: told of every window.

    Returns:
        The robot, and a row a window: loss, the middle norm of a robot's gradient and the largest one, robots lost.
    """
    sizes = _sizes(params.controller, tuning.parts)
    steps = tuning.windows * tuning.rooms
    # Slopes differ by many orders of magnitude: what keeps Adam from dividing by zero must be small beside all of them.
    optimiser = optax.adam(optax.cosine_decay_schedule(tuning.learning_rate, steps), eps=1e-15)

    @jax.jit
    def update(nerves: controller.Params, state: Any, slope: controller.Params) -> tuple[controller.Params, Any]:
        scaled = jax.tree.map(jnp.multiply, slope, sizes)
        changes, state = optimiser.update(scaled, state)
        return jax.tree.map(lambda leaf, change, size: leaf + change * size, nerves, changes, sizes), state

    nerves: Any = params.controller
    state, rows = optimiser.init(nerves), []
    for number in range(tuning.rooms):
        here = rooms(number)
        states = rollout.start(params, model, here, driver=drivers.LEARNED)
        for _ in range(tuning.windows):
            found, states, _ = gradient(params, model, here, states, settings=settings)
            # By way of the host: a gradient is laid out over the devices of the crowd, parameters are not.
            nerves, state = update(params.controller, state, jax.device_get(found.slope))
            params = replace(params, controller=nerves)
            norms = np.asarray(found.norms)[~np.asarray(found.lost)]
            middle, largest = (float(np.quantile(norms, at)) if norms.size else math.nan for at in (0.5, 1.0))
            row = {"loss": float(found.loss), "norm": middle, "largest": largest, "lost": int(found.lost.sum())}
            rows.append(row)
            tell(rows[-1])
    return params, rows


def _sizes(nerves: controller.Params, parts: tuple[str, ...]) -> controller.Params:
    """Measure each parameter's size, zero where it is not tuned: means and deviations of the data never are."""

    def size(path: Any, leaf: Float[Array, "*shape"]) -> Float[Array, ""]:
        tuned = path[0].name in parts and not str(path[-1]).strip(".").startswith(("input_", "output_"))
        return jnp.where(tuned, jnp.sqrt(jnp.mean(leaf**2)) + 1e-3, 0.0)

    return jax.tree_util.tree_map_with_path(size, nerves)
