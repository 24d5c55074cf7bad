"""Tune a robot's nerves while it walks, by the imitation loss (`lgmdjax.learning.rollout_gradient`); tell how far to
trust its slope.

Adam follows the mean gradient of a crowd, window after window, room after room. Changes are shares of the parameters'
sizes: the constants of detector and rhythm are changed by factors, so that they keep their sign and zeros stay zeros,
weights by addition. The legs of both sides are tuned as one, so that what walked mirrored goes on to.

| symbol | name   | unit                 | meaning                                                              |
| ------ | ------ | -------------------- | -------------------------------------------------------------------- |
| L      | loss   | nominal^2            | of the window, mean over robots                                      |
| g      | signal | nominal^2 by a share | norm of the mean of their gradients                                  |
| s      | noise  | nominal^2 by a share | root of the mean's variance, as they differ; were the true gradient  |
|        |        |                      | none, g would be about s                                             |
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int
from mujoco import mjx

from lgmdjax.control import controller, policies
from lgmdjax.errors import InputError
from lgmdjax.learning import rollout_gradient
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.locomotion import shaping
from lgmdjax.simulation import rollout
from lgmdjax.simulation.closed_loop import Params, Record, Room

FACTORS = ("lgmd", "cpg")  # whose constants are changed by factors


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How to follow the gradient."""

    learning_rate: float = 1e-3  # of parameters as shares of their sizes; falls to nothing like half a cosine
    windows: int = 30  # in a room, before robots go on to others
    rooms: int = 4  # of each robot, one after the other
    parts: tuple[str, ...] = ("driver",)  # of `controller.Params` that are tuned, also such as "lgmd.threshold"


class Row(NamedTuple):
    """What is told of a window."""

    loss: float
    signal: float  # norm of the mean gradient, in shares of the sizes of what is tuned
    noise: float  # root of its variance: norm that it would have by chance alone
    norm: float  # of one robot's gradient, the middle one
    largest: float
    lost: float  # robots whose loss or gradient was not finite
    fallen: float  # robots, at its end
    touches: float


@struct.dataclass(kw_only=True)
class Progress:
    """Where a tune is, between two rooms."""

    nerves: controller.Params
    optimiser: Any
    rooms: Int[Array, ""]  # done
    rows: Float[Array, "windows columns"]  # `Row`s; nan where there has been none


def tune(
    params: Params,
    model: mjx.Model,
    rooms: Callable[[int], Room],
    window: rollout_gradient.Settings,
    settings: Settings,
    *,
    saved: Checkpoints | None = None,
    tell: Callable[[Row], None] = lambda row: None,
) -> tuple[Params, list[Row]]:
    """Follow the gradient of the imitation loss (Adam) while the robots walk, window after window.

    Args:
        params: a robot with the navigator alone at the wheel. rooms: of the crowd, by number.
        window: through which a derivative goes. settings: see there.
        saved: where progress is kept after every room, and carried on from: the result is the same, bit for bit.
        tell: told of every window.

    Returns:
        The robot, and a row a window.
    """
    whole, steps = sizes(params.controller, settings.parts), settings.windows * settings.rooms
    # What keeps Adam from dividing by zero must be small beside all slopes.
    optimiser = optax.adam(optax.cosine_decay_schedule(settings.learning_rate, steps), eps=1e-15)
    update = _follower(optimiser, whole)

    def practise(done: Progress, here: Room) -> Progress:
        nerves, state, rows = done.nerves, done.optimiser, []
        states = rollout.start(replace(params, controller=nerves), model, here, driver=policies.LEARNED)
        for _ in range(settings.windows):
            own = replace(params, controller=nerves)
            found, states, record = rollout_gradient.gradient(own, model, here, states, whole, settings=window)
            # By way of the host: a gradient is laid out over the devices of the crowd, parameters are not.
            nerves, state = update(nerves, state, jax.device_get(found.slope))
            rows.append(_row(found, record))
            tell(rows[-1])
        first = int(done.rooms) * settings.windows
        filled = done.rows.at[first : first + len(rows)].set(jnp.asarray(rows, float))
        return Progress(nerves=nerves, optimiser=state, rooms=done.rooms + 1, rows=filled)

    nothing = jnp.full((steps, len(Row._fields)), jnp.nan)
    nerves: Any = params.controller
    done = Progress(nerves=nerves, optimiser=optimiser.init(nerves), rooms=jnp.asarray(0, jnp.int32), rows=nothing)
    done = done if saved is None else saved.latest(done)
    for number in range(int(done.rooms), settings.rooms):
        done = practise(done, rooms(number))
        if saved is not None:
            saved.save(number + 1, done)
    return replace(params, controller=done.nerves), [Row(*row) for row in np.asarray(done.rows).tolist()]


def _follower(optimiser: optax.GradientTransformation, sizes: controller.Params) -> Callable[..., Any]:
    """Make what follows a slope by a step: nerves, state of the optimiser, slope -> nerves, state."""

    @jax.jit
    def update(nerves: controller.Params, state: Any, slope: controller.Params) -> tuple[controller.Params, Any]:
        both: Any = tied(slope)
        changes: Any
        changes, state = optimiser.update(both, state)
        return moved(nerves, changes, sizes), state

    return update


def sizes(nerves: controller.Params, parts: tuple[str, ...]) -> controller.Params:
    """Measure what a share of each parameter is a share of, zero where it is not tuned.

    A constant of detector or rhythm has its own size, a weight the root mean square of its kind. Means and deviations
    of the data, and the widths of smooth steps, are never tuned.

    Raises InputError for a part that there is not.
    """
    names = [_name(path) for path, _ in jax.tree_util.tree_leaves_with_path(nerves)]
    for part in parts:
        if not any(_within(name, part) for name in names):
            raise InputError(f"tuning parts: expected some of {', '.join(names)}, or what they are of, got {part}")

    def size(path: Any, leaf: Float[Array, "*shape"]) -> Float[Array, "*size"]:
        own = jnp.abs(leaf) if path[0].name in FACTORS else jnp.sqrt(jnp.mean(leaf**2)) + 1e-3
        name = _name(path)
        fixed = name.rpartition(".")[2].startswith(("input_", "output_")) or name.endswith("_width")
        return own if any(_within(name, part) for part in parts) and not fixed else jnp.zeros_like(own)

    return jax.tree_util.tree_map_with_path(size, nerves)


def moved(nerves: controller.Params, changes: controller.Params, sizes: controller.Params) -> controller.Params:
    """Change parameters by shares of their sizes: constants of detector and rhythm by factors, weights by addition."""
    added = jax.tree.map(lambda leaf, change, size: leaf + change * size, nerves, changes, sizes)
    grown = jax.tree.map(lambda leaf, change: leaf * jnp.exp(change), nerves, changes)
    return replace(added, **{name: getattr(grown, name) for name in FACTORS})


def tied(slope: controller.Params) -> controller.Params:
    """Take the mean of a slope of the legs and its mirror image, by which what walked mirrored goes on to."""
    legs = jax.tree.map(lambda own, image: (own + image) / 2, slope.shaping, shaping.mirror(slope.shaping))
    W = slope.cpg.coupling
    return replace(slope, shaping=legs, cpg=replace(slope.cpg, coupling=(W + W[::-1, ::-1]) / 2))


def _row(found: rollout_gradient.Gradient, record: Record) -> Row:
    sound, ok = np.asarray(found.norms)[~np.asarray(found.lost)], np.asarray(record.ok)
    middle, largest = (float(np.quantile(sound, at)) if sound.size else math.nan for at in (0.5, 1.0))
    return Row(
        loss=float(found.loss),
        signal=float(optax.tree.norm(found.slope)),
        noise=float(found.noise),
        norm=middle,
        largest=largest,
        lost=int(found.lost.sum()),
        fallen=int((~ok[:, -1]).sum()),
        touches=int((np.asarray(record.contact) & ok).sum()),
    )


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _within(name: str, part: str) -> bool:
    return f"{name}.".startswith(f"{part}.")
