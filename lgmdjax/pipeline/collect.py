"""Stage collect: calibrate the LGMD on first walks, then record the teacher's walks in many rooms.

Writes calibration.json and episodes/*.parquet, one file for each episode. The rooms of an episode depend on the seed
and its number only, so that an interrupted run resumes with the episode that was interrupted, and several processes of
a run (`lgmdjax.runtime.distributed`) record different episodes at once.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lgmdjax.control import braitenberg, policies
from lgmdjax.detectors import lgmd
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.pipeline.settings import CollectSettings
from lgmdjax.runtime import distributed
from lgmdjax.runtime.storage import JsonObject, write_json
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, rollout, room_batches
from lgmdjax.simulation.assembly import load_detector
from lgmdjax.transfer import randomisation
from lgmdjax.transfer.names import FaultName

CAMERA_FAULTS = "camera_faults"  # in the header of the episodes, if there are any
CALIBRATION_EPISODE = 2**20  # an episode number beyond all others: its rooms are used nowhere else


def run(folder: Path, inputs: Mapping[str, Path], settings: CollectSettings, seed: int) -> None:
    """Calibrate the detector, then record every episode that is not on disk yet."""
    gait = inputs["fit-gait"]
    calibration = folder / "calibration.json"

    def calibrate() -> None:
        if not calibration.exists():
            write_json(calibration, _calibrate(gait, settings, seed))

    distributed.only_first("collect: calibration", calibrate)
    distributed.await_files([calibration])
    detector = load_detector(folder)
    params = _teacher_robot(gait, settings, detector)
    model = closed_loop.build_model(params)
    writer = episodes.Writer(folder / "episodes", _parameters(settings, detector))
    with recording.dealt_chunks(writer, settings.episodes) as own:
        for episode in own:
            label = f"collect: episode {episode + 1} of {settings.episodes}"
            rooms = randomisation.training_rooms(seed, episode, settings.robots, settings.camera_faults)
            chunks = recording.rollout_with_progress(params, model, rooms, settings.seconds, label)
            record = rollout.concatenate_time(list(chunks))
            numbers = episode * settings.robots + np.arange(settings.robots)
            writer.write(record, episode=episode, rooms=numbers.tolist(), seed=seed, number=episode)


def read_camera_faults(header: JsonObject) -> tuple[FaultName, ...]:
    """Return the faults that the cameras of recorded walks may have."""
    return tuple(header.get(CAMERA_FAULTS, ()))


def _calibrate(gait: Path, settings: CollectSettings, seed: int) -> JsonObject:
    """Record walks of the teacher without rendering, render them for all candidates, and select the thresholds."""
    detector = assembly.fit_detector(lgmd.Params(), settings.eyes)
    params = assembly.with_teacher(_teacher_robot(gait, settings, detector), lgmd_grid_search.CALIBRATION_RULE)
    rooms, model = (
        room_batches.training_rooms(seed, CALIBRATION_EPISODE, settings.robots),
        closed_loop.build_model(params),
    )
    seconds = settings.calibration_seconds
    chunks = recording.rollout_with_progress(params, model, rooms, seconds, "calibrate", render=False)
    record = rollout.concatenate_time(list(chunks))
    candidates, camera_params = lgmd_grid_search.candidate_grid(), params.camera
    print("calibrate: rendering the walks for all candidates of T_s and W_I", flush=True)
    u, feed_forward = lgmd_grid_search.evaluate(detector, camera_params, rooms.arena, record, candidates)
    selection = lgmd_grid_search.select(record, np.asarray(u), np.asarray(feed_forward), candidates)
    field = {name: getattr(settings.eyes, name) for name in ("overlap", "ground", "falloff", "pooling")}
    return dataclasses.asdict(selection) | field


def _teacher_robot(gait: Path, settings: CollectSettings, detector: lgmd.Params) -> closed_loop.Params:
    robot = assembly.assemble_robot(gait, settings.eyes, detector, assembly.make_policies())
    return assembly.select_policy(robot, policies.TEACHER)


def _parameters(settings: CollectSettings, detector: lgmd.Params) -> JsonObject:
    """Return the header of the episodes; room i of episode k is the i-th of `training_rooms(seed, k, robots)`."""
    settings_used = {name: getattr(settings, name) for name in ("robots", "seconds")}
    constants = {name: getattr(detector, name) for name in lgmd.SCALARS}
    teacher = dataclasses.asdict(braitenberg.Params())
    header = settings_used | {"eyes": dataclasses.asdict(settings.eyes), "lgmd": constants, "teacher": teacher}
    return header | ({CAMERA_FAULTS: list(settings.camera_faults)} if settings.camera_faults else {})
