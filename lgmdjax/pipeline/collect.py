"""Stage collect: choose the LGMD's thresholds on a first walk, then record the teacher's walks in many rooms.

Writes calibration.json and episodes/*.parquet, one file an episode: each has new rooms, drawn from the seed and its
number, so that an interrupted run carries on with the episode that it was at.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, policies
from lgmdjax.detectors import lgmd
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.pipeline.settings import CollectSettings
from lgmdjax.runtime.storage import write_json
from lgmdjax.simulation import assembly, episodes, recording, rollout, room_batches
from lgmdjax.simulation.assembly import CHOSEN, load_detector

CALIBRATION = 2**20  # an episode number beyond any other: its rooms are met nowhere else


def work(folder: Path, inputs: Mapping[str, Path], settings: CollectSettings, seed: int) -> None:
    """Calibrate, then record every episode that is not there yet."""
    gait = inputs["fit-gait"]
    if not (folder / "calibration.json").exists():
        write_json(folder / "calibration.json", _calibrate(gait, settings, seed))
    detector = load_detector(folder)
    params = assembly.seat(assembly.robot(gait, settings.eyes, detector, assembly.everyone()), policies.TEACHER)
    model = hexapod.build()
    writer = episodes.Writer(folder / "episodes", _parameters(settings, detector))
    for episode in range(writer.chunks, settings.episodes):
        label = f"collect: episode {episode + 1} of {settings.episodes}"
        rooms = room_batches.rooms_of(seed, episode, settings.robots)
        record = rollout.together(list(recording.walks(params, model, rooms, settings.seconds, label)))
        numbers = episode * settings.robots + np.arange(settings.robots)
        writer.write(record, episode=episode, rooms=numbers.tolist(), seed=seed)


def _calibrate(gait: Path, settings: CollectSettings, seed: int) -> dict[str, Any]:
    """Walk the teacher with its eyes shut, draw what it would have seen, and choose the thresholds."""
    detector = lgmd.Params(pooling=settings.eyes.pooling)
    shut = assembly.robot(gait, settings.eyes, detector, assembly.everyone())
    rooms = room_batches.rooms_of(seed, CALIBRATION, settings.robots)
    walks = recording.walks(
        assembly.seat(shut, policies.TEACHER),
        hexapod.build(),
        rooms,
        settings.calibration_seconds,
        "calibrate",
        draw=False,
    )
    record = rollout.together(list(walks))
    candidates = lgmd_grid_search.grid()
    print("calibrate: drawing the walks for all candidates of T_s and W_I", flush=True)
    u, feed_forward = lgmd_grid_search.survey(detector, assembly.eyes(settings.eyes), rooms.arena, record, candidates)
    choice = lgmd_grid_search.choose(record, np.asarray(u), np.asarray(feed_forward), candidates)
    return dataclasses.asdict(choice) | {"overlap": settings.eyes.overlap, "pooling": settings.eyes.pooling}


def _parameters(settings: CollectSettings, detector: lgmd.Params) -> dict[str, Any]:
    """Tell what an episode was made with; room i of episode k is the i-th of `crew.rooms_of(seed, k, robots)`."""
    made = {name: getattr(settings, name) for name in ("robots", "seconds")}
    constants = {name: getattr(detector, name) for name in CHOSEN}
    teacher = dataclasses.asdict(braitenberg.Params())
    return made | {"eyes": dataclasses.asdict(settings.eyes), "lgmd": constants, "teacher": teacher}
