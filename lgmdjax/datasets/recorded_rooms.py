"""Rooms of recorded walks, made again from seeds: walks hold no rooms, but their header says how to make them.

| header has  | walks of                        | rooms                                |
| ----------- | ------------------------------- | ------------------------------------ |
| trial       | `lgmdjax trial`, stage evaluate | `trials.sample_rooms`                |
| benchmark   | studies                         | `room_batches.benchmark_rooms`       |
| round       | a round of DAgger               | `room_batches.training_rooms`        |
| robots      | stage collect                   | `room_batches.training_rooms`        |
"""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax

from lgmdjax.errors import InputError
from lgmdjax.evaluation import trials
from lgmdjax.learning import dagger
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors.settings import Resolution
from lgmdjax.simulation import room_batches
from lgmdjax.simulation.episodes import Walk
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.world.arena import Arena


def find_rooms(parameters: JsonObject, walks: Sequence[Walk], recorded: int, folder: Path) -> list[Arena]:
    """Return the room of each walk; raise `InputError` if the header does not say how it was made.

    Args:
        parameters: in the header of the walks.
        walks: some or all walks of a folder.
        recorded: number of all walks of that folder.
        folder: named in the error.
    """
    try:
        sample, count = _sampler(parameters, recorded)
        batches = functools.cache(sample)
        return [_pick(batches(walk.seed, walk.room // count), walk.room % count) for walk in walks]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder}: expected walks of a trial, a study, stage collect or a round of DAgger, got walks recorded "
            f"with {', '.join(parameters) or 'nothing'}; their rooms are not known"
        ) from error


def _sampler(parameters: JsonObject, recorded: int) -> tuple[Callable[[int, int], Arena], int]:
    """Return a function that samples the rooms of a seed and a batch, and the number of rooms in a batch."""
    if "trial" in parameters:
        seeds = int(parameters["seeds"])
        return lambda seed, batch: trials.sample_rooms(parameters["trial"], seeds, seed).arena, seeds
    if "benchmark" in parameters:
        fields = parameters["benchmark"]
        benchmark = BenchmarkRooms(**{**fields, "eyes": Resolution(**fields["eyes"])})
        contrast = float(parameters["contrast"])
        return lambda seed, batch: room_batches.benchmark_rooms(benchmark, seed, contrast).arena, benchmark.robots
    if "round" in parameters:
        episode = dagger.FIRST_LEARNER_EPISODE + int(parameters["round"])
        return lambda seed, batch: room_batches.training_rooms(seed, episode, recorded).arena, recorded
    robots = int(parameters["robots"])
    return lambda seed, batch: room_batches.training_rooms(seed, batch, robots).arena, robots


def _pick(rooms: Arena, row: int) -> Arena:
    return jax.tree.map(lambda leaf: leaf[row], rooms)
