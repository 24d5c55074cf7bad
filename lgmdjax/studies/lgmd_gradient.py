"""What would a detector fitted by gradient be like? T_s, T_f, W_I and w_I, by the imitation loss of recorded walks.

The thresholds are chosen by what u tells of nearness and W_I on a grid (`lgmdjax.learning.lgmd_grid_search`), and w_I
is the paper's. Here all of them follow the derivative of what they are there for: the loss of the navigator that
listens to them (`lgmdjax.learning.lgmd_gradient_fit`). From one start, with as many steps each, are fitted

| method     | what                                                                        |
| ---------- | --------------------------------------------------------------------------- |
| calibrated | nothing: the calibrated detector, and a navigator that learned to listen    |
| navigator  | the navigator alone, on and on: the control                                 |
| detector   | the detector alone                                                          |
| both       | both                                                                        |

A start has its own split of the rooms, its own order of the walks, and a navigator of its own, which learned from the
walks that are fitted to, and is not made to turn harder than its teacher. Its constants, mean and deviation of the
calibrated u, stay what they are: a navigator that is held must be spoken to as it was, and one that learns along can
do with the first layer's weights and biases whatever other constants would.

A quarter of the rooms is kept back; half of it chooses the step that a fit ends with, half judges. All that is told of
a walk is of hard steps, as on the robot, and of eyes like those that the run's navigator learned with.

| told     | meaning                                                                              |
| -------- | ------------------------------------------------------------------------------------ |
| mse      | of the command, nominal^2, mean over both sides                                      |
| steering | correlation of the turns commanded with those of the labels                          |
| nearness | of left minus right u with left minus right nearness, as `lgmdjax.learning.lgmd_grid_search` does |

Writes detector.json, a row a method and start: curve, what is told of walks fitted to and of those judged by, and the
detector's constants, w_I with the sum that eq. 9 has.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm import tqdm

from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning, dagger, lgmd_gradient_fit, lgmd_grid_search
from lgmdjax.learning.lgmd_gradient_fit import Cells, Pilot
from lgmdjax.learning.settings import LgmdGradientSettings
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, episodes, rerender, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, Leaf
from lgmdjax.simulation.episodes import Walk

METHODS: Mapping[str, tuple[str, ...]] = {
    "calibrated": (),
    "navigator": ("navigator",),
    "detector": ("detector",),
    "both": ("detector", "navigator"),
}
COLOURS = {"calibrated": style.INK, "navigator": style.QUIET, "detector": style.LEFT, "both": style.RIGHT}
ALIKE, AKIN = 0.01, 0.4  # most that u may differ, as a share of its spread: drawn with the same eyes, with others


def work(folder: Path, inputs: Mapping[str, Path], settings: LgmdGradientSettings, seed: int) -> None:
    """Draw walks of a run again, and fit by every method from every start; what was fitted before is kept."""
    recorded = dagger.recorded_by(inputs)
    robot = assembly.trained(inputs["fit-gait"], inputs["train"])
    lesson = CameraSettings(**episodes.parameters(inputs["collect"] / "episodes")["eyes"])
    walks, cells = look(robot, pick(recorded, settings, seed), lesson)
    rows = []
    for start in range(settings.seeds):
        rows += compare(folder, robot.controller.lgmd, walks, cells, settings, start, seed + start)
    storage.write_json(folder / "lgmd_gradient.json", rows)


def pick(recorded: Sequence[Walk], settings: LgmdGradientSettings, seed: int) -> list[tuple[int, list[Walk]]]:
    """Cut a part anywhere out of some walks drawn at random: as many of every episode, and all equally long.

    Returns:
        For each episode how many robots walked in it, and the parts.
    """
    generator, crowds = np.random.default_rng(seed), dict[int, list[Walk]]()
    for walk in recorded:
        crowds.setdefault(walk.episode, []).append(walk)
    frames = min(round(settings.seconds * FRAME_RATE), *map(len, recorded))
    each = max(round(settings.minutes * 60 * FRAME_RATE / frames / len(crowds)), 1)
    picked = []
    for crowd in crowds.values():
        some = [crowd[k] for k in generator.permutation(len(crowd))[:each]]
        firsts = [int(generator.integers(len(walk) - frames + 1)) for walk in some]
        picked.append((len(crowd), [walk[k : k + frames] for walk, k in zip(some, firsts, strict=True)]))
    return picked


def look(
    robot: closed_loop.Params, picked: Sequence[tuple[int, list[Walk]]], lesson: CameraSettings
) -> tuple[list[Walk], Cells]:
    """Draw parts of walks again with the eyes of a robot; give them, with the u of those, and what the cells saw.

    Args:
        picked: as `pick` gives them. Room i of n of an episode is the i-th of `crew.rooms_of(seed, episode, n)`.
        lesson: the eyes with which the teacher walked; the navigator had those of the robot.

    Raises InputError if that is not what the robots saw.
    """
    walks, parts = list[Walk](), []
    detector = robot.controller.lgmd
    same = assembly.eyes(lesson) == robot.camera and lesson.pooling == detector.pooling
    for robots, crowd in tqdm(picked, desc="drawing", unit="episode"):
        episode, numbers = crowd[0].episode, np.array([walk.room % robots for walk in crowd])
        rooms = room_batches.rooms_of(crowd[0].seed, episode, robots).arena
        record = episodes.batched(crowd)
        pictures = rerender.walks(robot.camera, jax.tree.map(lambda leaf, of=numbers: leaf[of], rooms), record)
        parts.append(lgmd_gradient_fit.changes(np.asarray(_pooled(detector, pictures)), record.fresh))
        u = np.asarray(lgmd_gradient_fit.watch(detector, parts[-1]))
        require_same(crowd, u, ALIKE if same or episode >= dagger.OWN_WALKS else AKIN)
        walks += [replace(walk, u=own) for walk, own in zip(crowd, u, strict=True)]
    return walks, jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def require_same(walks: Sequence[Walk], u: Float[np.ndarray, "walks frames 2"], most: float) -> None:
    """Raise `InputError` if u differs from what was recorded by more than so much of its spread (rms)."""
    record = episodes.batched(walks)
    sound = np.asarray(record.ok)[:, 2:]  # the first two frames of a part are not those of the whole walk
    known = np.asarray(record.u)[:, 2:][sound]
    apart = float(np.sqrt(np.mean((u[:, 2:][sound] - known) ** 2)) / max(known.std(), 1e-9))
    if not apart <= most:
        raise InputError(
            f"episode {walks[0].episode}: expected to draw again what the robots saw, got u that differ from theirs by "
            f"{apart:.3f} of their spread, at most {most} would do; use the version of lgmdjax that recorded the walks"
        )


def compare(
    folder: Path, detector: lgmd.Params, walks: Sequence[Walk], cells: Cells, settings: LgmdGradientSettings,
    start: int, seed: int,
) -> list[dict[str, Any]]:  # fmt: skip
    """Fit by every method from one start, a file each, and give what is in the files."""
    places = [folder / f"{method}-{start}.json" for method in METHODS]
    if not all(place.exists() for place in places):
        shown, choice, test = (_of(part, walks, cells) for part in dagger.split(walks, seed))
        pilot = Pilot(detector=detector, navigator=learned(shown[0], choice[0], settings, seed))
        film = lgmd_gradient_fit.film(*shown, settings.streams, settings.window, np.random.default_rng(seed))

        def judge(pilot: Pilot) -> dict[str, float]:
            return {name: score(pilot, *some)["mse"] for name, some in (("choice", choice), ("test", test))}

        for (method, names), place in zip(METHODS.items(), places, strict=True):
            began = time.monotonic()
            best, curve = lgmd_gradient_fit.fit(pilot, film, names, settings, judge, f"{method}, start {start}")
            row = {"method": method, "start": start, "seconds": time.monotonic() - began, "curve": curve}
            told = {"train": score(best, *shown), "test": score(best, *test)}
            storage.write_json(place, row | told | {"detector": constants(best.detector)})
    return [storage.read_json(place) for place in places]


def learned(train: Sequence[Walk], test: Sequence[Walk], settings: LgmdGradientSettings, seed: int) -> navigator.Params:
    """Fit a navigator to the calibrated u, the best of its epochs by walks kept back."""
    epochs = behaviour_cloning.Settings(epochs=settings.epochs)
    start = navigator.create(jax.random.key(seed))
    return behaviour_cloning.fit(start, episodes.stretches(train), episodes.stretches(test), epochs).best


def score(pilot: Pilot, walks: Sequence[Walk], cells: Cells) -> dict[str, float]:
    """Tell how well a pilot does on walks, with hard steps: mse, steering, nearness."""
    u = np.asarray(lgmd_gradient_fit.watch(pilot.detector, cells))
    seen = [replace(walk, u=own) for walk, own in zip(walks, u, strict=True)]
    found = behaviour_cloning.score(pilot.navigator, episodes.stretches(seen))
    nearness = lgmd_grid_search.follow(episodes.batched(seen))["score"]
    return {"mse": found["mse"], "steering": found["steering"], "nearness": nearness}


def constants(detector: lgmd.Params) -> dict[str, Any]:
    """List what a detector came to."""
    detector = lgmd_gradient_fit.normal(detector)
    return {name: float(getattr(detector, name)) for name in lgmd_gradient_fit.SCALARS} | {
        "kernel": np.asarray(detector.kernel).tolist()
    }


@jax.jit
def _pooled(detector: lgmd.Params, pictures: Float[Leaf, "walks frames 2 height columns"]) -> Array:
    pool = jax.vmap(jax.vmap(partial(lgmd.pool, detector)))
    return jax.lax.map(pool, jnp.asarray(pictures))


def _of(part: Sequence[Walk], walks: Sequence[Walk], cells: Cells) -> tuple[Sequence[Walk], Cells]:
    """Pick what the cells saw on some of the walks; a room is walked in once."""
    numbers = {walk.room: k for k, walk in enumerate(walks)}
    these = np.array([numbers[walk.room] for walk in part])
    return part, jax.tree.map(lambda leaf: leaf[these], cells)


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw error against steps, what is told of the walks judged by, and the kernels; rows as in detector.json."""
    figure = Figure(figsize=(style.WIDTH, 4.8), layout="constrained")
    panels: dict[str, Axes] = figure.subplot_mosaic("""
        eeemsn
        ccddbb
    """)
    _curves(panels["e"], rows)
    for name in ("mse", "steering", "nearness"):
        _bars(panels[name[0]], rows, name)
    for method in ("calibrated", "detector", "both"):
        _kernel(panels[method[0]], [row["detector"] for row in rows if row["method"] == method], method)
    return figure


def _curves(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the error on walks judged by, as a share of what it was at the start."""
    for row in rows:
        curve = np.array([[point["step"], point["test"]] for point in row["curve"]])
        label = row["method"] if row["start"] == 0 else None
        if len(curve) > 1:
            axes.plot(curve[:, 0], curve[:, 1] / curve[0, 1], color=COLOURS[row["method"]], linewidth=1, label=label)
    axes.axhline(1, color=COLOURS["calibrated"], linewidth=0.8, label="calibrated")
    axes.set(xlabel="step", ylabel="error in rooms kept back,\nas a share of the calibrated one's")
    axes.legend()


def _bars(axes: Axes, rows: Sequence[Mapping[str, Any]], name: str) -> None:
    """Draw means over the starts, and every start as a dot."""
    for place, method in enumerate(METHODS):
        values = [row["test"][name] for row in rows if row["method"] == method]
        axes.bar(place, float(np.mean(values)), color=COLOURS[method], alpha=0.45, width=0.7)
        axes.plot(place + np.linspace(-0.2, 0.2, len(values)), values, ".", color=COLOURS[method], markersize=5)
    axes.set_xticks(range(len(METHODS)), METHODS, rotation=90)
    axes.grid(False, axis="x")
    axes.set(title={"mse": "error", "steering": "r, turns", "nearness": "r, nearness"}[name])


def _kernel(axes: Axes, found: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draw the mean kernel of the starts with its numbers, and say the other constants."""
    kernel = np.mean([one["kernel"] for one in found], axis=0)
    axes.imshow(kernel, cmap="Greys", vmin=0, vmax=0.6)
    for (row, column), weight in np.ndenumerate(kernel):
        colour = "white" if weight > 0.35 else style.INK
        axes.text(column, row, f"{weight:.2f}", ha="center", va="center", fontsize=6.5, color=colour)
    T_s, T_f, W_I = (
        "–".join(dict.fromkeys(f"{end([one[name] for one in found]):.2g}" for end in (min, max)))
        for name in lgmd_gradient_fit.SCALARS
    )
    axes.set_title(f"{title}\n$T_s$ {T_s}, $T_f$ {T_f}\n$W_I$ {W_I}", fontsize=7.5)
    axes.set_axis_off()
