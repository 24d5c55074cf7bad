"""Stage train: fit the navigator, let it walk, label its walks with the rule, and fit again.

Imitation of recorded walks alone leaves a robot that does not turn: while the teacher turns, the turn itself floods
both eyes, so that "much moves" foretells "turn" in the recorded walks, and a robot that has not begun to turn never
sees it. The rule is free in simulation, so the navigator's own walks are labelled with it and learned from as well
(DAgger: Ross, Gordon & Bagnell 2011).

Writes controller.safetensors (with calibration and camera in its header), training.json (fig. 11, table of
learners), prediction.npz (fig. 12), baselines.npz (what the direct and the random driver need), and the
navigator's own walks, a folder a round, from which an interrupted run carries on.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lgmdjax import drivers, episodes, hexapod, lgmd, navigator, rollout, scales, tapes, training
from lgmdjax.episodes import Walk
from lgmdjax.files import write_json
from lgmdjax.simulation import FRAME_RATE
from lgmdjax.stages import collect, crew

OWN_WALKS = 2**19  # number of the first episode that the navigator walks itself: rooms of their own
KEPT_BACK = 0.25  # share of the rooms that no learner is shown; half of them choose its best epoch, half judge it
SHOWN = 60.0  # s, of fig. 12


def work(folder: Path, inputs: Mapping[str, Path], settings: scales.Train, seed: int) -> None:
    """Fit and walk in turns, then fit every variant on all walks, and keep the paper's as the controller."""
    whole = episodes.read(inputs["collect"] / "episodes")
    recorded = episodes.stretches(whole)
    np.savez(folder / "baselines.npz", allow_pickle=False, **_baselines(recorded))
    walks, header = recorded, episodes.parameters(inputs["collect"] / "episodes")
    for number in range(settings.rounds):
        own = _own_walks(folder, inputs, settings, seed, number, walks)
        whole, walks = whole + own, walks + episodes.stretches(own)
    # By room. The paper halves every stretch; but a stretch ends where the robot touched something, so that its
    # second half is what a controller must learn most. One fit to the teacher's walks in halves stands beside.
    train, kept = tapes.split_by_room(walks, KEPT_BACK, seed)
    test, unseen = tapes.split_by_room(kept, 0.5, seed)

    def fit(name: str, variant: navigator.Variant, train: list[Walk], test: list[Walk]) -> training.Fit:
        epochs = training.Settings(epochs=settings.epochs if variant != "mean" else 1)
        start = navigator.create(jax.random.key(seed), variant)
        return training.fit(start, train, test, epochs, checkpoints=folder / "checkpoints" / name)

    fits = {str(variant): fit(variant, variant, train, test) for variant in navigator.VARIANTS}
    shown = {walk.room for walk in train}
    first, second = tapes.halve([walk for walk in recorded if walk.room in shown])
    fits["lstm-halves"] = fit("lstm-halves", "lstm", first, second)
    sets = {"train": train, "test": test, "unseen": unseen}
    curves = {variant: {"train": fit.train.tolist(), "test": fit.test.tolist()} for variant, fit in fits.items()}
    minutes = {name: sum(map(len, some)) / FRAME_RATE / 60 for name, some in sets.items()}
    table = training.table({variant: fit.best for variant, fit in fits.items()}, sets)
    lost = sum(not walk.ok[-1] for walk in whole)  # robots that fell, or whose state was not finite
    result = {"curves": curves, "table": table, "minutes": minutes, "caution": training.CAUTION, "lost": lost}
    write_json(folder / "training.json", result)
    learned = training.enliven(fits["lstm"].best, test)
    navigator.save(
        folder / "controller.safetensors", learned, header | {"seed": seed, "training": dataclasses.asdict(settings)}
    )
    np.savez(folder / "prediction.npz", allow_pickle=False, **_prediction(learned, unseen))


def _own_walks(
    folder: Path, inputs: Mapping[str, Path], settings: scales.Train, seed: int, number: int, walks: Sequence[Walk]
) -> list[Walk]:
    """Fit the navigator to all walks so far, let it drive one episode, and return all that it walked, labelled."""
    place = folder / "walks" / f"round-{number}"
    writer = episodes.Writer(place, {"settings": dataclasses.asdict(settings), "round": number})
    if not writer.chunks:
        train, test = tapes.split_by_room(walks, KEPT_BACK, seed)
        fit = training.fit(
            navigator.create(jax.random.key(seed)),
            train,
            test,
            training.Settings(epochs=settings.round_epochs),
            checkpoints=folder / "checkpoints" / f"round-{number}",
        )
        episode = OWN_WALKS + number
        detector = collect.load_detector(inputs["collect"])
        learned = crew.everyone(training.enliven(fit.best, test))
        params = crew.robot(inputs["fit-gait"], settings.eyes, detector, learned)
        rooms = collect.rooms_of(seed, episode, settings.robots)
        label = f"train: its own walk {number + 1} of {settings.rounds}"
        chunks = crew.walks(crew.seat(params, drivers.LEARNED), hexapod.build(), rooms, settings.round_seconds, label)
        numbers = episode * settings.robots + np.arange(settings.robots)
        writer.write(rollout.together(list(chunks)), episode=episode, rooms=numbers.tolist(), seed=seed)
    return episodes.read(place)


def _prediction(params: navigator.Params, walks: Sequence[Walk]) -> dict[str, np.ndarray]:
    """Predict the longest stretch in an unseen room."""
    walk = max(walks, key=len)[: round(SHOWN * FRAME_RATE)]
    series = {name: getattr(walk, name) for name in ("time", "u", "distances", "label")}
    return series | {"predicted": training.predict(params, [walk])[0]}


def _baselines(walks: Sequence[Walk]) -> dict[str, Any]:
    """Measure the gain that makes u - 0.5 as large as 1/d on the mean, and cut commands of the teacher to replay."""
    u = np.concatenate([walk.u for walk in walks])
    nearness = np.concatenate([1 / walk.distances for walk in walks])
    commands = np.concatenate([walk.label for walk in walks])
    return {
        "gain": nearness.mean() / max(float((u - lgmd.STILL).mean()), 1e-6),
        "replayed": np.resize(commands, (crew.REPLAY, 2)),
    }
