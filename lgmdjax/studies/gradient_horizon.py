"""Through how many frames is a gradient of the closed loop useful? The imitation loss, against the horizon.

Robots walk in random rooms up to `END_FRAME` minus the horizon, once, in double precision. From there on each robot has
its own parameters. The loss is that of the frames up to `END_FRAME`, and the gradient is taken through the same frames.
The longer the horizon, the larger the gradient's norm, because the walk is sensitive to earlier commands, and the fewer
of its digits are correct in float32.

| plotted    | meaning                                                                                          |
| ---------- | ------------------------------------------------------------------------------------------------ |
| norm       | of the gradient, in units of the parameters' RMS; median, minimum and maximum over robots        |
| agreement  | of the derivative along a random direction, |a - b| / (|a| + |b|), median: of reverse and        |
|            | forward mode, and of reverse mode and central differences, in double precision; and of reverse   |
|            | mode in single and in double precision, from the same states                                     |

Hard contacts are those of the XML, soft ones `hexapod.soften_contacts`. Thresholds are smooth.

Writes gradient_horizon.json, a row for each horizon, contact model, precision and robot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, PyTree
from matplotlib.figure import Figure

from lgmdjax.body import hexapod
from lgmdjax.control import controller, policies
from lgmdjax.learning import rollout_gradient
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.mjx import mjx
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches, sharding
from lgmdjax.studies.settings import GradientHorizonSettings

END_FRAME = 150
HORIZONS = (1, 2, 4, 8, 15, 30, 60, 100, 150)  # frames
STEP = 1e-6  # of central differences, in units of the parameters' RMS
PRECISIONS = ("float64", "float32")


@struct.dataclass(kw_only=True)
class Problem:
    """The robot, the physics and the rooms whose loss is differentiated."""

    robot: closed_loop.Params
    model: mjx.Model
    rooms: closed_loop.Room
    param_scales: controller.Params  # RMS of each parameter: the unit of the gradient


def run(folder: Path, inputs: Mapping[str, Path], settings: GradientHorizonSettings, seed: int) -> None:
    """Take the gradient at every horizon in random rooms, with both contact models and in both precisions."""
    with jax.enable_x64(True):
        robot = assembly.with_resolution(assembly.load_robot(inputs["fit-gait"], inputs["train"]), settings.eyes)
        robot = rollout_gradient.smooth_thresholds(rollout_gradient.learned_only(robot))
        rooms, model = room_batches.training_rooms(seed, 0, settings.robots), closed_loop.build_model(robot)
        models = {"hard": model, "soft": hexapod.soften_contacts(model)}
        recorded = {
            contact: _on_host((robot, own, rooms, states_before_end(robot, own, rooms)))
            for contact, own in models.items()
        }
    rows = []
    for contact, precision in product(recorded, PRECISIONS):
        print(f"{contact} contacts, {precision}", flush=True)
        double = precision == "float64"
        with jax.enable_x64(double):
            robot, own, rooms, states = jax.tree.map(jnp.asarray, recorded[contact])
            scales = jax.tree.map(lambda leaf: jnp.sqrt(jnp.mean(leaf**2)) + 1e-6, robot.controller)
            problem = Problem(robot=robot, model=own, rooms=rooms, param_scales=scales)
            found = derivatives(problem, states, seed, finite_differences=double)
        rows += [{"contact": contact, "precision": precision} | row for row in found]
    storage.write_json(folder / "gradient_horizon.json", rows)


def _on_host(tree: PyTree) -> PyTree:
    """Copy arrays, but not random keys, to the host, so that `jnp.asarray` can round them to single precision."""
    return jax.tree.map(lambda a: a if jnp.issubdtype(jnp.result_type(a), jax.dtypes.prng_key) else np.asarray(a), tree)


def states_before_end(
    robot: closed_loop.Params, model: mjx.Model, rooms: closed_loop.Room
) -> dict[int, closed_loop.State]:
    """Roll out the robot in each room; return for each horizon the states that many frames before the end."""
    states, found = rollout.reset_batch(robot, model, rooms, policy=policies.LEARNED), {}
    for left in range(END_FRAME, 0, -1):
        if left in HORIZONS:
            found[left] = jax.tree.map(jnp.copy, states)  # `rollout_batch` donates its states
        states, _ = rollout.rollout_batch(robot, model, rooms, states, True, policy=policies.LEARNED, frames=1)
    return found


def derivatives(
    problem: Problem, states: Mapping[int, closed_loop.State], seed: int, *, finite_differences: bool
) -> list[JsonObject]:
    """Differentiate the loss from the states at every horizon; return a row for each horizon and room.

    Args:
        problem: in the precision in which the derivative is taken.
        states: by horizon, from `states_before_end`.
        seed: of the random direction.
        finite_differences: take central differences too, in addition to reverse and forward mode.
    """
    params = problem.robot.controller
    keys = jax.random.split(jax.random.key(seed), len(jax.tree.leaves(params)))
    drawn = [
        jax.random.normal(key, jnp.shape(leaf), jnp.float32).astype(leaf.dtype)
        for key, leaf in zip(keys, jax.tree.leaves(params), strict=True)
    ]
    direction = jax.tree.unflatten(jax.tree.structure(params), drawn)
    rows = []
    for horizon, initial in states.items():
        losses, gradients = jax.device_get(reverse_mode(problem, initial))
        columns = {
            "loss": losses,
            "reverse": sum(
                np.sum(leaf * np.asarray(by), axis=tuple(range(1, np.ndim(leaf))))
                for leaf, by in zip(jax.tree.leaves(gradients), drawn, strict=True)
            ),
            "norm": jax.vmap(optax.tree.norm)(gradients),
            "forward": forward_mode(0.0, direction, problem, initial)[1],
        }
        if finite_differences:
            above, below = (np.asarray(forward_mode(by, direction, problem, initial)[0]) for by in (STEP, -STEP))
            columns["difference"] = (above - below) / (2 * STEP)
        table = {name: np.asarray(column).tolist() for name, column in columns.items()}
        rows += [
            {"horizon": horizon, "robot": robot} | {name: column[robot] for name, column in table.items()}
            for robot in range(len(losses))
        ]
    return rows


@jax.jit
def reverse_mode(problem: Problem, states: closed_loop.State) -> tuple[Float[Array, " rooms"], controller.Params]:
    """Return each room's loss and its gradient by reverse mode, in units of the parameters' RMS."""

    def work(rooms: closed_loop.Room, states: closed_loop.State) -> tuple[Array, controller.Params]:
        zero = jax.tree.map(jnp.zeros_like, problem.robot.controller)
        shift = rollout_gradient.broadcast_params(zero, rooms.starts.shape[0])
        (losses, _), grads = rollout_gradient.per_robot_grad(
            lambda shift: (window_losses(shift, replace(problem, rooms=rooms), states), None), shift
        )
        return losses, grads

    return sharding.shard_robots(work, problem.rooms, states)


@jax.jit
def forward_mode(
    by: Float[Array, ""] | float, direction: controller.Params, problem: Problem, states: closed_loop.State
) -> tuple[Array, Array]:
    """Return each room's loss and its derivative along a direction, by forward mode.

    The controller's parameters are shifted by `by` along the direction.
    """

    def work(rooms: closed_loop.Room, states: closed_loop.State) -> tuple[Array, Array]:
        directions = rollout_gradient.broadcast_params(direction, rooms.starts.shape[0])
        shift = jax.tree.map(lambda dx: by * dx, directions)
        shifted_losses = lambda shift: window_losses(shift, replace(problem, rooms=rooms), states)  # noqa: E731
        return jax.jvp(shifted_losses, (shift,), (directions,))

    return sharding.shard_robots(work, problem.rooms, states)


def window_losses(shift: controller.Params, problem: Problem, states: closed_loop.State) -> Float[Array, " rooms"]:
    """Return the mean imitation loss up to `END_FRAME`, each robot's parameters shifted in units of their RMS.

    All robots walk `END_FRAME` frames, and frames beyond the end do not count: one program serves all horizons.
    """
    robot, model = problem.robot, problem.model

    @partial(jax.checkpoint, prevent_cse=False)
    def frame(constants: tuple[controller.Params, closed_loop.Room], state: closed_loop.State, _: None):
        shift, room = constants
        params = jax.tree.map(lambda leaf, dx, scale: leaf + dx * scale, robot.controller, shift, problem.param_scales)
        own = replace(robot, controller=params)
        after, record = closed_loop.step(own, model, room, state, policies.LEARNED)
        return after, jnp.where(state.frame < END_FRAME, jnp.mean((record.velocity - record.label) ** 2), 0.0)

    _, errors = rollout.scan_batch(frame, (shift, problem.rooms), states, length=END_FRAME)
    return jnp.sum(errors, axis=1) / (END_FRAME - states.frame)


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot the gradient's norm and the disagreement of the derivatives against the horizon."""
    figure = Figure(figsize=(style.WIDTH, 2.8), layout="constrained")
    norm, agreement = figure.subplots(1, 2)
    colours = {"hard": style.LEFT_COLOUR, "soft": style.RIGHT_COLOUR}
    for contact, colour in colours.items():
        double, single = (
            _by_horizon([row for row in rows if row["contact"] == contact and row["precision"] == precision])
            for precision in PRECISIONS
        )
        horizons = sorted(double)
        norms = np.array([[row["norm"] for row in double[h]] for h in horizons])
        norm.plot(horizons, np.median(norms, axis=1), "o-", color=colour, markersize=3, label=contact)
        norm.fill_between(horizons, norms.min(axis=1), norms.max(axis=1), color=colour, alpha=0.15)
        found = {name: [_column(double[h], name) for h in horizons] for name in ("reverse", "forward", "difference")}
        comparisons = {
            "reverse - forward": ("-", found["forward"]),
            "reverse - differences": ("--", found["difference"]),
            "float64 - float32": (":", [_column(single[h], "reverse") for h in horizons]),
        }
        for name, (line, others) in comparisons.items():
            disagreement = list(map(_disagreement, found["reverse"], others))
            agreement.plot(horizons, disagreement, line, color=colour, label=name if contact == "hard" else None)
    norm.set(xscale="log", yscale="log", xlabel="horizon [frames]", ylabel="norm of the gradient")
    norm.legend()
    agreement.set(xscale="log", yscale="log", xlabel="horizon [frames]", ylabel="disagreement of the derivative")
    agreement.legend(loc="center right", bbox_to_anchor=(1.0, 0.56))  # between the curves
    return figure


def _by_horizon(rows: Sequence[JsonObject]) -> dict[int, list[JsonObject]]:
    table: dict[int, list[JsonObject]] = {}
    for row in rows:
        table.setdefault(row["horizon"], []).append(row)
    return table


def _column(rows: Sequence[JsonObject], name: str) -> Float[np.ndarray, " robots"]:
    return np.array([row[name] for row in sorted(rows, key=lambda row: row["robot"])])


def _disagreement(a: Float[np.ndarray, " robots"], b: Float[np.ndarray, " robots"]) -> float:
    """Return the median over robots of |a - b| / (|a| + |b|)."""
    return float(np.median(np.abs(a - b) / np.maximum(np.abs(a) + np.abs(b), 1e-30))) + 1e-17
