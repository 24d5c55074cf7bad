"""Is an LGMD fitted by gradient better than the calibrated one? T_s, T_f, W_I and w_I, by imitation of recorded walks.

The calibrated T_s, T_f and W_I come from a grid search that correlates u with proximity
(`lgmdjax.learning.lgmd_grid_search`), and w_I is the paper's. Here all four follow the gradient of the navigator's
imitation loss (`lgmdjax.learning.lgmd_gradient_fit`). For each random seed these are fitted, with the same number of
steps:

| method     | what is fitted                                                              |
| ---------- | --------------------------------------------------------------------------- |
| calibrated | nothing: the calibrated detector, and a navigator trained with it           |
| navigator  | the navigator alone, trained further: the control                           |
| detector   | the detector alone                                                          |
| both       | both                                                                        |

Each seed has its own split of the rooms, its own order of the walks, and its own navigator. The navigator is trained on
the training walks, and its turns are not rescaled. Its input constants, mean and standard deviation of the calibrated
u, stay fixed: a frozen navigator needs the inputs that it was trained with, and one that is trained as well can absorb
other constants in the weights and biases of its first layer.

A quarter of the rooms is held out; one half of it selects the best step of a fit, the other half is the test set. All
metrics are measured with hard thresholds, as on the robot, and with the camera that the run's navigator was trained
with.

| metric   | meaning                                                                                   |
| -------- | ----------------------------------------------------------------------------------------- |
| mse      | of the command, nominal^2, mean over both sides                                           |
| steering | correlation of the commanded turns with those of the labels                               |
| nearness | correlation of left minus right u with left minus right proximity                         |

Writes lgmd_gradient.json, a row for each method and seed: curve, metrics on the training and on the test walks, and the
detector's constants, where w_I has the sum of eq. 9.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning, dagger, lgmd_gradient_fit, lgmd_grid_search
from lgmdjax.learning.lgmd_gradient_fit import FrameDifferences, LgmdNavigator
from lgmdjax.learning.settings import LgmdGradientSettings
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, episodes, rerender, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, AnyArray
from lgmdjax.simulation.episodes import Walk

METHODS: Mapping[str, tuple[str, ...]] = {
    "calibrated": (),
    "navigator": ("navigator",),
    "detector": ("detector",),
    "both": ("detector", "navigator"),
}
COLOURS = {
    "calibrated": style.DARK,
    "navigator": style.GREY,
    "detector": style.LEFT_COLOUR,
    "both": style.RIGHT_COLOUR,
}
SAME_CAMERA_TOLERANCE = 0.01  # largest difference of u after rendering again, in standard deviations of u
OTHER_CAMERA_TOLERANCE = 0.4  # the same, where the walk was recorded with another camera


class RenderedWalks(NamedTuple):
    """Recorded walks that were rendered again, with the frame differences of their pictures."""

    walks: Sequence[Walk]
    differences: FrameDifferences


def run(folder: Path, inputs: Mapping[str, Path], settings: LgmdGradientSettings, seed: int) -> None:
    """Render recorded walks again, and fit by every method with every seed; fits that are on disk are kept."""
    recorded = dagger.read_all_walks(inputs)
    robot = assembly.load_robot(inputs["fit-gait"], inputs["train"])
    teacher_camera = assembly.read_camera_settings(episodes.read_parameters(inputs["collect"] / "episodes"))
    rendered = rerender_segments(robot, sample_segments(recorded, settings, seed), teacher_camera)
    rows = []
    for repeat in range(settings.seeds):
        rows += fit_methods(folder, robot.controller.detector, rendered, settings, repeat=repeat, seed=seed + repeat)
    storage.write_json(folder / "lgmd_gradient.json", rows)


def sample_segments(
    recorded: Sequence[Walk], settings: LgmdGradientSettings, seed: int
) -> list[tuple[int, list[Walk]]]:
    """Cut a random segment out of some random walks; every episode gives as many, and all are equally long.

    Returns:
        For each episode the number of robots that walked in it, and the segments.
    """
    generator, by_episode = np.random.default_rng(seed), dict[int, list[Walk]]()
    for walk in recorded:
        by_episode.setdefault(walk.episode, []).append(walk)
    frames = min(round(settings.seconds * FRAME_RATE), *map(len, recorded))
    count = max(round(settings.minutes * 60 * FRAME_RATE / frames / len(by_episode)), 1)
    sampled = []
    for walks in by_episode.values():
        some = [walks[k] for k in generator.permutation(len(walks))[:count]]
        firsts = [int(generator.integers(len(walk) - frames + 1)) for walk in some]
        sampled.append((len(walks), [walk[k : k + frames] for walk, k in zip(some, firsts, strict=True)]))
    return sampled


def rerender_segments(
    robot: closed_loop.Params, sampled: Sequence[tuple[int, list[Walk]]], teacher_camera: CameraSettings
) -> RenderedWalks:
    """Render segments again with the camera of a robot; return them with u and the frame differences of that camera.

    Args:
        robot: with the camera that the run's navigator was trained with.
        sampled: from `sample_segments`. Room i of n of an episode is the i-th of
            `room_batches.training_rooms(seed, episode, n)`.
        teacher_camera: the camera with which the teacher's walks were recorded.

    Raises InputError if the responses differ from the recorded ones.
    """
    walks, differences = list[Walk](), []
    detector = robot.controller.detector
    same = teacher_camera == assembly.camera_settings(robot)
    for robots, segments in tqdm(sampled, desc="rendering", unit="episode"):
        episode, numbers = segments[0].episode, np.array([walk.room % robots for walk in segments])
        rooms = room_batches.training_rooms(segments[0].seed, episode, robots).arena
        record = episodes.stack_walks(segments)
        pictures = rerender.render_walks(robot.camera, jax.tree.map(lambda leaf, of=numbers: leaf[of], rooms), record)
        differences.append(
            lgmd_gradient_fit.frame_differences(np.asarray(_pooled(detector, pictures)), record.is_first)
        )
        u = np.asarray(lgmd_gradient_fit.respond_walks(detector, differences[-1]))
        same_camera = same or episode >= dagger.FIRST_LEARNER_EPISODE
        check_responses(segments, u, SAME_CAMERA_TOLERANCE if same_camera else OTHER_CAMERA_TOLERANCE)
        walks += [replace(walk, u=own) for walk, own in zip(segments, u, strict=True)]
    return RenderedWalks(walks, jax.tree.map(lambda *leaves: np.concatenate(leaves), *differences))


def check_responses(walks: Sequence[Walk], u: Float[np.ndarray, "walks frames 2"], tolerance: float) -> None:
    """Raise `InputError` if u differs from the recorded u by more than `tolerance` standard deviations (RMS)."""
    record = episodes.stack_walks(walks)
    sound = np.asarray(record.ok)[:, 2:]  # the first two frames of a segment lack the frames before it
    known = np.asarray(record.u)[:, 2:][sound]
    difference = float(np.sqrt(np.mean((u[:, 2:][sound] - known) ** 2)) / max(known.std(), 1e-9))
    if not difference <= tolerance:
        raise InputError(
            f"episode {walks[0].episode}: expected u of the rendered walks within {tolerance} standard deviations of "
            f"the recorded u, got {difference:.3f}; use the version of lgmdjax that recorded the walks"
        )


def fit_methods(
    folder: Path, detector: lgmd.Params, rendered: RenderedWalks, settings: LgmdGradientSettings, *,
    repeat: int, seed: int,
) -> list[JsonObject]:  # fmt: skip
    """Fit by every method with one seed, and return the rows; each method has a file, which is read if it is there."""
    paths = [folder / f"{method}-{repeat}.json" for method in METHODS]
    if not all(path.exists() for path in paths):
        train, choice, test = (_select(part, rendered) for part in dagger.split_rooms(rendered.walks, seed))
        trained = fit_navigator(train.walks, choice.walks, settings, seed)
        initial = LgmdNavigator(detector=detector, navigator=trained)
        order = np.random.default_rng(seed)
        batch = lgmd_gradient_fit.pack_walks(*train, settings.streams, settings.window, order)

        def evaluate(params: LgmdNavigator) -> dict[str, float]:
            return {name: score(params, *walks)["mse"] for name, walks in (("choice", choice), ("test", test))}

        for (method, parts), path in zip(METHODS.items(), paths, strict=True):
            began, label = time.monotonic(), f"{method}, seed {repeat}"
            best, curve = lgmd_gradient_fit.fit(initial, batch, parts, settings, evaluate, label=label)
            row = {"method": method, "repeat": repeat, "seconds": time.monotonic() - began, "curve": curve}
            metrics = {"train": score(best, *train), "test": score(best, *test)}
            storage.write_json(path, row | metrics | {"detector": detector_constants(best.detector)})
    return [storage.read_table(path) for path in paths]


def fit_navigator(
    train: Sequence[Walk], choice: Sequence[Walk], settings: LgmdGradientSettings, seed: int
) -> navigator.Params:
    """Train a navigator with the calibrated u; return the best epoch on held-out walks."""
    epochs = behaviour_cloning.Settings(epochs=settings.epochs)
    start = navigator.create(jax.random.key(seed))
    return behaviour_cloning.fit(start, episodes.segments(train), episodes.segments(choice), epochs).best


def score(params: LgmdNavigator, walks: Sequence[Walk], differences: FrameDifferences) -> dict[str, float]:
    """Return the metrics of a detector and its navigator on walks, with hard thresholds: mse, steering, nearness."""
    u = np.asarray(lgmd_gradient_fit.respond_walks(params.detector, differences))
    changed = [replace(walk, u=own) for walk, own in zip(walks, u, strict=True)]
    found = behaviour_cloning.score(params.navigator, episodes.segments(changed))
    nearness = lgmd_grid_search.correlate_with_proximity(episodes.stack_walks(changed))["score"]
    return {"mse": found["mse"], "steering": found["steering"], "nearness": nearness}


def detector_constants(detector: lgmd.Params) -> JsonObject:
    """Return T_s, T_f, W_I and w_I as JSON values; w_I has the sum of eq. 9."""
    detector = lgmd_gradient_fit.normalise_kernel(detector)
    return {name: float(getattr(detector, name)) for name in lgmd.SCALARS} | {
        "kernel": np.asarray(detector.kernel).tolist()
    }


@jax.jit
def _pooled(detector: lgmd.Params, pictures: Float[AnyArray, "walks frames 2 height columns"]) -> Array:
    def pool(pair: Float[Array, "2 height columns"]) -> Float[Array, "2 rows cells"]:
        return jax.vmap(partial(lgmd.pool, detector))(hemifield.outermost_first(pair))

    return jax.lax.map(jax.vmap(pool), jnp.asarray(pictures))


def _select(part: Sequence[Walk], rendered: RenderedWalks) -> RenderedWalks:
    """Return the frame differences of some of the walks; every room has one walk."""
    numbers = {walk.room: k for k, walk in enumerate(rendered.walks)}
    selected = np.array([numbers[walk.room] for walk in part])
    return RenderedWalks(part, jax.tree.map(lambda leaf: leaf[selected], rendered.differences))


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot error against steps, the metrics on the test walks, and the kernels; rows as in lgmd_gradient.json."""
    figure = Figure(figsize=(style.WIDTH, 4.8), layout="constrained")
    panels: dict[str, Axes] = figure.subplot_mosaic("""
        eeemsn
        ccddbb
    """)
    _plot_curves(panels["e"], rows)
    for name in ("mse", "steering", "nearness"):
        _plot_metric(panels[name[0]], rows, name)
    for method in ("calibrated", "detector", "both"):
        _plot_kernel(panels[method[0]], [row["detector"] for row in rows if row["method"] == method], method)
    return figure


def _plot_curves(axes: Axes, rows: Sequence[JsonObject]) -> None:
    """Plot the error on the test walks, relative to the calibrated detector's."""
    for row in rows:
        curve = np.array([[point["step"], point["test"]] for point in row["curve"]])
        label = row["method"] if row["repeat"] == 0 else None
        if len(curve) > 1:
            axes.plot(curve[:, 0], curve[:, 1] / curve[0, 1], color=COLOURS[row["method"]], linewidth=1, label=label)
    axes.axhline(1, color=COLOURS["calibrated"], linewidth=0.8, label="calibrated")
    axes.set(xlabel="step", ylabel="error in held-out rooms,\nrelative to the calibrated")
    axes.legend()


def _plot_metric(axes: Axes, rows: Sequence[JsonObject], name: str) -> None:
    """Plot the mean over the seeds as a bar, and every seed as a dot."""
    for x, method in enumerate(METHODS):
        values = [row["test"][name] for row in rows if row["method"] == method]
        axes.bar(x, float(np.mean(values)), color=COLOURS[method], alpha=0.45, width=0.7)
        axes.plot(x + np.linspace(-0.2, 0.2, len(values)), values, ".", color=COLOURS[method], markersize=5)
    axes.set_xticks(range(len(METHODS)), METHODS, rotation=90)
    axes.grid(False, axis="x")
    axes.set(title={"mse": "error", "steering": "r, turns", "nearness": "r, proximity"}[name])


def _plot_kernel(axes: Axes, detectors: Sequence[JsonObject], title: str) -> None:
    """Plot the mean kernel over the seeds with its numbers; the title gives the ranges of the other constants."""
    kernel = np.mean([detector["kernel"] for detector in detectors], axis=0)
    axes.imshow(kernel, cmap="Greys", vmin=0, vmax=0.6)
    for (row, column), weight in np.ndenumerate(kernel):
        colour = "white" if weight > 0.35 else style.DARK
        axes.text(column, row, f"{weight:.2f}", ha="center", va="center", fontsize=6.5, color=colour)
    T_s, T_f, W_I = (
        "–".join(dict.fromkeys(f"{end([detector[name] for detector in detectors]):.2g}" for end in (min, max)))
        for name in lgmd.SCALARS
    )
    axes.set_title(f"{title}\n$T_s$ {T_s}, $T_f$ {T_f}\n$W_I$ {W_I}", fontsize=7.5)
    axes.set_axis_off()
