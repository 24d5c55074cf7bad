"""How much may camera, detector, room, body and training data differ from the baseline? One parameter at a time.

The navigator is not trained again: the study measures how well it works with another camera or robot. Learners are
trained only if the parameter is the amount of data, on parts of the walks that the run recorded.

| parameter  | meaning                                                                             |
| ---------- | ----------------------------------------------------------------------------------- |
| T_s        | threshold of the detector                                                           |
| T_f        | threshold of its feed-forward inhibition, as a multiple of the calibrated one        |
| overlap    | share of the picture's width that each detector sees                                |
| ground     | share of the picture's height, at the bottom, that no detector sees                 |
| falloff    | exponent of the weights of a detector's cells to the side of the robot's path       |
| pixels     | width of a picture; cells keep their size in degrees                                |
| cell       | side of a cell, in pixels of a benchmark picture                                    |
| rate       | pictures per second                                                                 |
| contrast   | contrast of all textures, as a multiple                                             |
| sway       | sway of the head, as a multiple of the trunk's                                      |
| minutes    | duration of the training data, from all rooms                                       |
| rooms      | number of rooms in the training data, at the same duration                          |

Writes sensitivity.json, a row for each value: parameter, value, whether it is the baseline, and the score.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.control import navigator, policies
from lgmdjax.evaluation import metrics
from lgmdjax.learning import behaviour_cloning, dagger
from lgmdjax.locomotion import cpg
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import compiled_code, storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors.settings import Resolution
from lgmdjax.simulation import assembly, closed_loop, episodes, recording
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episodes import Walk
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies.settings import SensitivitySettings

THRESHOLDS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # grey; the calibrated one is added
SUPPRESSION_FACTORS = (0.1, 0.2, 0.4, 0.7, 1.0, 2.0)
FIELDS = {  # of the detectors
    "overlap": (0.5, 0.6, 0.7, 0.8, 1.0),
    "ground": (0.0, 0.25, 0.5, 0.6),
    "falloff": (0.0, 1.0, 2.0, 3.0),
}
PICTURE_SIZES = ((54, 40, 2), (80, 60, 3), (160, 120, 6), (320, 240, 12))  # width, height, side of a cell [px]
POOLINGS = (1, 2, 3, 4, 6)  # px, side of a cell
FRAME_INTERVALS = (1, 2, 3, 4)  # frames from one picture to the next
CONTRAST_FACTORS = (0.25, 0.5, 0.75, 1.0, 1.25)
SWAY_FACTORS = (0.0, 1.0, 2.0, 4.0)
RATE_LIMIT = 60.0  # collisions per 100 m, top of the figure; higher rates become arrows
MIN_SEGMENT = 30  # minimum number of frames of a cut segment
DATA_FRACTIONS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)  # of the recorded minutes
MAX_EPOCH_FACTOR = 10  # largest ratio of epochs, fits to less data over fits to all data
ROOM_COUNTS = (8, 16, 32, 64, 128)
PARAMETERS = {
    "T_s": "T_s [grey]",
    "T_f": "T_f, as a multiple of the calibrated",
    "overlap": "share of the picture for each detector",
    "ground": "share of the picture, at the bottom, for none",
    "falloff": "falloff of the weights to the side",
    "pixels": "width of a picture [px], same cells",
    "cell": "side of a cell [px of a benchmark picture]",
    "rate": "pictures per second",
    "contrast": "contrast of all textures, as a multiple",
    "sway": "sway of the head, as a multiple",
    "minutes": "minutes of training data",
    "rooms": "rooms in training data of equal duration",
}


class Variation(NamedTuple):
    """A robot with one parameter changed, and the rooms that it walks in."""

    parameter: str
    value: float
    robot: closed_loop.Params
    contrast: float = 1.0  # of all textures, as a multiple


def run(folder: Path, inputs: Mapping[str, Path], settings: SensitivitySettings, seed: int) -> None:
    """Score the robot with every variation, and every learner."""
    robot = assembly.with_resolution(assembly.load_robot(inputs["fit-gait"], inputs["train"]), settings.benchmark.eyes)
    recorded = dagger.read_all_walks(inputs)  # raises before hours of rollouts
    rows = []
    for _, same in groupby(variations(robot), key=attrgetter("parameter")):
        for changed in same:
            facts = {"parameter": changed.parameter, "value": changed.value}
            rows.append(_score(folder, changed.robot, settings.benchmark, seed, facts, contrast=changed.contrast))
        compiled_code.clear_caches_if_near_limit()  # each camera has its own programs
    rows += _score_learners(folder, robot, recorded, settings, seed)
    chosen = baseline(robot)
    rows = [row | {"is_baseline": row["value"] == chosen.get(row["parameter"])} for row in rows]
    storage.write_json(folder / "sensitivity.json", rows)


def _score_learners(
    folder: Path, robot: closed_loop.Params, recorded: Sequence[Walk], settings: SensitivitySettings, seed: int
) -> Iterator[JsonObject]:
    """Train a learner on every subset of the recorded walks with every random seed, and yield its row."""
    frames = sum(map(len, episodes.segments(recorded)))
    for parameter, value, walks in training_subsets(recorded, seed):
        epochs = matched_epochs(settings.epochs, frames, sum(map(len, walks)))
        for repeat in range(settings.seeds):
            checkpoints = folder / "learners" / f"{parameter}-{value:g}-{repeat}"
            learner = assembly.with_policy(robot, "learned", _fit(checkpoints, walks, epochs, seed + repeat))
            facts = {"parameter": parameter, "value": value, "repeat": repeat}
            yield _score(folder, learner, settings.benchmark, seed, facts)
        compiled_code.clear_caches_if_near_limit()  # each amount of data has its own programs


def baseline(robot: closed_loop.Params) -> dict[str, float]:
    """Return the value that each parameter has in the unchanged robot."""
    eyes = assembly.camera_settings(robot)
    threshold = round(float(robot.controller.detector.threshold), 6)  # undo the rounding to float32
    own = {
        "T_s": threshold,
        "overlap": eyes.overlap,
        "ground": eyes.ground,
        "falloff": eyes.falloff,
        "pixels": eyes.width,
        "cell": eyes.pooling,
        "rate": FRAME_RATE,
    }
    return own | dict.fromkeys(("T_f", "contrast", "sway"), 1.0)


def variations(robot: closed_loop.Params) -> Iterator[Variation]:
    """Yield the variations of all parameters that need no training."""
    detector, eyes = robot.controller.detector, assembly.camera_settings(robot)

    def with_lgmd(**constants: Array | float) -> closed_loop.Params:
        return replace(robot, controller=replace(robot.controller, detector=replace(detector, **constants)))

    for threshold in sorted({*THRESHOLDS, baseline(robot)["T_s"]}):
        yield Variation("T_s", threshold, with_lgmd(threshold=jnp.asarray(threshold, float)))
    for factor in SUPPRESSION_FACTORS:
        yield Variation("T_f", factor, with_lgmd(suppression=factor * detector.suppression))
    for name, values in FIELDS.items():
        for value in values:
            yield Variation(name, value, assembly.with_camera(robot, replace(eyes, **{name: value})))
    for width, height, pooling in PICTURE_SIZES:
        resolution = Resolution(width=width, height=height, pooling=pooling)
        yield Variation("pixels", width, assembly.with_resolution(robot, resolution))
    for pooling in POOLINGS:
        yield Variation("cell", pooling, assembly.with_camera(robot, replace(eyes, pooling=pooling)))
    for frames in FRAME_INTERVALS:
        yield Variation("rate", FRAME_RATE / frames, replace(robot, frame_stride=jnp.asarray(frames, jnp.int32)))
    for contrast in CONTRAST_FACTORS:
        yield Variation("contrast", contrast, robot, contrast)
    for factor in SWAY_FACTORS:
        yield Variation("sway", factor, replace(robot, head_sway=jnp.asarray(factor, float)))


def training_subsets(walks: Sequence[Walk], seed: int) -> Iterator[tuple[str, float, list[Walk]]]:
    """Yield (parameter, value, segments to train on) for random parts of the recorded walks.

    Subsets of different numbers of rooms have the same duration: all that the smallest number of rooms holds.
    """
    generator = np.random.default_rng(seed)
    segments = episodes.segments(walks)
    segments = [segments[k] for k in generator.permutation(len(segments))]
    frames = sum(map(len, segments))
    for fraction in DATA_FRACTIONS:
        subset = _balance_rooms(segments, round(fraction * frames), generator)
        yield "minutes", fraction * frames / FRAME_RATE / 60, subset
    rooms = generator.permutation(sorted({segment.room for segment in segments}))
    selected = {count: set(rooms[:count].tolist()) for count in ROOM_COUNTS if count <= len(rooms)}
    available = {count: [segment for segment in segments if segment.room in some] for count, some in selected.items()}
    least = min((sum(map(len, some)) for some in available.values()), default=0)
    for count, some in available.items():
        yield "rooms", count, _balance_rooms(some, least, generator)


def matched_epochs(epochs: int, frames: int, subset_frames: int) -> int:
    """Return the epochs with which a fit to a subset takes as many steps as a fit to all frames, within a limit.

    >>> matched_epochs(30, 8000, 2000)
    120
    """
    return round(epochs * min(frames / subset_frames, MAX_EPOCH_FACTOR))


def _take_frames(segments: Sequence[Walk], frames: int, generator: np.random.Generator) -> list[Walk]:
    """Take segments up to a total of `frames`; the last one is cut at a random place.

    If its beginning were always taken, it would show robots just after a reset, with few obstacles near.
    """
    starts = np.cumsum([0, *map(len, segments)]).tolist()
    taken = []
    for start, segment in zip(starts, segments, strict=False):
        left = frames - start
        if left >= max(min(MIN_SEGMENT, frames), 1):
            first = int(generator.integers(max(len(segment) - left, 0) + 1))
            taken.append(segment[first : first + left])
    return taken


def _balance_rooms(segments: Sequence[Walk], frames: int, generator: np.random.Generator) -> list[Walk]:
    """Take a total of `frames`, if possible equally many from each room."""
    rooms: dict[int, list[Walk]] = {}
    for segment in segments:
        rooms.setdefault(segment.room, []).append(segment)
    left, taken = frames, []
    for number, some in enumerate(sorted(rooms.values(), key=lambda some: sum(map(len, some)))):
        share = min(left // (len(rooms) - number), sum(map(len, some)))
        taken += _take_frames(some, share, generator)
        left -= share
    return taken


def _fit(folder: Path, walks: list[Walk], epochs: int, seed: int) -> navigator.Params:
    """Train a learner; the last eighth of every segment selects the best epoch, since a few rooms cannot be split."""
    train = [walk[: max(7 * len(walk) // 8, 1)] for walk in walks]
    test = [walk[7 * len(walk) // 8 :] for walk in walks]
    start, settings = navigator.create(jax.random.key(seed)), behaviour_cloning.Settings(epochs=epochs)
    fitted = behaviour_cloning.fit(start, train, test, settings, checkpoints=folder)
    return behaviour_cloning.rescale_turns(fitted.best, test)


def _score(
    folder: Path, robot: closed_loop.Params, benchmark: BenchmarkRooms, seed: int, facts: JsonObject, *,
    contrast: float = 1.0,
) -> JsonObject:  # fmt: skip
    """Record the robot in the benchmark rooms; return its row, which begins with `facts`."""
    name = "-".join(fact if isinstance(fact, str) else f"{fact:g}" for fact in facts.values())
    record = recording.record_benchmark(
        folder / "walks" / name, robot, benchmark, policies.LEARNED, seed, label=name, contrast=contrast
    )
    return facts | asdict(metrics.score(record, cpg.CYCLE_TIME))


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot collisions per 100 m with intervals, and the speed, against every parameter; the baseline is ringed."""
    shown = [parameter for parameter in PARAMETERS if any(row["parameter"] == parameter for row in rows)]
    figure = Figure(figsize=(style.WIDTH, 0.4 + 1.75 * ((len(shown) + 1) // 2)), layout="constrained")
    panels = np.ravel(figure.subplots((len(shown) + 1) // 2, 2, sharey=True))
    for number, (panel, parameter) in enumerate(zip(panels, shown, strict=False)):
        some = [row for row in rows if row["parameter"] == parameter]
        positions = {value: position for position, value in enumerate(sorted({row["value"] for row in some}))}
        x = np.array([positions[row["value"]] + 0.12 * row.get("repeat", 0) for row in some])
        _plot_speeds(panel, x, some, labelled=number % 2 == 1)
        _plot_rates(panel, x, some)
        panel.set_xticks(list(positions.values()), [f"{value:.3g}" for value in positions])
        panel.set(xlabel=PARAMETERS[parameter])
        panel.grid(False, axis="x")
    for panel in panels[len(shown) :]:
        panel.remove()
    panels[0].set_ylim(0, min(panels[0].get_ylim()[1], RATE_LIMIT))
    figure.supylabel("collisions per 100 m", fontsize=8.5, color=style.LEFT_COLOUR)
    return figure


def _plot_rates(panel: Axes, x: np.ndarray, rows: Sequence[JsonObject]) -> None:
    """Plot rates with their intervals; an arrow marks a rate above the limit."""
    rates = np.array([[row["per_100_m"][key] for key in ("value", "low", "high")] for row in rows])
    options = {"color": style.LEFT_COLOUR, "clip_on": False, "zorder": 3}
    panel.vlines(x, rates[:, 1], rates[:, 2], color=style.LEFT_COLOUR, alpha=0.45, linewidth=1.6)
    for selected, marker in ((rates[:, 0] <= RATE_LIMIT, "o"), (rates[:, 0] > RATE_LIMIT, "^")):
        if selected.any():  # constrained layout fails on a line without points
            panel.plot(x[selected], np.minimum(rates[selected, 0], RATE_LIMIT), marker, markersize=4, **options)
    ringed = np.array([row["is_baseline"] for row in rows])
    if ringed.any():
        ring = {"markersize": 9, "markerfacecolor": "none", "color": style.DARK, "clip_on": False}
        panel.plot(x[ringed], rates[ringed, 0], "o", **ring)


def _plot_speeds(panel: Axes, x: np.ndarray, rows: Sequence[JsonObject], *, labelled: bool) -> None:
    """Plot the speed behind the rates: a robot that turns all the time collides with nothing and makes no progress."""
    speeds = panel.twinx()
    speeds.plot(x, [100 * row["speed"] for row in rows], "_", color=style.DARK, markersize=9, alpha=0.6)
    speeds.set(ylim=(0, 10), ylabel="speed [cm/s]" if labelled else "")
    speeds.tick_params(right=labelled, labelright=labelled)
    speeds.grid(False)
