"""Practice: let the navigator walk, label its walks with the rule, and fit it to all walks so far; some rounds of it.

Imitation of recorded walks alone leaves a robot that does not turn: while the teacher turns, the turn itself floods
both eyes, so that "much moves" foretells "turn" in the recorded walks, and a robot that has not begun to turn never
sees it. The rule is free in simulation, so the navigator's own walks are labelled with it and learned from as well.

How much harder than its teacher the navigator should turn in the end (`training.enliven`) is tried out: collisions are
too rare to choose by, but how often it comes nearer to something than `TIGHT` tells careless drivers from careful ones.

Source: Ross, Gordon & Bagnell 2011 (DAgger).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lgmdjax.control import navigator, policies
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.learning import behaviour_cloning, sequences
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.locomotion import cpg
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, room_batches
from lgmdjax.simulation.episodes import Walk

OWN_WALKS = 2**19  # number of the first episode that the navigator walks itself: rooms of their own
TRYOUT = 2**20  # number of the episode whose rooms caution is chosen in
TIGHT = 0.08  # m of clearance
KEPT_BACK = 0.25  # share of the rooms that no learner is shown; half of them choose its best epoch, half judge it


def lesson(
    folder: Path, robot: closed_loop.Params, robots: int, seconds: float, seed: int, facts: Mapping[str, Any]
) -> list[Walk]:
    """Let a robot's teacher walk in rooms to learn in, with its eyes open."""
    how = {"seed": seed, "facts": {**facts, "robot": assembly.digest(robot)}, "label": "lesson", "draw": True}
    recording.walked(folder, robot, room_batches.rooms_of(seed, 0, robots), seconds, policies.TEACHER, **how)
    return episodes.read(folder)


def learn(
    folder: Path, walks: Sequence[Walk], epochs: int, seed: int, variant: navigator.Variant = "lstm"
) -> tuple[navigator.Params, list[Walk]]:
    """Fit a new navigator to walks; give the best one, and the stretches that it was chosen by."""
    train, test, _ = split(episodes.stretches(walks), seed)
    start, settings = navigator.create(jax.random.key(seed), variant), behaviour_cloning.Settings(epochs=epochs)
    return behaviour_cloning.fit(start, train, test, settings, checkpoints=folder).best, test


def practise(
    folder: Path,
    robot: closed_loop.Params,
    walks: list[Walk],
    settings: TrainSettings,
    seed: int,
    variant: navigator.Variant = "lstm",
) -> list[Walk]:
    """Fit and walk in turns; give the walks that were there and those that came.

    Args:
        folder: for fits and walks, from which an interrupted practice carries on.
        robot: who practises; its teacher labels.
        walks: recorded before. variant: of the navigator.
        settings: how many rounds, how long. seed: of rooms, weights and the split.
    """
    for number in range(settings.rounds):
        walks = walks + _round(folder, robot, walks, settings, seed, number, variant)
    return walks


def tempered(
    folder: Path,
    robot: closed_loop.Params,
    fit: behaviour_cloning.Fit,
    test: Sequence[Walk],
    settings: TrainSettings,
    seed: int,
) -> tuple[navigator.Params, list[dict[str, Any]]]:
    """Choose the caution with which a navigator comes least often too near to something; the least of equals.

    Args:
        folder: for the walks, one a caution, all in the same rooms. test: stretches of walking to measure its turns on.
        settings: the cautions, and how many robots walk for how long.

    Returns:
        The navigator, and a row a caution: whether it is the chosen one, how often it came nearer than `TIGHT`, in how
        much of a way. Where there is nothing to choose from, nothing is walked.
    """
    if not settings.cautions:
        return behaviour_cloning.enliven(fit.best, test), [{"caution": behaviour_cloning.CAUTION, "chosen": True}]
    rooms = room_batches.random_rooms(jax.random.fold_in(jax.random.key(seed), TRYOUT), settings.robots)
    rows, tried = [], []
    for caution in settings.cautions:
        tried.append(behaviour_cloning.enliven(fit.best, test, caution))
        pupil = assembly.manned(robot, tried[-1])
        facts = {"caution": caution, "seconds": settings.round_seconds, "robot": assembly.digest(pupil)}
        how = {"seed": seed, "facts": facts, "label": f"caution {caution:g}"}
        place = folder / "walks" / f"caution-{caution:g}"
        record = recording.walked(place, pupil, rooms, settings.round_seconds, policies.LEARNED, **how)
        score = metrics.score(record, cpg.CYCLE_TIME)
        row = {"caution": caution, "tight": approaches(record)}
        rows.append(row | {"collisions": score.collisions, "distance": score.distance})
    least = min(range(len(rows)), key=lambda k: (rows[k]["tight"] / rows[k]["distance"], rows[k]["caution"]))
    return tried[least], [row | {"chosen": k == least} for k, row in enumerate(rows)]


def approaches(record: closed_loop.Record) -> int:
    """Count the times that robots came nearer to something than `TIGHT`; the next is after they were twice as far.

    Legs sway by centimetres with every step: a robot that turns beside a wall crosses a single bound a dozen times.
    """
    clearance, fresh = np.asarray(record.clearance), np.asarray(record.fresh)
    tight, free = clearance < TIGHT, (clearance > 2 * TIGHT) | fresh
    return sum(
        int(np.sum(np.diff(near[near | far].astype(int), prepend=0) > 0)) for near, far in zip(tight, free, strict=True)
    )


def practised(folder: Path) -> list[Walk]:
    """Read the walks of all rounds of a finished practice."""
    rounds = sorted((folder / "walks").glob("round-*"), key=lambda place: int(place.name.partition("-")[2]))
    return [walk for number, place in enumerate(rounds) for walk in _numbered(place, number)]


def recorded_by(inputs: Mapping[str, Path]) -> list[Walk]:
    """Read all that the run recorded: the teacher's walks and the navigator's own."""
    if "collect" not in inputs:
        raise InputError("expected a run whose walks pupils can learn from, got none; name one with --run")
    return episodes.read(inputs["collect"] / "episodes") + practised(inputs["train"])


def split(walks: Sequence[Walk], seed: int) -> tuple[list[Walk], list[Walk], list[Walk]]:
    """Part stretches by their rooms: those to learn from, those to choose the best epoch by, those to judge by."""
    train, kept = sequences.split_by_room(walks, KEPT_BACK, seed)
    return train, *sequences.split_by_room(kept, 0.5, seed)


def _round(
    folder: Path, robot: closed_loop.Params, walks: list[Walk], settings: TrainSettings, seed: int, number: int,
    variant: navigator.Variant,
) -> list[Walk]:  # fmt: skip
    """Fit the navigator to all walks so far, let it drive one episode, and return all that it walked, labelled."""
    place = folder / "walks" / f"round-{number}"
    if not recording.has_walked(place, settings.robots):
        train, test = sequences.split_by_room(episodes.stretches(walks), KEPT_BACK, seed)
        fit = behaviour_cloning.fit(
            navigator.create(jax.random.key(seed), variant),
            train,
            test,
            behaviour_cloning.Settings(epochs=settings.round_epochs),
            checkpoints=folder / "checkpoints" / f"round-{number}",
        )
        pupil = assembly.manned(robot, behaviour_cloning.enliven(fit.best, test))
        facts = {"seconds": settings.round_seconds, "round": number, "robot": assembly.digest(pupil)}
        how = {"seed": seed, "facts": facts, "label": f"practice {number + 1} of {settings.rounds}"}
        rooms = room_batches.rooms_of(seed, OWN_WALKS + number, settings.robots)
        recording.walked(place, pupil, rooms, settings.round_seconds, policies.LEARNED, **how)
    return _numbered(place, number)


def _numbered(place: Path, number: int) -> list[Walk]:
    """Read the walks of a round, and number their rooms apart from those of any other."""
    walks, episode = episodes.read(place), OWN_WALKS + number
    return [replace(walk, episode=episode, room=episode * len(walks) + walk.room) for walk in walks]
