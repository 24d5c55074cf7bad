"""The worlds in which the robots of the comparison are scored: random rooms, scenes, and faults of the cameras.

| world      | rooms                                                                             |
| ---------- | --------------------------------------------------------------------------------- |
| rooms      | held-out random rooms, the same for all robots (`room_batches.benchmark_rooms`)    |
| noise      | the same, with noise of the cameras (`lgmdjax.transfer.faults`)                    |
| all faults | the same, with noise, exposure, blur, JPEG, and pictures that are lost or late     |
| scenes     | rooms of several trials (`lgmdjax.evaluation.trials`), all in one batch            |
"""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.bench.settings import CAMERA_FAULTS, ClosedLoopSettings
from lgmdjax.evaluation import run_trial, trials
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record, Room
from lgmdjax.transfer import randomisation

ROOMS, SCENES = "rooms", "scenes"
WORLDS = (ROOMS, *CAMERA_FAULTS, SCENES)


def sample(world: str, settings: ClosedLoopSettings, seed: int) -> tuple[Room, float]:
    """Return the rooms of a world, one for each robot, and how long the robots walk in them [s]."""
    if world == SCENES:
        rooms = [trials.sample_rooms(trial, count, seed) for trial, count in settings.scenes.items()]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *rooms), settings.scene_seconds
    rooms = room_batches.benchmark_rooms(settings.benchmark, seed)
    if world == ROOMS:
        return rooms, settings.benchmark.seconds
    some = jax.tree.map(lambda leaf: leaf[: settings.faults.robots], rooms)
    return randomisation.randomise_cameras(some, CAMERA_FAULTS[world]), settings.faults.seconds


def split_scenes(record: Record, scenes: Mapping[TrialName, int]) -> dict[str, Record]:
    """Return the walks of each scene, until its trial ends, from those of the world `scenes`."""
    parts, first = {}, 0
    for trial, count in scenes.items():
        robots, frames = slice(first, first + count), round(trials.TRIALS[trial].seconds * FRAME_RATE)
        parts[trial] = jax.tree.map(lambda leaf, robots=robots, frames=frames: leaf[robots, :frames], record)
        first += count
    return parts


def summarise_scenes(records: Sequence[Record], scenes: Mapping[TrialName, int]) -> dict[str, JsonObject]:
    """Return the outcomes of each scene, with the robots of all records."""
    split = [split_scenes(record, scenes) for record in records]
    return {
        trial: run_trial.summarise(trials.TRIALS[trial], concatenate([parts[trial] for parts in split]))
        for trial in scenes
    }


def concatenate(records: Sequence[Record]) -> Record:
    """Return one record of all robots."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *records)
