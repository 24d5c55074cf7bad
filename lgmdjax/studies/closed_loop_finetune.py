"""Does finetuning in the closed loop reduce collisions more than DAgger does? Collisions per learner.

Behaviour cloning on recorded walks leaves a navigator that does not know the effects of its own commands. DAgger
(`lgmdjax.learning.dagger`) records the navigator's own walks, labels them and fits it again. Finetuning differentiates
the imitation loss through the walk itself (`lgmdjax.learning.finetuning`). All learners begin with one navigator,
fitted to demonstrations of the teacher:

| learner              | training                                                                                  |
| -------------------- | ----------------------------------------------------------------------------------------- |
| imitation            | none beyond the demonstrations                                                            |
| imitation, smooth    | none; its detectors have the smooth thresholds of finetuning: the control for those        |
| dagger               | rounds of DAgger                                                                          |
| controller           | finetuned, the gradient taken through the navigator only                                  |
| everything           | finetuned, the gradient taken through everything                                          |
| joint                | like everything, and shaping networks, T_s, T_f and W_I are trained too                   |
| dagger + everything  | half of the DAgger rounds, then finetuned for half as long                                |
| everything, n frames | finetuned through windows of n frames: the horizon                                        |

All train for the same simulated time. Finetuned learners walk in as many rooms as there are rounds. Their learning rate
is proportional to the window, so that parameters can change equally much per simulated second. DAgger fits to all walks
so far in every round; finetuning uses every window once, with smooth thresholds and the contacts of the XML. All
learners are then evaluated with hard thresholds, in held-out rooms.

The turns are not rescaled (`behaviour_cloning.rescale_turns`), because the study compares what the imitation loss
teaches. The turn gain is measured on recorded walks, which differ from those of a finetuned navigator, and with it
collisions are too rare to compare learners. The navigator walks with it only during the rounds of DAgger.

| metric               | meaning                                                                                   |
| -------------------- | ----------------------------------------------------------------------------------------- |
| per_100_m            | collisions, with the exact interval                                                       |
| approaches_per_100_m | approaches closer than `dagger.APPROACH_CLEARANCE`: more frequent than collisions          |
| imitation            | mean of |v - v*|^2 over the walk, nominal^2                                                |
| curve                | `finetuning.WindowStats` of each window, against the simulated time of all robots [s]      |

A signal / noise of about 1 means that the robots' mean gradient is indistinguishable from sampling noise.

Writes closed_loop_finetune.json, a row for each learner and seed. An interrupted finetuning resumes after its last
finished room.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from tqdm.auto import tqdm

from lgmdjax.control import controller, policies
from lgmdjax.detectors import lgmd
from lgmdjax.evaluation import metrics
from lgmdjax.learning import dagger, finetuning, rollout_gradient
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.locomotion import cpg
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage, tracking
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, recording, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, GradPath, Params, Record, Room
from lgmdjax.studies.settings import FinetuneSettings

FIRST_EPISODE = 2**21  # number of the first episode of finetuning, whose rooms are used nowhere else
JOINT_PARTS = ("policy", "shaping", "detector.threshold", "detector.suppression", "detector.inhibition")
BINS = 12  # of a plotted curve


class FinetuneMode(NamedTuple):
    """What the gradient passes through, and which parameters are trained."""

    grad_path: GradPath = "everything"
    trainable: tuple[str, ...] = ("policy",)


MODES = {
    "controller": FinetuneMode(grad_path="controller"),
    "everything": FinetuneMode(),
    "joint": FinetuneMode(trainable=JOINT_PARTS),
}
COLOURS = {
    "imitation": style.DARK,
    "imitation, smooth": style.GREY,
    "dagger": style.PALETTE[2],
    "controller": style.PALETTE[4],
    "everything": style.PALETTE[0],
    "joint": style.PALETTE[1],
    "dagger + everything": style.PALETTE[3],
}


def run(folder: Path, inputs: Mapping[str, Path], settings: FinetuneSettings, seed: int) -> None:
    """Train all learners with every random seed, and score them in the benchmark rooms."""
    robot = assembly.with_resolution(assembly.load_robot(inputs["fit-gait"], inputs["train"]), settings.benchmark.eyes)
    rows = []
    for repeat in range(settings.seeds):
        repeat_folder = folder / f"repeat-{repeat}"
        horizons = () if repeat else settings.horizons
        for name, learner, facts in train_learners(repeat_folder, robot, settings, seed + repeat, horizons):
            walks, label = repeat_folder / "benchmark" / name.replace(" ", "-"), f"{name}, seed {repeat}"
            record = recording.record_benchmark(
                walks, learner, settings.benchmark, policies.LEARNED, seed, label=label
            )  # fmt: skip
            rows.append({"learner": name, "repeat": repeat} | facts | detector_constants(learner) | summarise(record))
    storage.write_json(folder / "closed_loop_finetune.json", rows)


def train_learners(
    folder: Path, robot: Params, settings: FinetuneSettings, seed: int, horizons: Sequence[int] = ()
) -> Iterator[tuple[str, Params, JsonObject]]:
    """Yield the learners of one seed: name, robot, and the facts and curve of its finetuning, empty without."""
    training, rounds = settings.dagger, settings.dagger.dagger_rounds
    facts = {"training": asdict(training), "seconds": settings.demonstration_seconds}
    walks = dagger.record_demonstrations(
        folder / "demonstrations", robot, robots=training.robots, seconds=settings.demonstration_seconds, seed=seed,
        parameters=facts,
    )  # fmt: skip

    def after_dagger(rounds: int) -> Params:
        own = dagger.run(folder / "dagger", robot, walks, replace(training, dagger_rounds=rounds), seed)
        checkpoints = folder / "checkpoints" / f"rounds-{rounds}"
        return assembly.with_policy(robot, "learned", dagger.fit_navigator(checkpoints, own, training.epochs, seed)[0])

    finetuned = partial(finetune_learner, settings=settings, seed=seed)
    first, half = after_dagger(0), rounds // 2
    yield "imitation", first, {}
    yield "imitation, smooth", rollout_gradient.smooth_thresholds(first), {}
    yield "dagger", after_dagger(rounds), {}
    for name, mode in MODES.items():
        yield name, *finetuned(folder / name, first, mode=mode, frames=settings.window, rooms=rounds)
    name, mode = "dagger + everything", FinetuneMode()
    yield name, *finetuned(folder / "half", after_dagger(half), mode=mode, frames=settings.window, rooms=rounds - half)
    for frames in horizons:
        name = f"everything, {frames} frames"
        yield name, *finetuned(folder / f"window-{frames}", first, mode=mode, frames=frames, rooms=rounds)


def finetune_learner(
    folder: Path, learner: Params, *, settings: FinetuneSettings, mode: FinetuneMode, frames: int, rooms: int, seed: int
) -> tuple[Params, JsonObject]:
    """Finetune a learner while it walks; return the robot with hard thresholds, and the facts and curve of its fit.

    Args:
        folder: for checkpoints.
        learner: robot to start from.
        settings: of the study.
        mode: what the gradient passes through, and what is trained.
        frames: of the window through which the gradient is taken.
        rooms: number of rooms that each robot walks in, one after the other.
        seed: of the rooms.
    """
    training, robot = settings.dagger, rollout_gradient.smooth_thresholds(rollout_gradient.learned_only(learner))
    window = rollout_gradient.Settings(frames=frames, grad_path=mode.grad_path, clip=settings.clip)
    finetune_settings = finetuning.Settings(
        learning_rate=settings.learning_rate * frames / FRAME_RATE,
        windows_per_room=round(training.round_seconds * FRAME_RATE / frames),
        rooms=rooms,
        trainable=mode.trainable,
    )
    identity = {"window": asdict(window), "finetuning": asdict(finetune_settings)}
    identity |= {"robot": assembly.fingerprint(robot), "seed": seed}
    print(f"{folder.name}: compiling the gradient of {frames} frames through {mode.grad_path}", flush=True)
    with closing(Checkpoints(folder, identity)) as checkpoints, tqdm(desc=folder.name, unit="window") as bar:

        def on_window(stats: finetuning.WindowStats) -> None:
            bar.set_postfix(loss=f"{stats.loss:.3f}")
            bar.update()

        after, stats = finetuning.finetune(
            robot, closed_loop.build_model(robot), partial(_rooms, seed, training.robots), window, finetune_settings,
            checkpoints=checkpoints, on_window=on_window, label=tracking.name_fit(folder),
        )  # fmt: skip
    columns = zip(finetuning.WindowStats._fields, zip(*stats, strict=True), strict=True)
    curve = {name: list(column) for name, column in columns}
    curve["seconds"] = [training.robots * frames / FRAME_RATE * (number + 1) for number in range(len(stats))]
    facts = {"grad_path": mode.grad_path, "frames": frames, "curve": curve}
    return with_finetuned_params(learner, after.controller), facts


def _rooms(seed: int, robots: int, number: int) -> Room:
    return room_batches.training_rooms(seed, FIRST_EPISODE + number, robots)


def with_finetuned_params(robot: Params, finetuned: controller.Params) -> Params:
    """Return a robot with all five policies and the finetuned parameters; its thresholds stay hard or smooth."""
    constants = {name: getattr(finetuned.detector, name) for name in (*lgmd.SCALARS, "kernel")}
    detector = replace(robot.controller.detector, **constants)
    own = replace(robot.controller, detector=detector, cpg=finetuned.cpg, shaping=finetuned.shaping)
    return assembly.with_policy(replace(robot, controller=own), "learned", finetuned.policy)


def detector_constants(learner: Params) -> dict[str, float]:
    """Return the detector's constants that a joint fit trains."""
    return {name: float(getattr(learner.controller.detector, name)) for name in lgmd.SCALARS}


def summarise(record: Record) -> JsonObject:
    """Return the score of a learner's walks, its approaches, and its imitation loss."""
    score, approaches = metrics.score(record, cpg.CYCLE_TIME), dagger.count_approaches(record)
    error = np.mean((np.asarray(record.velocity) - np.asarray(record.label)) ** 2, axis=-1)
    return asdict(score) | {
        "approaches": approaches,
        "approaches_per_100_m": asdict(metrics.poisson_rate(approaches, score.distance / 100)),
        "imitation": float(error[np.asarray(record.ok)].mean()),
    }


def pool_repeats(rows: Sequence[JsonObject], count: str) -> dict[str, metrics.Estimate]:
    """Return the rate of `count` per 100 m of each learner, its seeds pooled, in the order of the rows."""
    names = dict.fromkeys(row["learner"] for row in rows)
    sums = {
        name: [sum(row[key] for row in rows if row["learner"] == name) for key in (count, "distance")] for name in names
    }
    return {name: metrics.poisson_rate(total, distance / 100) for name, (total, distance) in sums.items()}


def signal_to_noise(row: JsonObject) -> Float[np.ndarray, " windows"]:
    """Return signal / noise of the windows in which both are known.

    >>> signal_to_noise({"curve": {"signal": [3.0, 1.0], "noise": [1.5, 0.0]}})
    array([2.])
    """
    signal, noise = (np.array(row["curve"][name], float) for name in ("signal", "noise"))
    known = np.isfinite(signal) & (noise > 0)
    return signal[known] / noise[known]


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot collisions and approaches of the learners, their loss, and the gradient's signal / noise."""
    figure = Figure(figsize=(style.WIDTH, 5.6), layout="constrained")
    (collisions, approaches), (loss, ratio) = figure.subplots(2, 2)
    _plot_rates(collisions, rows, "collisions", "per_100_m")
    collisions.set(xlabel="collisions per 100 m")
    _plot_rates(approaches, rows, "approaches", "approaches_per_100_m")
    approaches.set(xlabel=f"closer than {100 * dagger.APPROACH_CLEARANCE:g} cm, times per 100 m")
    approaches.set_yticklabels([])
    finetuned = [row for row in rows if "curve" in row]
    _plot_losses(loss, finetuned)
    _plot_signal_to_noise(ratio, finetuned)
    return figure


def _plot_rates(axes: Axes, rows: Sequence[JsonObject], count: str, rate: str) -> None:
    """Plot rates by learner: the pooled rate with its interval, and a dot for each seed."""
    pooled = pool_repeats(rows, count)
    for y, (name, estimate) in enumerate(pooled.items()):
        axes.plot([estimate.low, estimate.high], [y, y], color=_colour(name), linewidth=1.6, alpha=0.6)
        axes.plot([estimate.value], [y], "|", color=_colour(name), markersize=11, markeredgewidth=2)
        each = [row[rate]["value"] for row in rows if row["learner"] == name]
        axes.plot(each, [y] * len(each), "o", color=_colour(name), markersize=3.5, clip_on=False, zorder=3)
    axes.set_yticks(range(len(pooled)), list(pooled))
    axes.set(ylim=(len(pooled) - 0.5, -0.5), xlim=(0, None))
    axes.grid(False, axis="y")


def _plot_losses(axes: Axes, rows: Sequence[JsonObject]) -> None:
    """Plot the imitation loss against simulated time, averaged over the seeds of each learner."""
    for name in dict.fromkeys(row["learner"] for row in rows if row["learner"] in COLOURS):
        curves = [row["curve"] for row in rows if row["learner"] == name]
        time, value = (np.mean([_binned(curve[key]) for curve in curves], axis=0) for key in ("seconds", "loss"))
        axes.plot(time / 60, value, color=COLOURS[name], label=name)
    axes.set(xlabel="simulated robot-minutes", ylabel="imitation loss of a window")
    axes.legend()


def _plot_signal_to_noise(axes: Axes, rows: Sequence[JsonObject]) -> None:
    """Plot median and quartiles of signal / noise of every fit against its horizon."""
    for row in (row for row in rows if signal_to_noise(row).size):
        low, median, high = np.quantile(signal_to_noise(row), (0.25, 0.5, 0.75))
        x = row["frames"] * 1.05 ** (list(COLOURS).index(_base(row["learner"])) - 4)  # next to each other
        axes.plot([x, x], [low, high], color=_colour(row["learner"]), alpha=0.5)
        axes.plot([x], [median], "o", color=_colour(row["learner"]), markersize=4.5)
    axes.axhline(1.0, color=style.GREY, linewidth=1, linestyle=":")
    axes.set(xscale="log", xlabel="horizon [frames]", ylabel="signal / noise of the gradient", ylim=(0, None))
    frames = sorted({row["frames"] for row in rows})
    axes.set_xticks(frames, list(map(str, frames)))
    axes.xaxis.set_minor_locator(NullLocator())


def _base(name: str) -> str:
    return name if name in COLOURS else name.partition(", ")[0]


def _colour(name: str) -> str:
    return COLOURS[_base(name)]


def _binned(column: Sequence[float]) -> Float[np.ndarray, " bins"]:
    """Average a curve in bins of equal length; nan for a bin without finite values."""
    bins = np.array_split(np.array(column, float), min(BINS, len(column)))
    return np.array([np.mean(some[np.isfinite(some)]) if np.isfinite(some).any() else np.nan for some in bins])
