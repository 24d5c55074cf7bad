"""Does the gradient through the closed loop teach what imitation of recorded walks cannot? Collisions by pupil.

Imitation of recorded walks leaves a navigator that does not know what its own commands lead to. DAgger
(`lgmdjax.learning.dagger`) lets it walk, labels the walks and fits it again; here its imitation loss is differentiated
through the walk itself (`lgmdjax.learning.finetuning`). From one navigator, fitted to a lesson of the teacher's, come

| pupil                | practice                                                                               |
| -------------------- | -------------------------------------------------------------------------------------- |
| imitation            | none                                                                                   |
| imitation, smooth    | none; its detectors have the smooth steps that it is tuned with: the control for those |
| dagger               | rounds of DAgger                                                                       |
| controller           | tuned, the derivative through nothing but the navigator                                |
| everything           | tuned, through everything                                                              |
| joint                | so, and shaping networks, T_s, T_f and W_I with it                                     |
| dagger + everything  | half of the rounds, then tuned for half as long                                        |
| everything, n frames | tuned through windows of n frames: the horizon                                         |

All practise for the same simulated time, tuned ones in as many rooms as there are rounds, with a rate that lets them
move as far in a second whatever their windows. DAgger fits again and again to all walks so far; a tune sees every
window once. While tuning, steps are smooth and contacts those of the XML; then all walk with hard steps, in rooms that
none of them knows.

Nobody's turns are scaled in the end (`training.enliven`): what is compared is what the imitation loss teaches. The
scale is measured on recorded walks, where a tuned navigator never went, and with it collisions are too rare to tell
pupils apart. Only while DAgger practises does its navigator walk with it, as it always does.

| told         | meaning                                                                                           |
| ------------ | ------------------------------------------------------------------------------------------------- |
| per_100_m    | collisions, with the exact interval                                                               |
| near         | approaches, nearer than `apprentice.TIGHT`, per 100 m: more frequent than collisions                |
| imitation    | mean of |v - v*|^2 over the walk, nominal^2                                                        |
| curve        | a number a window (`tuning.Row`), over the simulated time of all robots together [s]              |

If signal / noise is about 1, the mean gradient is what chance makes of the robots' differences.

Writes closed_loop.json, a row a pupil and start. A tune carries on from the last room that it was done with.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from tqdm import tqdm

from lgmdjax.body import hexapod
from lgmdjax.control import controller, policies
from lgmdjax.evaluation import metrics
from lgmdjax.learning import dagger, finetuning, rollout_gradient
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.locomotion import cpg
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.simulation import assembly, recording, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, Params, Record, Room, Through
from lgmdjax.studies.settings import FinetuneSettings

ROOMS = 2**21  # number of the first episode that robots are tuned in: rooms of their own
JOINT = ("driver", "shaping", "lgmd.threshold", "lgmd.suppression", "lgmd.inhibition")
BINS = 12  # of a curve that is drawn


class Way(NamedTuple):
    """How a pupil is tuned."""

    through: Through = "everything"
    parts: tuple[str, ...] = ("driver",)


WAYS = {"controller": Way(through="controller"), "everything": Way(), "joint": Way(parts=JOINT)}
COLOURS = {
    "imitation": style.INK,
    "imitation, smooth": style.QUIET,
    "dagger": style.PALETTE[2],
    "controller": style.PALETTE[4],
    "everything": style.PALETTE[0],
    "joint": style.PALETTE[1],
    "dagger + everything": style.PALETTE[3],
}


def work(folder: Path, inputs: Mapping[str, Path], settings: FinetuneSettings, seed: int) -> None:
    """Teach all pupils from every start, and score them on one bench."""
    robot = assembly.with_eyes(assembly.trained(inputs["fit-gait"], inputs["train"]), settings.bench.eyes)
    rows = []
    for start in range(settings.seeds):
        place = folder / f"start-{start}"
        horizons = () if start else settings.horizons
        for name, pupil, facts in pupils(place, robot, settings, seed + start, horizons):
            bench = place / "bench" / name.replace(" ", "-")
            record = recording.benched(
                bench, pupil, settings.bench, policies.LEARNED, seed, label=f"{name}, start {start}"
            )
            rows.append({"pupil": name, "start": start} | facts | detector(pupil) | told(record))
    storage.write_json(folder / "closed_loop_finetune.json", rows)


def pupils(
    folder: Path, robot: Params, settings: FinetuneSettings, seed: int, horizons: Sequence[int] = ()
) -> Iterator[tuple[str, Params, dict[str, Any]]]:
    """Yield the pupils of a start, one by one: name, robot, and how it was tuned, if it was."""
    school = settings.practice
    facts = {"school": asdict(school), "seconds": settings.lesson_seconds}
    walks = dagger.lesson(folder / "lesson", robot, school.robots, settings.lesson_seconds, seed, facts)

    def practised(rounds: int) -> Params:
        practice = replace(school, rounds=rounds)
        own = dagger.practise(folder / "dagger", robot, walks, practice, seed)
        place = folder / "checkpoints" / f"rounds-{rounds}"
        return assembly.manned(robot, dagger.learn(place, own, school.epochs, seed)[0])

    first = practised(0)
    yield "imitation", first, {}
    yield "imitation, smooth", rollout_gradient.smooth(first), {}
    yield "dagger", practised(school.rounds), {}
    for name, way in WAYS.items():
        yield name, *tuned(folder / name, first, settings, seed, way, settings.window, school.rounds)
    half = school.rounds // 2
    name = "dagger + everything"
    yield name, *tuned(folder / "half", practised(half), settings, seed, Way(), settings.window, school.rounds - half)
    for frames in horizons:
        place, name = folder / f"window-{frames}", f"everything, {frames} frames"
        yield name, *tuned(place, first, settings, seed, Way(), frames, school.rounds)


def tuned(
    folder: Path, pupil: Params, settings: FinetuneSettings, seed: int, way: Way, frames: int, rooms: int
) -> tuple[Params, dict[str, Any]]:
    """Tune a pupil while it walks; give the robot as it walks afterwards, its steps hard, and how it was tuned."""
    school, robot = settings.practice, rollout_gradient.smooth(rollout_gradient.alone(pupil))
    window = rollout_gradient.Settings(frames=frames, through=way.through, clip=settings.clip)
    how = finetuning.Settings(
        learning_rate=settings.learning_rate * frames / FRAME_RATE,
        windows=round(school.round_seconds * FRAME_RATE / frames),
        rooms=rooms,
        parts=way.parts,
    )
    belongs = {"window": asdict(window), "tuning": asdict(how), "robot": assembly.digest(robot), "seed": seed}
    print(f"{folder.name}: compiling the gradient of {frames} frames through {way.through}", flush=True)
    with closing(Checkpoints(folder, belongs)) as saved, tqdm(desc=folder.name, unit="window") as bar:

        def tell(row: finetuning.Row) -> None:
            bar.set_postfix(loss=f"{row.loss:.3f}")
            bar.update()

        there = partial(_rooms, seed, school.robots)
        after, rows = finetuning.tune(robot, hexapod.build(), there, window, how, saved=saved, tell=tell)
    curve = {name: list(column) for name, column in zip(finetuning.Row._fields, zip(*rows, strict=True), strict=True)}
    curve["seconds"] = [school.robots * frames / FRAME_RATE * (number + 1) for number in range(len(rows))]
    return aboard(pupil, after.controller), {"through": way.through, "frames": frames, "curve": curve}


def _rooms(seed: int, robots: int, number: int) -> Room:
    return room_batches.rooms_of(seed, ROOMS + number, robots)


def aboard(robot: Params, nerves: controller.Params) -> Params:
    """Put what was tuned into a robot that all five drivers are aboard of, whose steps stay what they are."""
    constants = {name: getattr(nerves.lgmd, name) for name in ("threshold", "suppression", "inhibition", "kernel")}
    detector = replace(robot.controller.lgmd, **constants)
    own = replace(robot.controller, lgmd=detector, cpg=nerves.cpg, shaping=nerves.shaping)
    return assembly.manned(replace(robot, controller=own), nerves.driver)


def detector(pupil: Params) -> dict[str, float]:
    """Tell the constants that a joint fit moves."""
    return {name: float(getattr(pupil.controller.lgmd, name)) for name in ("threshold", "suppression", "inhibition")}


def told(record: Record) -> dict[str, Any]:
    """Tell what is compared of a pupil's walks."""
    score, near = metrics.score(record, cpg.CYCLE_TIME), dagger.approaches(record)
    error = np.mean((np.asarray(record.velocity) - np.asarray(record.label)) ** 2, axis=-1)
    rate = asdict(metrics.poisson_rate(near, score.distance / 100))
    return asdict(score) | {"approaches": near, "near": rate, "imitation": float(error[np.asarray(record.ok)].mean())}


def pooled(rows: Sequence[Mapping[str, Any]], count: str) -> dict[str, metrics.Estimate]:
    """Count something per 100 m, the starts of each pupil together, in the order of the rows."""
    names = dict.fromkeys(row["pupil"] for row in rows)
    sums = {
        name: [sum(row[what] for row in rows if row["pupil"] == name) for what in (count, "distance")] for name in names
    }
    return {name: metrics.poisson_rate(times, way / 100) for name, (times, way) in sums.items()}


def trust(row: Mapping[str, Any]) -> Float[np.ndarray, " windows"]:
    """Divide signal by noise, window by window, where there is some of both."""
    signal, noise = (np.array(row["curve"][name], float) for name in ("signal", "noise"))
    sound = np.isfinite(signal) & (noise > 0)
    return signal[sound] / noise[sound]


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw what pupils touched and came near to, their loss while they were tuned, and how far to trust its slope."""
    figure = Figure(figsize=(style.WIDTH, 5.6), layout="constrained")
    (touched, near), (loss, ratio) = figure.subplots(2, 2)
    _rates(touched, rows, "collisions", "per_100_m")
    touched.set(xlabel="collisions per 100 m")
    _rates(near, rows, "approaches", "near")
    near.set(xlabel=f"nearer than {100 * dagger.TIGHT:g} cm, times per 100 m")
    near.set_yticklabels([])
    curves = [row for row in rows if "curve" in row]
    for name in dict.fromkeys(row["pupil"] for row in curves if row["pupil"] in COLOURS):
        some = [row["curve"] for row in curves if row["pupil"] == name]
        time, value = (np.mean([_binned(curve[what]) for curve in some], axis=0) for what in ("seconds", "loss"))
        loss.plot(time / 60, value, color=COLOURS[name], label=name)
    loss.set(xlabel="simulated robot-minutes", ylabel="imitation loss of a window")
    loss.legend()
    for row in (row for row in curves if trust(row).size):
        low, middle, high = np.quantile(trust(row), (0.25, 0.5, 0.75))
        place = row["frames"] * 1.05 ** (list(COLOURS).index(_base(row["pupil"])) - 4)  # beside, not upon each other
        ratio.plot([place, place], [low, high], color=_colour(row["pupil"]), alpha=0.5)
        ratio.plot([place], [middle], "o", color=_colour(row["pupil"]), markersize=4.5)
    ratio.axhline(1.0, color=style.QUIET, linewidth=1, linestyle=":")
    ratio.set(xscale="log", xlabel="horizon [frames]", ylabel="signal / noise of the gradient", ylim=(0, None))
    frames = sorted({row["frames"] for row in curves})
    ratio.set_xticks(frames, list(map(str, frames)))
    ratio.xaxis.set_minor_locator(NullLocator())
    return figure


def _rates(axes: Axes, rows: Sequence[Mapping[str, Any]], count: str, rate: str) -> None:
    """Draw rates by pupil: the starts together with their interval, and each start a dot."""
    together = pooled(rows, count)
    for y, (name, whole) in enumerate(together.items()):
        axes.plot([whole.low, whole.high], [y, y], color=_colour(name), linewidth=1.6, alpha=0.6)
        axes.plot([whole.value], [y], "|", color=_colour(name), markersize=11, markeredgewidth=2)
        each = [row[rate]["value"] for row in rows if row["pupil"] == name]
        axes.plot(each, [y] * len(each), "o", color=_colour(name), markersize=3.5, clip_on=False, zorder=3)
    axes.set_yticks(range(len(together)), list(together))
    axes.set(ylim=(len(together) - 0.5, -0.5), xlim=(0, None))
    axes.grid(False, axis="y")


def _base(name: str) -> str:
    return name if name in COLOURS else name.partition(", ")[0]


def _colour(name: str) -> str:
    return COLOURS[_base(name)]


def _binned(column: Sequence[float]) -> Float[np.ndarray, " bins"]:
    """Average a curve in bins of equal length; nan where nothing of a bin is finite."""
    bins = np.array_split(np.array(column, float), min(BINS, len(column)))
    return np.array([np.mean(some[np.isfinite(some)]) if np.isfinite(some).any() else np.nan for some in bins])
