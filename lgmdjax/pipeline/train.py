"""Stage train: fit the navigator, roll it out, label its walks with the rule, and fit again (DAgger).

| file                    | contents                                                                     |
| ----------------------- | ---------------------------------------------------------------------------- |
| controller.safetensors  | the navigator, with calibration and camera in its header                     |
| training.json           | learning curves (fig. 11), and the table of the variants                     |
| prediction.npz          | fig. 12                                                                      |
| baselines.npz           | parameters of the policies `direct` and `random`                             |
| walks/                  | the navigator's own walks (`lgmdjax.learning.dagger`), a folder for each     |
|                         | round, from which an interrupted run resumes                                 |
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from lgmdjax.control import names, navigator
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning, dagger, sequences
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.pipeline import collect
from lgmdjax.runtime import distributed, schema
from lgmdjax.runtime.storage import write_arrays, write_json
from lgmdjax.simulation import assembly, episodes
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episodes import Walk

PLOT_SECONDS = 60.0  # of fig. 12


def run(folder: Path, inputs: Mapping[str, Path], settings: TrainSettings, seed: int) -> None:
    """Run DAgger, fit every variant to all walks, and save the paper's variant as the controller."""
    recorded = episodes.read(inputs["collect"] / "episodes")
    header = episodes.read_parameters(inputs["collect"] / "episodes")
    baselines = _baselines(episodes.segments(recorded))
    schema.check(assembly.BASELINES, baselines, "baselines", "collect again")
    if distributed.is_first():
        write_arrays(folder / "baselines.npz", baselines)
    detector = assembly.load_detector(inputs["collect"])
    recorded_with = assembly.read_camera_settings(header)
    robot = assembly.assemble_robot(inputs["fit-gait"], recorded_with, detector, assembly.make_policies())
    robot = assembly.with_resolution(robot, settings.eyes)
    faults = collect.read_camera_faults(header)
    walks = dagger.run(folder, robot, recorded, settings, seed, camera_faults=faults)
    train, test, unseen = dagger.split_rooms(episodes.segments(walks), seed)
    fits = _fit_variants(folder, train, test, settings, seed)
    rooms = {segment.room for segment in train}
    teachers = [segment for segment in episodes.segments(recorded) if segment.room in rooms]
    fits["lstm-halves"] = _fit_halves(folder, teachers, settings, seed)
    sets = {"train": train, "test": test, "unseen": unseen}
    learned, turn_gains = dagger.select_turn_gain(
        folder, robot, fits["lstm"], test, settings, seed=seed, camera_faults=faults
    )
    if not distributed.is_first():
        return
    result = {
        "curves": {
            name: {"train": fit.train_mse.tolist(), "test": fit.test_mse.tolist()} for name, fit in fits.items()
        },
        "table": behaviour_cloning.score_variants({name: fit.best for name, fit in fits.items()}, sets),
        "minutes": {name: sum(map(len, some)) / FRAME_RATE / 60 for name, some in sets.items()},
        "cautions": turn_gains,
        "lost": sum(not walk.ok[-1] for walk in walks),  # robots that fell, or whose state was not finite
    }
    write_json(folder / "training.json", result)
    # The camera is that of the navigator's own walks, which are most of its training data.
    eyes = dataclasses.asdict(assembly.camera_settings(robot))
    facts = {"eyes": eyes, "seed": seed, "training": dataclasses.asdict(settings)}
    navigator.save(folder / "controller.safetensors", learned, header | facts)
    write_arrays(folder / "prediction.npz", _prediction(learned, unseen))


def _fit_variants(
    folder: Path, train: list[Walk], test: list[Walk], settings: TrainSettings, seed: int
) -> dict[str, behaviour_cloning.FitResult]:
    """Fit every variant of the settings to the same segments; "mean" needs one epoch."""
    fits: dict[str, behaviour_cloning.FitResult] = {}
    for variant in names.VARIANTS:
        if variant in settings.variants:
            fit_settings = behaviour_cloning.Settings(epochs=settings.epochs if variant != "mean" else 1)
            start = navigator.create(jax.random.key(seed), variant)
            checkpoints = folder / "checkpoints" / variant
            fits[variant] = behaviour_cloning.fit(start, train, test, fit_settings, checkpoints=checkpoints)
    return fits


def _fit_halves(folder: Path, segments: list[Walk], settings: TrainSettings, seed: int) -> behaviour_cloning.FitResult:
    """Fit the LSTM to the first halves of the teacher's walks, as the paper does, for comparison.

    A segment ends where the robot collided, so its second half is what a controller must learn most.
    """
    first, second = sequences.split_halves(segments)
    start, halves = navigator.create(jax.random.key(seed), "lstm"), settings.split_half_epochs
    checkpoints = folder / "checkpoints" / "lstm-halves"
    return behaviour_cloning.fit(
        start, first, second, behaviour_cloning.Settings(epochs=halves), checkpoints=checkpoints
    )


def _prediction(params: navigator.Params, segments: Sequence[Walk]) -> dict[str, np.ndarray]:
    """Predict the commands of the longest segment in a held-out room (fig. 12)."""
    walk = max(segments, key=len)[: round(PLOT_SECONDS * FRAME_RATE)]
    series = {name: getattr(walk, name) for name in ("time", "u", "corridor", "label")}
    return series | {"predicted": behaviour_cloning.predict(params, [walk])[0]}


def _baselines(segments: Sequence[Walk]) -> dict[str, np.ndarray]:
    """Return the gain that makes the mean of u - 0.5 equal that of 1/e, and commands of the teacher to replay."""
    if not segments:
        raise InputError("expected walks without contact to train on, got none; collect longer ones")
    u = np.concatenate([walk.u for walk in segments])
    proximity = np.concatenate([1 / walk.corridor for walk in segments])
    commands = np.concatenate([walk.label for walk in segments])
    return {
        "gain": np.asarray(proximity.mean() / max(float((u - lgmd.U_AT_REST).mean()), 1e-6)),
        "replayed": np.resize(commands, (assembly.REPLAY_LENGTH, 2)),
    }
