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
from typing import get_args

import jax

from lgmdjax.errors import InputError
from lgmdjax.evaluation import trials
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.learning import dagger
from lgmdjax.runtime import schema
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors.settings import Resolution
from lgmdjax.simulation import room_batches
from lgmdjax.simulation.episodes import Walk
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.world.arena import Arena

Sampler = Callable[[int, int], Arena]
"""Samples the rooms of a seed and a batch."""

MAX_ROUND = 2**18  # of DAgger; later ones would have the rooms of other episodes
COUNT = schema.Integer(1, 10_000)  # of rooms: they are all made, also to show one
HEADERS = {
    "trial": schema.Object({"trial": schema.Text(get_args(TrialName)), "seeds": COUNT}),
    "benchmark": schema.Object(
        {"benchmark": schema.Object({"robots": COUNT}), "contrast": schema.Number(0, 100)},
    ),
    "round": schema.Object({"round": schema.Integer(0, MAX_ROUND)}),
    "robots": schema.Object({"robots": COUNT}),
}
"""Schema of the header by the first of its names, in this order."""


def find_rooms(parameters: JsonObject, walks: Sequence[Walk], recorded: int, folder: Path) -> list[Arena]:
    """Return the room of each walk; raise `InputError` if the header does not say how it was made.

    Args:
        parameters: in the header of the walks.
        walks: some or all walks of a folder.
        recorded: number of all walks of that folder.
        folder: named in the error.
    """
    kind = check_header(parameters, folder)
    sample, count = _sampler(kind, parameters, recorded)
    batches = functools.cache(sample)
    return [_pick(batches, walk, count, folder) for walk in walks]


def check_header(parameters: JsonObject, folder: Path) -> str:
    """Return the kind of walks, a key of `HEADERS`; raise `InputError` if their rooms cannot be made again."""
    kind = next((name for name in HEADERS if name in parameters), None)
    if kind is None:
        raise InputError(
            f"{folder}: expected walks of a trial, a study, stage collect or a round of DAgger, got walks recorded "
            f"with {', '.join(parameters) or 'nothing'}; their rooms are not known"
        )
    schema.check(HEADERS[kind], parameters, f"{folder}: header", "their rooms are not known")
    return kind


def _sampler(kind: str, parameters: JsonObject, recorded: int) -> tuple[Sampler, int | None]:
    """Return a sampler, and the number of rooms in a batch; None if one batch holds all rooms."""
    if kind == "trial":
        return lambda seed, _: trials.sample_rooms(parameters["trial"], parameters["seeds"], seed).arena, None
    if kind == "benchmark":
        robots, contrast = parameters["benchmark"]["robots"], float(parameters["contrast"])
        benchmark = BenchmarkRooms(eyes=Resolution(width=1, height=1), robots=robots, seconds=1)  # rooms have neither
        return lambda seed, _: room_batches.benchmark_rooms(benchmark, seed, contrast).arena, None
    if kind == "round":
        episode = dagger.FIRST_LEARNER_EPISODE + parameters["round"]
        return lambda seed, _: room_batches.training_rooms(seed, episode, recorded).arena, None
    robots = parameters["robots"]
    return lambda seed, batch: room_batches.training_rooms(seed, batch, robots).arena, robots


def _pick(sample: Sampler, walk: Walk, count: int | None, folder: Path) -> Arena:
    """Return the room of a walk; raise `InputError` for a number that no room of its batch has."""
    batch, row = divmod(walk.room, count) if count else (0, walk.room)
    rooms = sample(walk.seed, batch)
    if row >= len(rooms.start):
        raise InputError(
            f"{folder}: expected rooms 0 to {len(rooms.start) - 1}, got room {row}; its walks have another header"
        )
    return jax.tree.map(lambda leaf: leaf[row], rooms)
