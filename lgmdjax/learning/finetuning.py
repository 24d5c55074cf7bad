"""Finetune a controller while the robot walks, by the gradient of the imitation loss; measure its noise as well.

Adam follows the mean gradient of a batch of robots (`lgmdjax.learning.rollout_gradient`), window after window and room
after room. Each update is in units of `param_scales`. The constants of detector and CPG are multiplied by a factor, so
that their sign is kept and zeros stay zero; weights are changed by addition. Left and right legs share their update, so
that a mirror-symmetric gait stays symmetric.

| symbol | name   | unit                      | meaning                                                              |
| ------ | ------ | ------------------------- | -------------------------------------------------------------------- |
| L      | loss   | nominal^2                 | of the window, mean over robots                                      |
| g      | signal | nominal^2 per param_scale | norm of the robots' mean gradient                                    |
| s      | noise  | nominal^2 per param_scale | standard error of that mean; g is about s if the true gradient is 0  |
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from lgmdjax.control import controller, policies
from lgmdjax.errors import InputError
from lgmdjax.learning import rollout_gradient
from lgmdjax.learning.checkpoints import Checkpoints, resumable
from lgmdjax.locomotion import shaping
from lgmdjax.runtime import tracking
from lgmdjax.runtime.mjx import mjx
from lgmdjax.simulation import rollout
from lgmdjax.simulation.closed_loop import Params, Record, Room, State

MULTIPLICATIVE = ("detector", "cpg")  # parts of the controller whose constants are updated by a factor

Update = Callable[[controller.Params, optax.OptState, PyTree], tuple[controller.Params, optax.OptState]]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of the optimiser."""

    learning_rate: float = 1e-3  # in units of param_scales; decays to zero along half a cosine
    windows_per_room: int = 30  # before the robots continue in other rooms
    rooms: int = 4  # of each robot, one after the other
    trainable: tuple[str, ...] = ("policy",)  # parts of `controller.Params`, or leaves such as "detector.threshold"


class WindowStats(NamedTuple):
    """Statistics of one window; norms are in units of param_scales, and of trainable parameters only."""

    loss: float
    signal: float  # norm of the mean gradient
    noise: float  # its standard error: the norm expected by chance if the true gradient is zero
    median_norm: float  # of the robots' gradients
    max_norm: float
    nonfinite: float  # robots whose loss or gradient was not finite
    fallen: float  # robots that had fallen at the end
    contacts: float  # frames with contact, over all robots


@struct.dataclass(kw_only=True)
class Progress:
    """The state of a fine-tuning run between two rooms."""

    controller_params: controller.Params
    optimiser: optax.OptState
    rooms: Int[Array, ""]  # finished
    rows: Float[Array, "windows columns"]  # `WindowStats` of all windows; nan for later windows


def finetune(
    params: Params,
    model: mjx.Model,
    sample_rooms: Callable[[int], Room],
    gradient_settings: rollout_gradient.Settings,
    settings: Settings,
    *,
    checkpoints: Checkpoints | None = None,
    on_window: Callable[[WindowStats], None] = lambda stats: None,
    label: str = "finetuning",
) -> tuple[Params, list[WindowStats]]:
    """Follow the gradient of the imitation loss with Adam while the robots walk; return the robot and all statistics.

    Args:
        params: a robot with the navigator as its only policy (`rollout_gradient.learned_only`).
        model: the body in MJX.
        sample_rooms: returns a batch of rooms by number, one room per robot.
        gradient_settings: of a window and its derivative.
        settings: of the optimiser.
        checkpoints: where progress is saved after every room and resumed from; the result is the same, bit for bit.
        on_window: called with the statistics of every window.
        label: name of the fit in the curves that are tracked (`lgmdjax.runtime.tracking`).
    """
    scales, steps = param_scales(params.controller, settings.trainable), settings.windows_per_room * settings.rooms
    # Adam's epsilon must be small compared with every derivative.
    optimiser = optax.adam(optax.cosine_decay_schedule(settings.learning_rate, steps), eps=1e-15)
    update = _make_update(optimiser, scales)

    def finetune_in_room(progress: Progress, number: int, _: int) -> Progress:
        rooms, robot = sample_rooms(number), replace(params, controller=progress.controller_params)
        states = rollout.reset_batch(robot, model, rooms, policy=policies.LEARNED)

        def gradient(own: controller.Params, states: State) -> tuple[rollout_gradient.Gradient, State, Record]:
            robot = replace(params, controller=own)
            return rollout_gradient.gradient(robot, model, rooms, states, scales, settings=gradient_settings)

        first = int(progress.rooms) * settings.windows_per_room

        def report(window: int, stats: WindowStats) -> None:
            named = {f"{label}/{name}": value for name, value in stats._asdict().items()}
            tracking.log(first + window + 1, named)
            on_window(stats)

        return _follow(progress, states, gradient, update, windows=settings.windows_per_room, report=report)

    initial = _initial_progress(params.controller, optimiser, steps)
    *_, (_, progress) = resumable(finetune_in_room, initial, checkpoints, total=settings.rooms)
    stats = [WindowStats(*row) for row in np.asarray(progress.rows).tolist()]
    return replace(params, controller=progress.controller_params), stats


def param_scales(controller_params: controller.Params, trainable: tuple[str, ...]) -> controller.Params:
    """Return the scale in which each parameter is updated; zero if it is not trainable.

    The scale of a constant of detector or CPG is its magnitude, that of a weight the root mean square of its array.
    Scaling constants of the navigator and widths of smooth thresholds are never trained.

    Raises InputError for a name in `trainable` that is not in the controller.
    """
    names = [_name(path) for path, _ in jax.tree_util.tree_leaves_with_path(controller_params)]
    for part in trainable:
        if not any(_is_part_of(name, part) for name in names):
            raise InputError(
                f"trainable parameters: expected some of {', '.join(names)}, or a group of them such as shaping, "
                f"got {part}; choose from these"
            )

    def scale(path: tuple[object, ...], leaf: Float[Array, "*shape"]) -> Float[Array, "*scale"]:
        name = _name(path)
        own = jnp.abs(leaf) if name.partition(".")[0] in MULTIPLICATIVE else jnp.sqrt(jnp.mean(leaf**2)) + 1e-3
        fixed = name.rpartition(".")[2].startswith(("input_", "output_")) or name.endswith("_width")
        return own if any(_is_part_of(name, part) for part in trainable) and not fixed else jnp.zeros_like(own)

    return jax.tree_util.tree_map_with_path(scale, controller_params)


def apply_update(
    controller_params: controller.Params, updates: controller.Params, param_scales: controller.Params
) -> controller.Params:
    """Add updates in units of `param_scales` to weights; multiply the constants of detector and CPG by exp(update)."""
    added = jax.tree.map(lambda leaf, update, scale: leaf + update * scale, controller_params, updates, param_scales)
    multiplied = jax.tree.map(lambda leaf, update: leaf * jnp.exp(update), controller_params, updates)
    return replace(added, **{name: getattr(multiplied, name) for name in MULTIPLICATIVE})


def symmetrise(grad: controller.Params) -> controller.Params:
    """Average the gradient of the legs with its mirror image, so that a mirror-symmetric gait stays symmetric."""
    legs = jax.tree.map(lambda own, image: (own + image) / 2, grad.shaping, shaping.mirror(grad.shaping))
    W = grad.cpg.coupling
    return replace(grad, shaping=legs, cpg=replace(grad.cpg, coupling=(W + W[::-1, ::-1]) / 2))


def _initial_progress(
    controller_params: controller.Params, optimiser: optax.GradientTransformation, steps: int
) -> Progress:
    weights: PyTree = controller_params
    return Progress(
        controller_params=controller_params,
        optimiser=optimiser.init(weights),
        rooms=jnp.asarray(0, jnp.int32),
        rows=jnp.full((steps, len(WindowStats._fields)), jnp.nan),
    )


def _follow(
    progress: Progress,
    states: State,
    gradient: Callable[[controller.Params, State], tuple[rollout_gradient.Gradient, State, Record]],
    update: Update,
    *,
    windows: int,
    report: Callable[[int, WindowStats], None],
) -> Progress:
    """Walk all windows in one room, with an update after each."""
    controller_params, memory, rows = progress.controller_params, progress.optimiser, []
    for window in range(windows):
        found, states, record = gradient(controller_params, states)
        # Through the host, since a gradient is sharded over the robots' devices and parameters are not.
        controller_params, memory = update(controller_params, memory, jax.device_get(found.grad))
        rows.append(_summarise(found, record))
        report(window, rows[-1])
    first = int(progress.rooms) * windows
    filled = progress.rows.at[first : first + len(rows)].set(jnp.asarray(rows, float))
    return Progress(controller_params=controller_params, optimiser=memory, rooms=progress.rooms + 1, rows=filled)


def _make_update(optimiser: optax.GradientTransformation, scales: controller.Params) -> Update:
    """Return a jitted step of the optimiser: (parameters, optimiser's state, gradient) -> (parameters, state)."""

    @jax.jit
    def update(
        controller_params: controller.Params, memory: optax.OptState, grad: PyTree
    ) -> tuple[controller.Params, optax.OptState]:
        symmetric: PyTree = symmetrise(grad)
        updates: PyTree
        updates, memory = optimiser.update(symmetric, memory)
        return apply_update(controller_params, updates, scales), memory

    return update


def _summarise(found: rollout_gradient.Gradient, record: Record) -> WindowStats:
    finite, ok = np.asarray(found.norms)[~np.asarray(found.nonfinite)], np.asarray(record.ok)
    median, largest = (float(np.quantile(finite, q)) if finite.size else math.nan for q in (0.5, 1.0))
    return WindowStats(
        loss=float(found.loss),
        signal=float(optax.tree.norm(found.grad)),
        noise=float(found.standard_error),
        median_norm=median,
        max_norm=largest,
        nonfinite=int(found.nonfinite.sum()),
        fallen=int((~ok[:, -1]).sum()),
        contacts=int((np.asarray(record.contact) & ok).sum()),
    )


def _name(path: tuple[object, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _is_part_of(name: str, part: str) -> bool:
    return f"{name}.".startswith(f"{part}.")
