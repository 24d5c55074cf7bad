"""How far may eyes, room, legs and data be from those that were chosen? One thing is changed at a time.

The navigator is not taught again: this is what becomes of it when it is moved to another camera or robot. Only for the
amount of data pupils learn anew, from parts of the walks that the run recorded.

| axis       | changed                                                                             |
| ---------- | ----------------------------------------------------------------------------------- |
| T_s        | threshold of the detector                                                           |
| T_f        | threshold of its gate, as a multiple of the chosen one                              |
| overlap    | share of its picture that each eye looks at                                         |
| pixels     | of a picture's width, with cells of the same size in degrees                         |
| cell       | pixels of a picture of the bench's size that a cell looks at, a side                |
| rate       | pictures a second                                                                   |
| contrast   | of all textures, as a multiple                                                      |
| sway       | of the head, as a multiple of the trunk's                                           |
| minutes    | of walking that a pupil learns from, in all rooms                                   |
| rooms      | that a pupil learns from, for the same time                                         |

Writes sensitivity.json, a row a value: axis, value, whether it is the chosen one, and the score.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.control import navigator, policies
from lgmdjax.evaluation import metrics
from lgmdjax.learning import behaviour_cloning, dagger
from lgmdjax.locomotion import cpg
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import compiled_code, storage
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, episodes, recording
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episodes import Walk
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies.settings import SensitivitySettings

THRESHOLDS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # grey, and the chosen one
SUPPRESSIONS = (0.1, 0.2, 0.4, 0.7, 1.0, 2.0)
OVERLAPS = (0.5, 0.6, 0.7, 0.8, 1.0)
SIZES = ((54, 40, 2), (80, 60, 3), (160, 120, 6), (320, 240, 12))  # width, height, pixels a cell
CELLS = (1, 2, 3, 4, 6)
EVERY = (1, 2, 3, 4)  # frames from one picture to the next
CONTRASTS = (0.25, 0.5, 0.75, 1.0, 1.25)
SWAYS = (0.0, 1.0, 2.0, 4.0)
MOST = 60.0  # collisions per 100 m that are drawn; more is an arrow
SHORTEST = 30  # frames of a stretch that is cut
SHARES = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)  # of the minutes recorded
LONGEST = 10  # times the epochs of a fit to everything, for fits to less
ROOMS = (8, 16, 32, 64, 128)
AXES = {
    "T_s": "T_s [grey]",
    "T_f": "T_f, as a multiple of the chosen",
    "overlap": "share of the picture that each eye looks at",
    "pixels": "width of a picture [px], cells the same",
    "cell": "side of a cell [px of a bench picture]",
    "rate": "pictures a second",
    "contrast": "contrast of all textures, as a multiple",
    "sway": "sway of the head, as a multiple",
    "minutes": "minutes learned from",
    "rooms": "rooms learned from, in the same time",
}


def work(folder: Path, inputs: Mapping[str, Path], settings: SensitivitySettings, seed: int) -> None:
    """Score the robot with every change, and every pupil."""
    robot = assembly.with_eyes(assembly.trained(inputs["fit-gait"], inputs["train"]), settings.bench.eyes)
    recorded = dagger.recorded_by(inputs)  # before hours of walking
    frames = sum(map(len, episodes.stretches(recorded)))
    rows, chosen = [], settled(robot, settings.bench.eyes)
    for _, same in groupby(changes(robot, settings.bench.eyes), key=itemgetter(0)):
        for axis, value, changed, contrast in same:
            rows.append(_score(folder, changed, settings.bench, seed, axis, value, contrast=contrast))
        compiled_code.let_go()  # other eyes have their own
    for axis, value, walks in lessons(recorded, seed):
        epochs = fair(settings.epochs, frames, sum(map(len, walks)))
        for start in range(settings.seeds):
            place = folder / "pupils" / f"{axis}-{value:g}-{start}"
            pupil = assembly.manned(robot, _fit(place, walks, epochs, seed + start))
            rows.append(_score(folder, pupil, settings.bench, seed, axis, value, start=start))
        compiled_code.let_go()  # and so has each amount of data
    rows = [row | {"chosen": row["value"] == chosen.get(row["axis"])} for row in rows]
    storage.write_json(folder / "sensitivity.json", rows)


def settled(robot: closed_loop.Params, eyes: CameraSettings) -> dict[str, float]:
    """Name the value of each axis that the robot of a bench has by itself."""
    threshold = round(float(robot.controller.lgmd.threshold), 6)  # as it was before it became a float32
    own = {"T_s": threshold, "overlap": eyes.overlap, "pixels": eyes.width, "cell": eyes.pooling, "rate": FRAME_RATE}
    return own | dict.fromkeys(("T_f", "contrast", "sway"), 1.0)


def changes(robot: closed_loop.Params, eyes: CameraSettings) -> Iterator[tuple[str, float, closed_loop.Params, float]]:
    """Yield (axis, value, robot, contrast of the rooms) for everything that is changed without teaching."""
    detector = robot.controller.lgmd

    def seeing(**constants: Any) -> closed_loop.Params:
        return replace(robot, controller=replace(robot.controller, lgmd=replace(detector, **constants)))

    for threshold in sorted({*THRESHOLDS, settled(robot, eyes)["T_s"]}):
        yield "T_s", threshold, seeing(threshold=jnp.asarray(threshold, float)), 1.0
    for factor in SUPPRESSIONS:
        yield "T_f", factor, seeing(suppression=factor * detector.suppression), 1.0
    for overlap in OVERLAPS:
        yield "overlap", overlap, assembly.with_eyes(robot, replace(eyes, overlap=overlap)), 1.0
    for width, height, pooling in SIZES:
        other = replace(eyes, width=width, height=height, pooling=pooling)
        yield "pixels", width, assembly.with_eyes(robot, other), 1.0
    for pooling in CELLS:
        yield "cell", pooling, assembly.with_eyes(robot, replace(eyes, pooling=pooling)), 1.0
    for frames in EVERY:
        yield "rate", FRAME_RATE / frames, replace(robot, every=jnp.asarray(frames, jnp.int32)), 1.0
    for contrast in CONTRASTS:
        yield "contrast", contrast, robot, contrast
    for factor in SWAYS:
        yield "sway", factor, replace(robot, sway=jnp.asarray(factor, float)), 1.0


def lessons(walks: Sequence[Walk], seed: int) -> Iterator[tuple[str, float, list[Walk]]]:
    """Yield (axis, value, stretches to learn from) for parts of what was recorded, drawn at random.

    All that learn from a number of rooms get the same time: as much as the fewest rooms have.
    """
    generator = np.random.default_rng(seed)
    stretches = episodes.stretches(walks)
    stretches = [stretches[k] for k in generator.permutation(len(stretches))]
    frames = sum(map(len, stretches))
    for share in SHARES:
        some = _evenly(stretches, round(share * frames), generator)
        yield "minutes", share * frames / FRAME_RATE / 60, some
    rooms = generator.permutation(sorted({stretch.room for stretch in stretches}))
    few = {count: set(rooms[:count].tolist()) for count in ROOMS if count <= len(rooms)}
    shown = {count: [stretch for stretch in stretches if stretch.room in some] for count, some in few.items()}
    least = min((sum(map(len, some)) for some in shown.values()), default=0)
    for count, some in shown.items():
        yield "rooms", count, _evenly(some, least, generator)


def fair(epochs: int, frames: int, shown: int) -> int:
    """Let a fit that is shown less take as many steps as one to everything: more epochs, but not without end."""
    return round(epochs * min(frames / shown, LONGEST))


def _cut(stretches: Sequence[Walk], frames: int, generator: np.random.Generator) -> list[Walk]:
    """Take stretches until there are so many frames; of the last one a part anywhere in it.

    Its beginning would be of a robot just put down, with little near.
    """
    starts = np.cumsum([0, *map(len, stretches)]).tolist()
    cut = []
    for start, stretch in zip(starts, stretches, strict=False):
        left = frames - start
        if left >= max(min(SHORTEST, frames), 1):
            first = int(generator.integers(max(len(stretch) - left, 0) + 1))
            cut.append(stretch[first : first + left])
    return cut


def _evenly(stretches: Sequence[Walk], frames: int, generator: np.random.Generator) -> list[Walk]:
    """Take as many frames of every room, as far as there are, until there are so many in all."""
    rooms: dict[int, list[Walk]] = {}
    for stretch in stretches:
        rooms.setdefault(stretch.room, []).append(stretch)
    left, chosen = frames, []
    for number, some in enumerate(sorted(rooms.values(), key=lambda some: sum(map(len, some)))):
        share = min(left // (len(rooms) - number), sum(map(len, some)))
        chosen += _cut(some, share, generator)
        left -= share
    return chosen


def _fit(folder: Path, walks: list[Walk], epochs: int, seed: int) -> navigator.Params:
    """Fit a pupil; the last eighth of every stretch chooses the best epoch, since a few rooms cannot be parted."""
    train = [walk[: max(7 * len(walk) // 8, 1)] for walk in walks]
    test = [walk[7 * len(walk) // 8 :] for walk in walks]
    start, settings = navigator.create(jax.random.key(seed)), behaviour_cloning.Settings(epochs=epochs)
    return behaviour_cloning.enliven(behaviour_cloning.fit(start, train, test, settings, checkpoints=folder).best, test)


def _score(
    folder: Path, robot: closed_loop.Params, bench: BenchmarkRooms, seed: int, axis: str, value: float, *,
    contrast: float = 1.0, **facts: Any,
) -> dict[str, Any]:  # fmt: skip
    name = "-".join(f"{x:g}" if isinstance(x, float) else str(x) for x in (axis, float(value), *facts.values()))
    record = recording.benched(
        folder / "walks" / name, robot, bench, policies.LEARNED, seed, label=name, contrast=contrast
    )
    return {"axis": axis, "value": value, **facts} | asdict(metrics.score(record, cpg.CYCLE_TIME))


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw collisions per 100 m against every axis, with intervals, and the speed; the chosen value is ringed."""
    axes_of = [axis for axis in AXES if any(row["axis"] == axis for row in rows)]
    figure = Figure(figsize=(style.WIDTH, 0.4 + 1.75 * ((len(axes_of) + 1) // 2)), layout="constrained")
    panels = np.ravel(figure.subplots((len(axes_of) + 1) // 2, 2, sharey=True))
    for number, (panel, axis) in enumerate(zip(panels, axes_of, strict=False)):
        some = [row for row in rows if row["axis"] == axis]
        positions = {value: place for place, value in enumerate(sorted({row["value"] for row in some}))}
        x = np.array([positions[row["value"]] + 0.12 * row.get("start", 0) for row in some])
        _speeds(panel, x, some, labelled=number % 2 == 1)
        _rates(panel, x, some)
        panel.set_xticks(list(positions.values()), [f"{value:.3g}" for value in positions])
        panel.set(xlabel=AXES[axis])
        panel.grid(False, axis="x")
    for panel in panels[len(axes_of) :]:
        panel.remove()
    panels[0].set_ylim(0, min(panels[0].get_ylim()[1], MOST))
    figure.supylabel("collisions per 100 m", fontsize=8.5, color=style.LEFT)
    return figure


def _rates(panel: Axes, x: np.ndarray, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw rates with their intervals; arrows stand for more than fits."""
    rates = np.array([[row["per_100_m"][key] for key in ("value", "low", "high")] for row in rows])
    look = {"color": style.LEFT, "clip_on": False, "zorder": 3}
    panel.vlines(x, rates[:, 1], rates[:, 2], color=style.LEFT, alpha=0.45, linewidth=1.6)
    for there, marker in ((rates[:, 0] <= MOST, "o"), (rates[:, 0] > MOST, "^")):
        if there.any():  # the layout has no place for a line without points
            panel.plot(x[there], np.minimum(rates[there, 0], MOST), marker, markersize=4, **look)
    ringed = np.array([row["chosen"] for row in rows])
    if ringed.any():
        panel.plot(
            x[ringed], rates[ringed, 0], "o", markersize=9, markerfacecolor="none", color=style.INK, clip_on=False
        )


def _speeds(panel: Axes, x: np.ndarray, rows: Sequence[Mapping[str, Any]], *, labelled: bool) -> None:
    """Draw the speed behind: a robot that turns all the time touches nothing, and gets nowhere."""
    speeds = panel.twinx()
    speeds.plot(x, [100 * row["speed"] for row in rows], "_", color=style.INK, markersize=9, alpha=0.6)
    speeds.set(ylim=(0, 10), ylabel="speed [cm/s]" if labelled else "")
    speeds.tick_params(right=labelled, labelright=labelled)
    speeds.grid(False)
