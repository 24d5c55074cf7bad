"""How far back is a derivative worth taking? The closed-loop imitation loss, against the frames that it goes through.

Robots walk in random rooms for `FRAMES` frames, their parameters those of the controller throughout; the loss is that
of the last frames, and so is the derivative: what the parameters did before does not count. With the number of those
frames, the horizon, its norm grows as the walk is sensitive to what was done long ago, and what float32 knows of it
shrinks.

| drawn      | meaning                                                                                        |
| ---------- | ---------------------------------------------------------------------------------------------- |
| norm       | of the gradient, in units of the parameters' size, median of the robots; the most and the least |
| agreement  | of the slope along a random direction, |a - b| / (|a| + |b|), median: of reverse and forward     |
|            | mode in either precision, of reverse mode and central differences in double precision          |

By the time that a derivative begins, walks in single and in double precision have parted: theirs are not compared.

Hard contacts are those of the XML, soft ones `hexapod.softened`. Thresholds are smooth.

Writes horizon.json, a row a horizon, contact, precision and robot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from mujoco import mjx

from lgmdjax import controller, drivers, figures, files, hexapod, imitation, rollout, scales, simulation
from lgmdjax.stages import crew

FRAMES = 150
HORIZONS = (1, 2, 4, 8, 15, 30, 60, 100, 150)
STEP = 1e-6  # of central differences, as a share of each parameter's size
CONTACTS = ("hard", "soft")
PRECISIONS = ("float64", "float32")


def work(folder: Path, inputs: Mapping[str, Path], settings: scales.Horizon, seed: int) -> None:
    """Take the gradient at every horizon, in rooms of luck, with both kinds of contact and in both precisions."""
    rows = []
    for precision in PRECISIONS:
        with jax.enable_x64(precision == "float64"):
            robot = crew.with_eyes(crew.trained(inputs["fit-gait"], inputs["train"]), settings.eyes)
            robot = imitation.smooth(imitation.alone(robot))
            rooms = crew.rooms_of(seed, 0, settings.robots)
            models = {"hard": hexapod.build(), "soft": hexapod.softened(hexapod.build())}
            for contact in CONTACTS:
                print(f"{contact} contacts, {precision}", flush=True)
                facts = {"contact": contact, "precision": precision}
                found = slopes(robot, models[contact], rooms, seed, differ=precision == "float64")
                rows += [facts | row for row in found]
    files.write_json(folder / "horizon.json", rows)


def slopes(
    robot: simulation.Params, model: mjx.Model, rooms: simulation.Room, seed: int, differ: bool
) -> list[dict[str, Any]]:
    """Walk a robot in each room, and take the derivative at every horizon by three routes; a row a horizon and room."""
    sizes = jax.tree.map(lambda leaf: jnp.sqrt(jnp.mean(leaf**2)) + 1e-6, robot.controller)
    keys = jax.random.split(jax.random.key(seed), len(jax.tree.leaves(sizes)))
    drawn = [
        jax.random.normal(key, jnp.shape(leaf), jnp.float32).astype(leaf.dtype)
        for key, leaf in zip(keys, jax.tree.leaves(robot.controller), strict=True)
    ]
    along = jax.tree.unflatten(jax.tree.structure(robot.controller), drawn)
    rows = []
    for horizon in HORIZONS:
        ask = (robot, model, rooms, sizes, jnp.asarray(horizon))
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
def reverse(*ask: Any) -> tuple[Float[Array, " rooms"], controller.Params]:
    """Take each room's loss, and its gradient by shares of the parameters' sizes, by reverse mode."""
    robot, model, rooms, sizes, horizon = ask

    def share(rooms: simulation.Room) -> tuple[Array, controller.Params]:
        nothing = imitation.each_its_own(jax.tree.map(jnp.zeros_like, robot.controller), rooms.starts.shape[0])
        (found, _), each = imitation.slopes(
            lambda shift: (losses(shift, robot, model, rooms, sizes, horizon), None), nothing
        )
        return found, each

    return rollout.deal(share, rooms)


@jax.jit
def forward(by: Float[Array, ""] | float, along: controller.Params, *ask: Any) -> tuple[Array, Array]:
    """Take each room's loss, the nerves shifted by so much along a direction, and its slope there, by forward mode."""
    robot, model, rooms, sizes, horizon = ask

    def share(rooms: simulation.Room) -> tuple[Array, Array]:
        directions = imitation.each_its_own(along, rooms.starts.shape[0])
        shift = jax.tree.map(lambda dx: by * dx, directions)
        return jax.jvp(lambda shift: losses(shift, robot, model, rooms, sizes, horizon), (shift,), (directions,))

    return rollout.deal(share, rooms)


def losses(
    shift: controller.Params,
    robot: simulation.Params,
    model: mjx.Model,
    rooms: simulation.Room,
    sizes: controller.Params,
    horizon: Array,
) -> Float[Array, " rooms"]:
    """Sum up the imitation loss of the last frames, each robot's nerves shifted for as long by shares of their size."""

    @partial(jax.checkpoint, prevent_cse=False)
    def frame(place: tuple[controller.Params, simulation.Room], state: simulation.State, _: None):
        late = FRAMES - state.frame <= horizon
        nerves = jax.tree.map(
            lambda leaf, dx, size: leaf + jnp.where(late, dx, 0.0) * size, robot.controller, place[0], sizes
        )
        own = replace(robot, controller=nerves)
        after, record = simulation.step(own, model, place[1], state, drivers.LEARNED)
        return after, jnp.where(late, jnp.mean((record.velocity - record.label) ** 2), 0.0)

    start = jax.vmap(lambda room: simulation.init(robot, model, room, drivers.LEARNED))(rooms)
    _, errors = rollout.march(frame, (shift, rooms), start, length=FRAMES)
    return jnp.sum(errors, axis=1) / horizon


@figures.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw norm and disagreement against the horizon; rows as in horizon.json."""
    figure = Figure(figsize=(figures.WIDTH, 2.8), layout="constrained")
    norm, agreement = figure.subplots(1, 2)
    colours = {"hard": figures.LEFT, "soft": figures.RIGHT}
    for contact, colour in colours.items():
        double, single = (
            _table([row for row in rows if row["contact"] == contact and row["precision"] == precision])
            for precision in PRECISIONS
        )
        horizons = sorted(double)
        sizes = np.array([[row["norm"] for row in double[h]] for h in horizons])
        norm.plot(horizons, np.median(sizes, axis=1), "o-", color=colour, markersize=3, label=contact)
        norm.fill_between(horizons, sizes.min(axis=1), sizes.max(axis=1), color=colour, alpha=0.15)
        kinds = {
            "reverse - forward": ("-", double, "forward"),
            "reverse - differences": ("--", double, "difference"),
            "reverse - forward, float32": (":", single, "forward"),
        }
        for name, (style, table, other) in kinds.items():
            apart = [_apart(table[h], other) for h in horizons]
            agreement.plot(horizons, apart, style, color=colour, label=name if contact == "hard" else None)
    norm.set(xscale="log", yscale="log", xlabel="horizon [frames]", ylabel="norm of the gradient")
    norm.legend()
    agreement.set(xscale="log", yscale="log", xlabel="horizon [frames]", ylabel="disagreement of the slope")
    agreement.legend()
    return figure


def _table(rows: Sequence[Mapping[str, Any]]) -> dict[int, list[Mapping[str, Any]]]:
    table: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        table.setdefault(row["horizon"], []).append(row)
    return table


def _apart(rows: Sequence[Mapping[str, Any]], other: str) -> float:
    """Take the median over robots of |a - b| / (|a| + |b|), a the slope by reverse mode."""
    pairs = [(row["slope"], row[other]) for row in rows]
    return float(np.median([abs(a - b) / max(abs(a) + abs(b), 1e-30) for a, b in pairs])) + 1e-17
