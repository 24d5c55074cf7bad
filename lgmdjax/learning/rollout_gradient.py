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

Parameters differ by orders of magnitude, and their slopes by more. A gradient is measured in shares of their sizes,
which the caller names (`lgmdjax.learning.finetuning`).

| symbol | name            | unit                 | equation |
| ------ | --------------- | -------------------- | -------- |
| v      | record.velocity | nominal              | 17       |
| v*     | record.label    | nominal              | 22       |
| L      | loss            | nominal^2            | sec. 5.1 |
| -      | slope           | nominal^2 by a share | -        |

Gradient: a robot that is set back starts anew, and what it did before does not count for what comes after. One that
fell counts no longer. Thresholds that are steps have none (`lgmd.Params.smooth`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from lgmdjax.control import controller, policies
from lgmdjax.detectors import lgmd
from lgmdjax.runtime.export_cache import Kept
from lgmdjax.simulation import closed_loop, rollout, sharding
from lgmdjax.simulation.closed_loop import Params, Record, Room, State, Through

WIDTH = 0.3  # of a smooth threshold, as a share of it


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A window, and how its derivative is taken."""

    frames: int = 30
    through: Through = "everything"
    remat: bool = True  # walk each frame again on the way back: its inside need not be kept; physics steps are anyway
    clip: float = math.inf  # largest norm of one robot's gradient, as a multiple of the crowd's middle one
    draw: bool = True  # what the eyes see; else they stay shut


@struct.dataclass(kw_only=True)
class Gradient:
    """What a crowd's window gives."""

    loss: Float[Array, ""]  # mean over the robots that count
    slope: controller.Params  # mean of their gradients, each cut to the largest norm, by shares of the sizes
    norms: Float[Array, " robots"]  # before that
    noise: Float[Array, ""]  # root of the mean's variance, as its robots differ: its norm by chance alone
    lost: Bool[Array, " robots"]  # whose loss or gradient is not finite: they do not count


def losses(
    nerves: controller.Params, params: Params, model: mjx.Model, rooms: Room, states: State, settings: Settings
) -> tuple[Float[Array, " robots"], tuple[State, Record]]:
    """Walk a crowd for a window; give each robot's loss, the states to go on from, and what the window left behind.

    Args:
        nerves: each robot's own, of which the derivative is asked, in place of those in `params`; the driver is a
            navigator. states: as `simulation.init` or the last window left them.
    """

    def frame(place: tuple[controller.Params, Room], state: State, _: None) -> tuple[State, Record]:
        own, room = replace(params, controller=place[0]), place[1]
        return closed_loop.step(own, model, room, state, policies.LEARNED, settings.draw, settings.through)

    # What is walked again is in a loop, where XLA cannot take it for the same as the first time.
    walked = jax.checkpoint(frame, prevent_cse=False) if settings.remat else frame
    states, record = rollout.march(walked, (nerves, rooms), states, length=settings.frames)
    error = jnp.mean((record.velocity - record.label) ** 2, axis=-1)
    return jnp.mean(jnp.where(record.ok, error, 0.0), axis=-1), (states, record)


def loss(
    nerves: controller.Params, params: Params, model: mjx.Model, room: Room, state: State, settings: Settings
) -> tuple[Float[Array, ""], tuple[State, Record]]:
    """Walk one robot, as `losses` does a crowd."""
    nerves, room, state = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (nerves, room, state))
    found, rest = losses(nerves, params, model, room, state, settings)
    return found[0], jax.tree.map(lambda leaf: leaf[0], rest)


@partial(Kept, donated=("states",))
def gradient(
    params: Params, model: mjx.Model, rooms: Room, states: State, sizes: controller.Params, *, settings: Settings
) -> tuple[Gradient, State, Record]:
    """Walk a crowd for a window, each robot in its own room, and take the gradient of its mean loss.

    The crowd is dealt out to all devices. A robot whose loss or gradient is not finite is left out of the means,
    and flagged.

    Args:
        states: from `rollout.start`, or as the last window left them; they are used up.
        sizes: of the nerves' parameters, in which the gradient is measured; zero for what it leaves out.
    """

    def share(rooms: Room, states: State) -> tuple[Any, Any]:
        nerves = each_its_own(params.controller, rooms.starts.shape[0])
        return slopes(lambda nerves: losses(nerves, params, model, rooms, states, settings), nerves)

    (costs, (states, record)), each = sharding.deal(share, rooms, states)
    each = jax.tree.map(jnp.multiply, each, sizes)
    norms: Array = jax.vmap(optax.tree.norm)(each)
    lost = ~(jnp.isfinite(costs) & jnp.isfinite(norms))
    count = jnp.maximum(jnp.sum(~lost), 1)
    scale = jnp.where(lost, 0.0, _cut(norms, lost, settings.clip)) / count

    def mean(leaf: Float[Array, "robots *shape"]) -> Float[Array, "*shape"]:
        sound = jnp.where(lost.reshape(-1, *[1] * (leaf.ndim - 1)), 0.0, leaf)
        return jnp.tensordot(scale.astype(leaf.dtype), sound, axes=1)

    slope = jax.tree.map(mean, each)
    # The variance of a mean: what its robots' squares have more than its own.
    squares = count * jnp.sum((scale * jnp.where(lost, 0.0, norms)) ** 2)
    noise = jnp.sqrt(jnp.maximum(squares - optax.tree.norm(slope, squared=True), 0.0) / jnp.maximum(count - 1, 1))
    found = Gradient(loss=jnp.sum(costs, where=~lost) / count, slope=slope, norms=norms, noise=noise, lost=lost)
    return found, states, record


def slopes(
    of: Callable[[controller.Params], tuple[Float[Array, " robots"], Any]], nerves: controller.Params
) -> tuple[tuple[Float[Array, " robots"], Any], controller.Params]:
    """Give what a crowd's losses and the rest are, and the gradient of each robot's loss by its own nerves.

    Robots are apart: it is that of the sum.
    """

    def total(nerves: controller.Params) -> tuple[Float[Array, ""], Any]:
        found, rest = of(nerves)
        return jnp.sum(found), (found, rest)

    each, found = jax.grad(total, has_aux=True)(nerves)
    return found, each


def each_its_own(nerves: controller.Params, robots: int) -> controller.Params:
    """Copy nerves for each robot of a crowd."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (robots, *jnp.shape(leaf))), nerves)


def _cut(norms: Float[Array, " robots"], lost: Bool[Array, " robots"], clip: float) -> Float[Array, " robots"]:
    """Scale gradients down that are longer than a multiple of the middle one; those that fell have none."""
    if math.isinf(clip):
        return jnp.ones_like(norms)
    middle = jnp.nan_to_num(jnp.nanmedian(jnp.where(lost | (norms == 0), jnp.nan, norms)))
    return jnp.minimum(1.0, clip * middle / jnp.maximum(norms, 1e-30))


def alone(params: Params) -> Params:
    """Leave the navigator alone at the wheel of a robot that all five drivers are aboard of."""
    driver = params.controller.driver.drivers[policies.ALL.index(policies.LEARNED)]
    return replace(params, controller=replace(params.controller, driver=driver))


def smooth(params: Params) -> Params:
    """Give a robot's detectors steps that have a slope, `WIDTH` wide."""
    return replace(params, controller=replace(params.controller, lgmd=lgmd.smoothed(params.controller.lgmd, WIDTH)))
