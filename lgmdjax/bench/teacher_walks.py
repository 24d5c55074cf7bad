"""Walks of the teacher in random rooms, recorded without pictures: what detectors are calibrated and fitted on.

The teacher steers by the laser, so one walk serves all detectors; its pictures are rendered when they are needed.
"""

import re
from dataclasses import asdict
from pathlib import Path

from lgmdjax.bench.settings import Walks
from lgmdjax.control import policies
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.learning.detector_responses import Pictures
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, rerender, room_batches

TURNING_EPISODE = 2**21  # of rooms that are used nowhere else


def record(folder: Path, robot: closed_loop.Params, walks: Walks, seed: int, episode: int) -> None:
    """Record the teacher in the training rooms of an episode."""
    recording.record_rollouts(
        folder,
        robot,
        room_batches.training_rooms(seed, episode, walks.robots),
        walks.seconds,
        policies.TEACHER,
        seed=seed,
        parameters={"walks": asdict(walks), "episode": episode, "robot": assembly.fingerprint(robot)},
        label=folder.name,
    )


def record_turning(folder: Path, robot: closed_loop.Params, walks: Walks, seed: int) -> None:
    """Record a teacher that turns away from everything near, so that thresholds are set above what turns cause."""
    record(folder, assembly.with_teacher(robot, lgmd_grid_search.CALIBRATION_RULE), walks, seed, TURNING_EPISODE)


def read_turning(
    folder: Path, robot: closed_loop.Params, walks: Walks, seed: int
) -> tuple[closed_loop.Record, Pictures]:
    """Return these walks, and their pictures with a robot's camera."""
    rooms = room_batches.training_rooms(seed, TURNING_EPISODE, walks.robots)
    found = episodes.stack_walks(episodes.read(folder))
    return found, rerender.render_walks(robot.camera, rooms.arena, found)


def stage_name(detector: str) -> str:
    """Return the name of a detector's stage, which is that of its folder.

    >>> stage_name("my_module:detector")
    'detector-my_module-detector'
    """
    return "detector-" + re.sub(r"[^\w.]+", "-", detector).strip("-")
