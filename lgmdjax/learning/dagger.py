"""DAgger: roll out the navigator, label its walks with the teacher's rule, fit it to all walks so far, and repeat.

A robot that only imitates recorded walks does not turn. While the teacher turns, its own turn excites both LGMDs, so
in the recorded walks strong excitation predicts a turn; a robot that is not yet turning never sees that excitation.
The rule costs nothing in simulation, so the navigator's own walks are labelled with it and added to the training data.

How much harder than its teacher the final navigator turns (`behaviour_cloning.rescale_turns`) is chosen by walking
with several gains. Collisions are too rare to compare them by; approaches nearer than `APPROACH_CLEARANCE` are not.

Source: Ross, Gordon & Bagnell 2011 (DAgger).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from lgmdjax.control import names, navigator, policies
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.learning import behaviour_cloning, sequences
from lgmdjax.learning.settings import DaggerSettings, TrainSettings
from lgmdjax.locomotion import cpg
from lgmdjax.runtime import distributed
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, room_batches
from lgmdjax.simulation.episodes import Walk
from lgmdjax.transfer import randomisation
from lgmdjax.transfer.names import FaultName

FIRST_LEARNER_EPISODE = 2**19  # number of the first DAgger round's episode; its rooms are in no other episode
TURN_GAIN_EPISODE = 2**20  # number of the episode in whose rooms turn gains are compared
APPROACH_CLEARANCE = 0.08  # m
MIN_RELATIVE_COVERAGE = 0.9  # of the best coverage of all turn gains, for a gain to be chosen
HELD_OUT_FRACTION = 0.25  # of the rooms; one half chooses a fit's best epoch, the other scores the fit


def record_demonstrations(
    folder: Path,
    robot: closed_loop.Params,
    *,
    robots: int,
    seconds: float,
    seed: int,
    parameters: Mapping[str, object],
) -> list[Walk]:
    """Record the teacher's walks in training rooms, with camera and LGMD, and return them.

    Args:
        folder: for the walks; walks that it already holds are not repeated.
        robot: the robot whose teacher walks.
        robots: number of robots. seconds: simulated time of each.
        seed: of the rooms.
        parameters: JSON values that distinguish these walks from others.
    """
    recording.record_rollouts(
        folder,
        robot,
        room_batches.training_rooms(seed, 0, robots),
        seconds,
        policies.TEACHER,
        seed=seed,
        parameters={**parameters, "robot": assembly.fingerprint(robot)},
        label="demonstrations",
        render=True,
    )
    return episodes.read(folder)


def fit_navigator(
    folder: Path, walks: Sequence[Walk], epochs: int, seed: int, variant: names.Variant = "lstm"
) -> tuple[navigator.Params, list[Walk]]:
    """Fit a new navigator to walks; return the best one, and the segments with which it was chosen."""
    train, test, _ = split_rooms(episodes.segments(walks), seed)
    untrained, settings = navigator.create(jax.random.key(seed), variant), behaviour_cloning.Settings(epochs=epochs)
    return behaviour_cloning.fit(untrained, train, test, settings, checkpoints=folder).best, test


def run(
    folder: Path,
    robot: closed_loop.Params,
    walks: list[Walk],
    settings: DaggerSettings,
    seed: int,
    *,
    variant: names.Variant = "lstm",
    camera_faults: Sequence[FaultName] = (),
) -> list[Walk]:
    """Alternate fits and rollouts; return the given walks and those of all rounds.

    Args:
        folder: for checkpoints and walks; an interrupted run resumes from it.
        robot: the robot that walks; its teacher labels.
        walks: walks to begin with.
        settings: number and size of the rounds.
        seed: of rooms, initial weights and the split.
        variant: of the navigator.
        camera_faults: that the robots may have.
    """
    for number in range(settings.dagger_rounds):
        walks = walks + _run_round(
            folder, robot, walks, settings, seed=seed, number=number, variant=variant, camera_faults=camera_faults
        )
    return walks


def select_turn_gain(
    folder: Path,
    robot: closed_loop.Params,
    fit: behaviour_cloning.FitResult,
    test: Sequence[Walk],
    settings: TrainSettings,
    *,
    seed: int,
    camera_faults: Sequence[FaultName] = (),
) -> tuple[navigator.Params, list[JsonObject]]:
    """Choose the turn gain with the fewest approaches per distance; the smallest gain if several have equally few.

    The more a robot turns, the less it approaches anything, and the less floor it sees. Gains with less than
    `MIN_RELATIVE_COVERAGE` of the best coverage are therefore not chosen.

    Args:
        folder: for the walks with each gain, all in the same rooms.
        robot: the robot that walks.
        fit: its navigator.
        test: segments on which the navigator's turns are measured.
        settings: the gains, and how many robots walk for how long with each. Without gains no robot walks, and
            `TURN_GAIN` holds.
        seed: of the rooms.
        camera_faults: that the robots may have.

    Returns:
        The rescaled navigator, and a row per gain, as the stage `train` stores it: `caution` (the gain), `chosen`,
        `tight` (approaches), `collisions`, `distance` and `coverage`.
    """
    if not settings.turn_gains:
        row = {"caution": behaviour_cloning.TURN_GAIN, "chosen": True}
        return behaviour_cloning.rescale_turns(fit.best, test), [row]
    rooms = room_batches.random_rooms(jax.random.fold_in(jax.random.key(seed), TURN_GAIN_EPISODE), settings.robots)
    rooms = randomisation.randomise_cameras(rooms, camera_faults, randomisation.TRAINING_PROBABILITY)
    rows, candidates = [], []
    for turn_gain in settings.turn_gains:
        rescaled = behaviour_cloning.rescale_turns(fit.best, test, turn_gain)
        candidates.append(distributed.share_arrays(f"turn gain {turn_gain:g}", rescaled))
        record = _walk_with_gain(
            folder, robot, candidates[-1], rooms, settings, turn_gain=turn_gain, seed=seed, faults=camera_faults
        )
        rows.append({"caution": turn_gain} | _summarise(record))
    least = MIN_RELATIVE_COVERAGE * max(row["coverage"] for row in rows)
    going_on = [k for k, row in enumerate(rows) if row["coverage"] >= least]
    best = min(going_on, key=lambda k: (rows[k]["tight"] / rows[k]["distance"], rows[k]["caution"]))
    return candidates[best], [row | {"chosen": k == best} for k, row in enumerate(rows)]


def _summarise(record: closed_loop.Record) -> JsonObject:
    """Return the metrics by which turn gains are compared."""
    score = metrics.score(record, cpg.CYCLE_TIME)
    row = {"tight": count_approaches(record), "collisions": score.collisions, "distance": score.distance}
    return row | {"coverage": score.progress.coverage.value}


def count_approaches(record: closed_loop.Record) -> int:
    """Count how often robots came nearer to anything than `APPROACH_CLEARANCE`.

    An approach ends when the robot is twice as far away, or is reset. The legs sway by centimetres with every step, so
    that a robot turning beside a wall crosses a single threshold a dozen times.
    """
    clearance, is_first = np.asarray(record.clearance), np.asarray(record.is_first)
    near, far = clearance < APPROACH_CLEARANCE, (clearance > 2 * APPROACH_CLEARANCE) | is_first
    phases = (n[n | f] for n, f in zip(near, far, strict=True))  # of each robot, without the frames in between
    return sum(int(np.sum(np.diff(phase.astype(int), prepend=0) > 0)) for phase in phases)


def read_rounds(folder: Path) -> list[Walk]:
    """Read the walks of all rounds in the folder of a finished `run`."""
    rounds = sorted((folder / "walks").glob("round-*"), key=lambda path: int(path.name.partition("-")[2]))
    return [walk for number, path in enumerate(rounds) for walk in _read_round(path, number)]


def read_all_walks(inputs: Mapping[str, Path]) -> list[Walk]:
    """Read all walks of a run folder: the teacher's demonstrations and the navigator's own walks."""
    if "collect" not in inputs:
        raise InputError("expected a run with recorded walks to train on, got none; name one with --run")
    return episodes.read(inputs["collect"] / "episodes") + read_rounds(inputs["train"])


def split_rooms(walks: Sequence[Walk], seed: int) -> tuple[list[Walk], list[Walk], list[Walk]]:
    """Split segments by room into training data, test data (choose the best epoch) and unseen data (score the fit)."""
    train, held_out = sequences.split_by_room(walks, HELD_OUT_FRACTION, seed)
    return train, *sequences.split_by_room(held_out, 0.5, seed)


def _run_round(
    folder: Path,
    robot: closed_loop.Params,
    walks: list[Walk],
    settings: DaggerSettings,
    *,
    seed: int,
    number: int,
    variant: names.Variant,
    camera_faults: Sequence[FaultName],
) -> list[Walk]:
    """Fit the navigator to all walks so far, roll it out for one episode, and return its labelled walks."""
    path = folder / "walks" / f"round-{number}"
    place = f"DAgger round {number + 1}"
    if not distributed.share(f"{place}: start", lambda: recording.is_recorded(path, settings.robots)):
        train, test = sequences.split_by_room(episodes.segments(walks), HELD_OUT_FRACTION, seed)
        fit = behaviour_cloning.fit(
            navigator.create(jax.random.key(seed), variant),
            train,
            test,
            behaviour_cloning.Settings(epochs=settings.round_epochs),
            checkpoints=folder / "checkpoints" / f"round-{number}",
        )
        rescaled = distributed.share_arrays(f"{place}: navigator", behaviour_cloning.rescale_turns(fit.best, test))
        learner = assembly.with_policy(robot, "learned", rescaled)
        recording.record_rollouts(
            path,
            learner,
            randomisation.training_rooms(seed, FIRST_LEARNER_EPISODE + number, settings.robots, camera_faults),
            settings.round_seconds,
            policies.LEARNED,
            seed=seed,
            parameters={
                "seconds": settings.round_seconds,
                "round": number,
                "robot": assembly.fingerprint(learner),
                **_name_faults(camera_faults),
            },
            label=f"DAgger round {number + 1} of {settings.dagger_rounds}",
        )
    return _read_round(path, number)


def _walk_with_gain(
    folder: Path,
    robot: closed_loop.Params,
    params: navigator.Params,
    rooms: closed_loop.Room,
    settings: TrainSettings,
    *,
    turn_gain: float,
    seed: int,
    faults: Sequence[FaultName],
) -> closed_loop.Record:
    """Record walks of a navigator whose turns were rescaled."""
    learner = assembly.with_policy(robot, "learned", params)
    return recording.record_rollouts(
        folder / "walks" / f"caution-{turn_gain:g}",
        learner,
        rooms,
        settings.turn_gain_seconds,
        policies.LEARNED,
        seed=seed,
        parameters={
            "caution": turn_gain,
            "seconds": settings.turn_gain_seconds,
            "robot": assembly.fingerprint(learner),
            **_name_faults(faults),
        },
        label=f"turn gain {turn_gain:g}",
    )


def _name_faults(camera_faults: Sequence[FaultName]) -> JsonObject:
    """Return what distinguishes walks with faulty cameras from others; nothing for those without."""
    return {"camera_faults": list(camera_faults)} if camera_faults else {}


def _read_round(path: Path, number: int) -> list[Walk]:
    """Read the walks of a round, with room numbers that differ from those of all other rounds."""
    walks, episode = episodes.read(path), FIRST_LEARNER_EPISODE + number
    return [replace(walk, episode=episode, room=episode * len(walks) + walk.room) for walk in walks]
