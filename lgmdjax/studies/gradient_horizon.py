"""How far back is a derivative worth taking? The closed-loop imitation loss, against the frames that it goes through.

Robots walk in random rooms until as many frames before `FRAMES` as the horizon has, once, in double precision. From
there each walks on with parameters of its own; the loss is that of the frames up to `FRAMES`, and so is the derivative.
With the horizon its norm grows, as the walk is sensitive to what was done long ago, and what float32 knows of it
shrinks.

| drawn      | meaning                                                                                         |
| ---------- | ----------------------------------------------------------------------------------------------- |
| norm       | of the gradient, in units of the parameters' size, median of the robots; the most and the least  |
| agreement  | of the slope along a random direction, |a - b| / (|a| + |b|), median: of reverse and forward mode |
|            | and of reverse mode and central differences, both in double precision; and of reverse mode in    |
|            | single and in double precision, from the same states                                            |

Hard contacts are those of the XML, soft ones `hexapod.softened`. Thresholds are smooth.

Writes horizon.json, a row a horizon, contact, precision and robot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from mujoco import mjx

from lgmdjax.body import hexapod
from lgmdjax.control import controller, policies
from lgmdjax.learning import rollout_gradient
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches, sharding
from lgmdjax.studies.settings import GradientHorizonSettings

FRAMES = 150
HORIZONS = (1, 2, 4, 8, 15, 30, 60, 100, 150)
STEP = 1e-6  # of central differences, as a share of each parameter's size
PRECISIONS = ("float64", "float32")


def work(folder: Path, inputs: Mapping[str, Path], settings: GradientHorizonSettings, seed: int) -> None:
    """Take the gradient at every horizon, in rooms of luck, with both kinds of contact and in both precisions."""
    with jax.enable_x64(True):
        robot = assembly.with_eyes(assembly.trained(inputs["fit-gait"], inputs["train"]), settings.eyes)
        robot = rollout_gradient.smooth(rollout_gradient.alone(robot))
        rooms, model = room_batches.rooms_of(seed, 0, settings.robots), hexapod.build()
        models = {"hard": model, "soft": hexapod.softened(model)}
        crowds = {name: _on_host((robot, model, rooms, before(robot, model, rooms))) for name, model in models.items()}
    rows = []
    for contact, precision in product(crowds, PRECISIONS):
        print(f"{contact} contacts, {precision}", flush=True)
        with jax.enable_x64(precision == "float64"):
            found = slopes(*jax.tree.map(jnp.asarray, crowds[contact]), seed=seed, differ=precision == "float64")
        rows += [{"contact": contact, "precision": precision} | row for row in found]
    storage.write_json(folder / "gradient_horizon.json", rows)


def _on_host(tree: Any) -> Any:
    """Take arrays off the device, whence `jnp.asarray` rounds them in single precision; keys have none."""
    return jax.tree.map(lambda a: a if jnp.issubdtype(jnp.result_type(a), jax.dtypes.prng_key) else np.asarray(a), tree)


def before(robot: closed_loop.Params, model: mjx.Model, rooms: closed_loop.Room) -> dict[int, closed_loop.State]:
    """Walk a robot in each room; give the states that are each horizon before the end."""
    states, found = rollout.start(robot, model, rooms, driver=policies.LEARNED), {}
    for left in range(FRAMES, 0, -1):
        if left in HORIZONS:
            found[left] = jax.tree.map(jnp.copy, states)  # `advance` uses up what it is given
        states, _ = rollout.advance(robot, model, rooms, states, driver=policies.LEARNED, frames=1, draw=True)
    return found


def slopes(
    robot: closed_loop.Params,
    model: mjx.Model,
    rooms: closed_loop.Room,
    states: Mapping[int, closed_loop.State],
    seed: int,
    differ: bool,
) -> list[dict[str, Any]]:
    """Take the derivative from the states at every horizon by two or three routes; a row a horizon and room."""
    sizes = jax.tree.map(lambda leaf: jnp.sqrt(jnp.mean(leaf**2)) + 1e-6, robot.controller)
    keys = jax.random.split(jax.random.key(seed), len(jax.tree.leaves(sizes)))
    drawn = [
        jax.random.normal(key, jnp.shape(leaf), jnp.float32).astype(leaf.dtype)
        for key, leaf in zip(keys, jax.tree.leaves(robot.controller), strict=True)
    ]
    along = jax.tree.unflatten(jax.tree.structure(robot.controller), drawn)
    rows = []
    for horizon, begun in states.items():
        ask = (robot, model, rooms, begun, sizes)
        values, gradients = jax.device_get(reverse(*ask))
        columns = {
            "loss": values,
            "slope": sum(
                np.sum(leaf * np.asarray(by), axis=tuple(range(1, np.ndim(leaf))))
                for leaf, by in zip(jax.tree.leaves(gradients), drawn, strict=True)
            ),
            "norm": jax.vmap(optax.tree.norm)(gradients),
            "forward": forward(0.0, along, *ask)[1],
        }
        if differ:
            above, below = (np.asarray(forward(by, along, *ask)[0]) for by in (STEP, -STEP))
            columns["difference"] = (above - below) / (2 * STEP)
        table = {name: np.asarray(column).tolist() for name, column in columns.items()}
        rows += [
            {"horizon": horizon, "robot": number} | {name: column[number] for name, column in table.items()}
            for number in range(len(values))
        ]
    return rows


@jax.jit
def reverse(
    robot: closed_loop.Params,
    model: mjx.Model,
    rooms: closed_loop.Room,
    states: closed_loop.State,
    sizes: controller.Params,
) -> tuple[Float[Array, " rooms"], controller.Params]:
    """Take each room's loss, and its gradient by shares of the parameters' sizes, by reverse mode."""

    def share(rooms: closed_loop.Room, states: closed_loop.State) -> tuple[Array, controller.Params]:
        nothing = rollout_gradient.each_its_own(jax.tree.map(jnp.zeros_like, robot.controller), rooms.starts.shape[0])
        (found, _), each = rollout_gradient.slopes(
            lambda shift: (losses(shift, robot, model, rooms, states, sizes), None), nothing
        )
        return found, each

    return sharding.deal(share, rooms, states)


@jax.jit
def forward(by: Float[Array, ""] | float, along: controller.Params, *ask: Any) -> tuple[Array, Array]:
    """Take each room's loss, the nerves shifted by so much along a direction, and its slope there, by forward mode."""
    robot, model, rooms, states, sizes = ask

    def share(rooms: closed_loop.Room, states: closed_loop.State) -> tuple[Array, Array]:
        directions = rollout_gradient.each_its_own(along, rooms.starts.shape[0])
        shift = jax.tree.map(lambda dx: by * dx, directions)
        return jax.jvp(lambda shift: losses(shift, robot, model, rooms, states, sizes), (shift,), (directions,))

    return sharding.deal(share, rooms, states)


def losses(
    shift: controller.Params,
    robot: closed_loop.Params,
    model: mjx.Model,
    rooms: closed_loop.Room,
    states: closed_loop.State,
    sizes: controller.Params,
) -> Float[Array, " rooms"]:
    """Take the mean imitation loss until `FRAMES`, each robot's nerves shifted by shares of their size.

    All walk `FRAMES` on, of which those beyond do not count: one program serves all horizons.
    """

    @partial(jax.checkpoint, prevent_cse=False)
    def frame(place: tuple[controller.Params, closed_loop.Room], state: closed_loop.State, _: None):
        nerves = jax.tree.map(lambda leaf, dx, size: leaf + dx * size, robot.controller, place[0], sizes)
        own = replace(robot, controller=nerves)
        after, record = closed_loop.step(own, model, place[1], state, policies.LEARNED)
        return after, jnp.where(state.frame < FRAMES, jnp.mean((record.velocity - record.label) ** 2), 0.0)

    _, errors = rollout.march(frame, (shift, rooms), states, length=FRAMES)
    return jnp.sum(errors, axis=1) / (FRAMES - states.frame)


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw norm and disagreement against the horizon; rows as in horizon.json."""
    figure = Figure(figsize=(style.WIDTH, 2.8), layout="constrained")
    norm, agreement = figure.subplots(1, 2)
    colours = {"hard": style.LEFT, "soft": style.RIGHT}
    for contact, colour in colours.items():
        double, single = (
            _table([row for row in rows if row["contact"] == contact and row["precision"] == precision])
            for precision in PRECISIONS
        )
        horizons = sorted(double)
        sizes = np.array([[row["norm"] for row in double[h]] for h in horizons])
        norm.plot(horizons, np.median(sizes, axis=1), "o-", color=colour, markersize=3, label=contact)
        norm.fill_between(horizons, sizes.min(axis=1), sizes.max(axis=1), color=colour, alpha=0.15)
        slopes = {name: [_column(double[h], name) for h in horizons] for name in ("slope", "forward", "difference")}
        kinds = {
            "reverse - forward": ("-", slopes["forward"]),
            "reverse - differences": ("--", slopes["difference"]),
            "float64 - float32": (":", [_column(single[h], "slope") for h in horizons]),
        }
        for name, (look, others) in kinds.items():
            apart = list(map(_apart, slopes["slope"], others))
            agreement.plot(horizons, apart, look, color=colour, label=name if contact == "hard" else None)
    norm.set(xscale="log", yscale="log", xlabel="horizon [frames]", ylabel="norm of the gradient")
    norm.legend()
    agreement.set(xscale="log", yscale="log", xlabel="horizon [frames]", ylabel="disagreement of the slope")
    agreement.legend(loc="center right", bbox_to_anchor=(1.0, 0.56))  # between the curves
    return figure


def _table(rows: Sequence[Mapping[str, Any]]) -> dict[int, list[Mapping[str, Any]]]:
    table: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        table.setdefault(row["horizon"], []).append(row)
    return table


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> Float[np.ndarray, " robots"]:
    return np.array([row[name] for row in sorted(rows, key=lambda row: row["robot"])])


def _apart(a: Float[np.ndarray, " robots"], b: Float[np.ndarray, " robots"]) -> float:
    """Take the median over robots of |a - b| / (|a| + |b|)."""
    return float(np.median(np.abs(a - b) / np.maximum(np.abs(a) + np.abs(b), 1e-30))) + 1e-17
