"""Every looming detector steers the same robot, with a navigator that is trained in the same way.

Stages of a run folder (`lgmdjax.runtime.run_folders`), so that an interrupted comparison resumes:

| stage           | what it does                                                                                     |
| --------------- | ------------------------------------------------------------------------------------------------ |
| walks           | records walks of the teacher, without pictures: for the calibration, and as demonstrations       |
| detector-<name> | calibrates the detector on these walks (`lgmdjax.learning.detector_calibration`), trains a       |
|                 | navigator for each seed by DAgger, and records its walks in the worlds (`lgmdjax.bench.worlds`)  |
| references      | the teacher, which steers by the laser, and the robot that walks straight on, in the same rooms  |
| scores          | scores.json, a row for each of these                                                             |

All detectors get the same rooms, walks of the teacher, rounds and epochs; seed k has other rooms for training and other
initial weights, and the same rooms for the scores. The detector `robot` is the robot's own LGMD, with the constants,
cells and weights by bearing that it was trained with; every other one has its published constants and those of the
calibration.

The ideal observers `eta` and `tau` are left out. They need size and expansion of one object; in a room many surfaces
are in the way at once, and the nearest one changes from frame to frame. The upper bound here is the teacher.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from lgmdjax.bench import cost, stages, teacher_walks, worlds
from lgmdjax.bench.settings import CAMERA_FAULTS, ClosedLoopSettings
from lgmdjax.bench.stages import OWN, SCORES, WALKS, StageSettings
from lgmdjax.control import navigator, policies
from lgmdjax.evaluation import metrics, stimulus_scores
from lgmdjax.learning import behaviour_cloning, dagger, detector_calibration, detector_responses
from lgmdjax.runtime import storage
from lgmdjax.runtime.run_folders import Stage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, rerender, room_batches

REFERENCES = "references"


def plan(
    robot: closed_loop.Params, names: Sequence[str], size: ClosedLoopSettings
) -> tuple[list[Stage], dict[str, StageSettings[ClosedLoopSettings]]]:
    """Return the stages of a comparison, in order, and their settings by name."""
    robot = assembly.with_resolution(robot, size.benchmark.eyes)
    made, settings = stages.plan(robot, names, size, record_walks, train_and_score)
    made.append(Stage(name=REFERENCES, run=partial(score_references, robot)))
    made.append(Stage(name=SCORES, run=gather, inputs=tuple(stage.name for stage in made[1:])))
    return made, settings | {REFERENCES: settings[WALKS], SCORES: settings[WALKS]}


def record_walks(
    robot: closed_loop.Params,
    folder: Path,
    _: Mapping[str, Path],
    settings: StageSettings[ClosedLoopSettings],
    seed: int,
) -> None:
    """Record the teacher's walks, without pictures: of the calibration, and the demonstrations of each seed."""
    size = settings.size
    teacher_walks.record_turning(folder / "calibration", robot, size.calibration, seed)
    for repeat in range(size.seeds):
        teacher_walks.record(folder / f"demonstrations-{repeat}", robot, size.demonstrations, seed + repeat, 0)


def train_and_score(
    robot: closed_loop.Params,
    folder: Path,
    inputs: Mapping[str, Path],
    settings: StageSettings[ClosedLoopSettings],
    seed: int,
) -> None:
    """Write calibration.json and scores.json of one detector, its navigators, and their walks."""
    size, name = settings.size, settings.detector
    calibrated, candidates = _calibrate(robot, inputs[WALKS] / "calibration", settings, seed)
    storage.write_json(folder / "calibration.json", candidates)
    learners, fits = [], []
    for repeat in range(size.seeds):
        learner, fit = train(folder / f"seed-{repeat}", calibrated, inputs[WALKS], size, seed, repeat=repeat)
        learners.append(learner)
        fits.append(fit)
    row = {"detector": name, "microseconds": cost.measure(calibrated), "fits": fits}
    row |= {"calibration": next((each for each in candidates if each["chosen"]), None)}
    for world in worlds.WORLDS:
        records = [
            _record_in(
                folder / f"seed-{repeat}" / world, learner, world, policies.LEARNED, size=size, seed=seed, name=name
            )
            for repeat, learner in enumerate(learners)
        ]
        row[world] = summarise(world, records, size)
    storage.write_json(folder / "scores.json", row)


def _calibrate(
    robot: closed_loop.Params, walks: Path, settings: StageSettings[ClosedLoopSettings], seed: int
) -> tuple[closed_loop.Params, list[JsonObject]]:
    """Return the robot with the calibrated detector, and the candidates; the robot's own LGMD stays as it is."""
    if settings.detector == OWN:
        return robot, []
    setup = stimulus_scores.get_detector(settings.detector)
    record, pictures = teacher_walks.read_turning(walks, robot, settings.size.calibration, seed)
    return detector_calibration.calibrate(robot, setup.detector, setup.hemifield(), record, pictures)


def train(
    folder: Path, robot: closed_loop.Params, walks: Path, size: ClosedLoopSettings, seed: int, *, repeat: int
) -> tuple[closed_loop.Params, JsonObject]:
    """Train a navigator by DAgger; return the robot with it, and how well it explains labels in held-out rooms."""
    own = seed + repeat
    demonstrations = episodes.read(walks / f"demonstrations-{repeat}")
    rooms = room_batches.training_rooms(own, 0, size.demonstrations.robots)
    pictures = rerender.render_walks(robot.camera, rooms.arena, episodes.stack_walks(demonstrations))
    demonstrations = detector_responses.with_responses(demonstrations, robot.controller, pictures)
    recorded = dagger.run(folder, robot, demonstrations, size.dagger, own)
    learned, test = dagger.fit_navigator(folder / "checkpoints" / "last", recorded, size.dagger.epochs, own)
    _, _, unseen = dagger.split_rooms(episodes.segments(recorded), own)
    rescaled = behaviour_cloning.rescale_turns(learned, test)
    navigator.save(folder / "navigator.safetensors", rescaled, {"seed": own})
    return assembly.with_policy(robot, "learned", rescaled), behaviour_cloning.score(learned, unseen)


def score_references(
    robot: closed_loop.Params,
    folder: Path,
    _: Mapping[str, Path],
    settings: StageSettings[ClosedLoopSettings],
    seed: int,
) -> None:
    """Write scores.json of the robots that need no detector, in the worlds without camera faults."""
    rows = []
    for policy in (policies.TEACHER, policies.BLIND):
        row: JsonObject = {"detector": policy.name}
        for world in (worlds.ROOMS, worlds.SCENES):
            place = folder / f"{policy.name}-{world}"
            record = _record_in(place, robot, world, policy, size=settings.size, seed=seed, name=policy.name)
            row[world] = summarise(world, [record], settings.size)
        rows.append(row)
    storage.write_json(folder / "scores.json", rows)


def _record_in(
    folder: Path,
    robot: closed_loop.Params,
    world: str,
    policy: policies.Policy,
    *,
    size: ClosedLoopSettings,
    seed: int,
    name: str,
) -> closed_loop.Record:
    """Record the walks of a robot in a world."""
    rooms, seconds = worlds.sample(world, size, seed)
    faults = CAMERA_FAULTS.get(world, ())
    return recording.record_rollouts(
        folder,
        robot,
        rooms,
        seconds,
        policy,
        seed=seed,
        parameters={"world": world, "faults": list(faults), "robot": assembly.fingerprint(robot)},
        label=f"{name}, {world}",
    )


def summarise(world: str, records: Sequence[closed_loop.Record], size: ClosedLoopSettings) -> JsonObject:
    """Return the scores of the walks of all seeds together; in random rooms also the collisions of each seed."""
    if world == worlds.SCENES:
        return worlds.summarise_scenes(records, size.scenes)
    each = [asdict(metrics.score(record).per_100_m) for record in records]
    return asdict(metrics.score(worlds.concatenate(records))) | {"each_per_100_m": each}


def gather(folder: Path, inputs: Mapping[str, Path], settings: StageSettings[ClosedLoopSettings], seed: int) -> None:
    """Write scores.json: the rows of all detectors, and of the references."""
    rows = []
    for stage, place in inputs.items():
        found = storage.read_json(place / "scores.json")
        rows += found if stage == REFERENCES else [found]
    storage.write_json(folder / "scores.json", rows)
