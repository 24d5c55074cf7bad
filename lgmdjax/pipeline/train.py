"""Stage train: fit the navigator, let it walk, label its walks with the rule, and fit again.

Writes controller.safetensors (with calibration and camera in its header), training.json (fig. 11, table of
learners), prediction.npz (fig. 12), baselines.npz (what the direct and the random driver need), and the
navigator's own walks (`lgmdjax.learning.dagger`), a folder a round, from which an interrupted run carries on.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.learning import behaviour_cloning, dagger, sequences
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.runtime.storage import write_json
from lgmdjax.simulation import assembly, episodes
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episodes import Walk

SHOWN = 60.0  # s, of fig. 12


def work(folder: Path, inputs: Mapping[str, Path], settings: TrainSettings, seed: int) -> None:
    """Fit and walk in turns, then fit every variant on all walks, and keep the paper's as the controller."""
    recorded = episodes.read(inputs["collect"] / "episodes")
    header = episodes.parameters(inputs["collect"] / "episodes")
    np.savez(folder / "baselines.npz", allow_pickle=False, **_baselines(episodes.stretches(recorded)))
    detector = assembly.load_detector(inputs["collect"])
    robot = assembly.robot(inputs["fit-gait"], settings.eyes, detector, assembly.everyone())
    whole = dagger.practise(folder, robot, recorded, settings, seed)
    train, test, unseen = dagger.split(episodes.stretches(whole), seed)

    def fit(name: str, variant: navigator.Variant, train: list[Walk], test: list[Walk]) -> behaviour_cloning.Fit:
        epochs = settings.halves_epochs if name == "lstm-halves" else settings.epochs
        epochs = behaviour_cloning.Settings(epochs=epochs if variant != "mean" else 1)
        start = navigator.create(jax.random.key(seed), variant)
        return behaviour_cloning.fit(start, train, test, epochs, checkpoints=folder / "checkpoints" / name)

    chosen: list[navigator.Variant] = [name for name in navigator.VARIANTS if name in settings.variants]
    fits: dict[str, behaviour_cloning.Fit] = {variant: fit(variant, variant, train, test) for variant in chosen}
    shown = {walk.room for walk in train}
    # The paper halves every stretch; but a stretch ends where the robot touched something, so that its second half is
    # what a controller must learn most. One fit to the teacher's walks in halves stands beside.
    first, second = sequences.halve([walk for walk in episodes.stretches(recorded) if walk.room in shown])
    fits["lstm-halves"] = fit("lstm-halves", "lstm", first, second)
    sets = {"train": train, "test": test, "unseen": unseen}
    curves = {variant: {"train": fit.train.tolist(), "test": fit.test.tolist()} for variant, fit in fits.items()}
    minutes = {name: sum(map(len, some)) / FRAME_RATE / 60 for name, some in sets.items()}
    table = behaviour_cloning.table({variant: fit.best for variant, fit in fits.items()}, sets)
    lost = sum(not walk.ok[-1] for walk in whole)  # robots that fell, or whose state was not finite
    learned, cautions = dagger.tempered(folder, robot, fits["lstm"], test, settings, seed)
    result = {"curves": curves, "table": table, "minutes": minutes, "cautions": cautions, "lost": lost}
    write_json(folder / "training.json", result)
    # The eyes that it learned with are those of its own walks, most of what it learned from.
    facts = {"eyes": dataclasses.asdict(settings.eyes), "seed": seed, "training": dataclasses.asdict(settings)}
    navigator.save(folder / "controller.safetensors", learned, header | facts)
    np.savez(folder / "prediction.npz", allow_pickle=False, **_prediction(learned, unseen))


def _prediction(params: navigator.Params, walks: Sequence[Walk]) -> dict[str, np.ndarray]:
    """Predict the longest stretch in an unseen room."""
    walk = max(walks, key=len)[: round(SHOWN * FRAME_RATE)]
    series = {name: getattr(walk, name) for name in ("time", "u", "distances", "label")}
    return series | {"predicted": behaviour_cloning.predict(params, [walk])[0]}


def _baselines(walks: Sequence[Walk]) -> dict[str, Any]:
    """Measure the gain that makes u - 0.5 as large as 1/d on the mean, and cut commands of the teacher to replay."""
    u = np.concatenate([walk.u for walk in walks])
    nearness = np.concatenate([1 / walk.distances for walk in walks])
    commands = np.concatenate([walk.label for walk in walks])
    return {
        "gain": nearness.mean() / max(float((u - lgmd.STILL).mean()), 1e-6),
        "replayed": np.resize(commands, (assembly.REPLAY, 2)),
    }
