"""Stage collect: choose the LGMD's thresholds on a first walk, then record the teacher's walks in many rooms.

Writes calibration.json and episodes/*.parquet, one file an episode: each has new rooms, drawn from the seed and its
number, so that an interrupted run carries on with the episode that it was at.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lgmdjax import braitenberg, calibration, drivers, episodes, hexapod, lgmd, rollout, scales
from lgmdjax.files import read_json, write_json
from lgmdjax.stages import crew

CHOSEN = ("threshold", "suppression", "inhibition")  # T_s, T_f, W_I
CALIBRATION = 2**20  # an episode number beyond any other: its rooms are met nowhere else


def work(folder: Path, inputs: Mapping[str, Path], settings: scales.Collect, seed: int) -> None:
    """Calibrate, then record every episode that is not there yet."""
    gait = inputs["fit-gait"]
    if not (folder / "calibration.json").exists():
        write_json(folder / "calibration.json", _calibrate(gait, settings, seed))
    detector = load_detector(folder)
    params = crew.seat(crew.robot(gait, settings.eyes, detector, crew.everyone()), drivers.TEACHER)
    model = hexapod.build()
    writer = episodes.Writer(folder / "episodes", _parameters(settings, detector))
    for episode in range(writer.chunks, settings.episodes):
        label = f"collect: episode {episode + 1} of {settings.episodes}"
        rooms = crew.rooms_of(seed, episode, settings.robots)
        record = rollout.together(list(crew.walks(params, model, rooms, settings.seconds, label)))
        numbers = episode * settings.robots + np.arange(settings.robots)
        writer.write(record, episode=episode, rooms=numbers.tolist(), seed=seed)


def load_detector(folder: Path) -> lgmd.Params:
    """Read the detector that `collect` calibrated."""
    chosen = read_json(folder / "calibration.json")
    return lgmd.Params(**{name: chosen[name] for name in CHOSEN})


def _calibrate(gait: Path, settings: scales.Collect, seed: int) -> dict[str, Any]:
    """Walk the teacher with its eyes shut, draw what it would have seen, and choose the thresholds."""
    detector = lgmd.Params(pooling=settings.eyes.pooling)
    shut = crew.robot(gait, settings.eyes, detector, crew.everyone())
    rooms = crew.rooms_of(seed, CALIBRATION, settings.robots)
    walks = crew.walks(
        crew.seat(shut, drivers.TEACHER), hexapod.build(), rooms, settings.calibration_seconds, "calibrate", draw=False
    )
    record = rollout.together(list(walks))
    candidates = calibration.grid()
    print("calibrate: drawing the walks for all candidates of T_s and W_I", flush=True)
    u, feed_forward = calibration.survey(detector, crew.eyes(settings.eyes), rooms.arena, record, candidates)
    choice = calibration.choose(record, np.asarray(u), np.asarray(feed_forward), candidates)
    return dataclasses.asdict(choice) | {"overlap": settings.eyes.overlap, "pooling": settings.eyes.pooling}


def _parameters(settings: scales.Collect, detector: lgmd.Params) -> dict[str, Any]:
    """Tell what an episode was made with; room i of episode k is the i-th of `crew.rooms_of(seed, k, robots)`."""
    made = {name: getattr(settings, name) for name in ("robots", "seconds")}
    constants = {name: getattr(detector, name) for name in CHOSEN}
    teacher = dataclasses.asdict(braitenberg.Params())
    return made | {"eyes": dataclasses.asdict(settings.eyes), "lgmd": constants, "teacher": teacher}
