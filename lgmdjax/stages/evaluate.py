"""Stage evaluate: all five drivers on the same seeds, in the testing room and in rooms that nobody has seen.

Writes evaluation.json (scores), trajectories.npz (fig. 13), walk.npz (the film) and layers.npz (fig. 6b), and one
Parquet folder of walks a place and driver, from which an interrupted run carries on.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lgmdjax import (
    camera,
    cpg,
    drivers,
    episodes,
    hexapod,
    lgmd,
    navigator,
    redraw,
    rollout,
    scales,
    scenes,
    scores,
    simulation,
)
from lgmdjax.files import read_arrays, write_json
from lgmdjax.stages import collect, crew

PLACES = ("testing", "unseen")
ROOMS = 2**21  # far from the numbers of training episodes: these rooms are met nowhere else


def work(folder: Path, inputs: Mapping[str, Path], settings: scales.Evaluate, seed: int) -> None:
    """Walk every driver in both places, score the walks, and keep what the figures need."""
    model, detector = hexapod.build(), collect.load_detector(inputs["collect"])
    params = crew.robot(inputs["fit-gait"], settings.eyes, detector, load_drivers(inputs["train"]))
    places = {"testing": _testing(settings, seed), "unseen": _unseen(settings, seed)}
    walked = {
        place: {
            driver.name: _walk(folder / place / driver.name, params, model, places[place], settings, driver, seed)
            for driver in drivers.ALL
        }
        for place in PLACES
    }
    scored = {
        place: {name: dataclasses.asdict(scores.score(record, cpg.CYCLE_TIME)) for name, record in records.items()}
        for place, records in walked.items()
    }
    write_json(folder / "evaluation.json", scored)
    np.savez(folder / "trajectories.npz", allow_pickle=False, **_trajectories(walked))
    shown = _one(walked["testing"]["learned"], _liveliest(walked["testing"]["learned"]))
    np.savez(folder / "walk.npz", allow_pickle=False, **{name: getattr(shown, name) for name in episodes.FIELDS})
    np.savez(folder / "layers.npz", allow_pickle=False, **_layers(detector, settings.eyes, shown))


def load_drivers(train: Path) -> drivers.Anyone:
    """Seat the navigator that `train` made, and the direct and the random driver as it measured them."""
    learned, _ = navigator.load(train / "controller.safetensors")
    baselines = read_arrays(train / "baselines.npz")
    return crew.everyone(learned, float(baselines["gain"]), baselines["replayed"])


def _testing(settings: scales.Evaluate, seed: int) -> simulation.Room:
    """The paper's testing room: every robot starts at (0, 2.5), facing another way."""
    return rollout.copies(jax.random.key(seed), scenes.testing_room(), settings.robots)


def _unseen(settings: scales.Evaluate, seed: int) -> simulation.Room:
    return collect.rooms_of(seed, ROOMS, settings.robots)


def _walk(
    folder: Path, params: simulation.Params, model: Any, rooms: simulation.Room, settings: scales.Evaluate,
    driver: drivers.Driver, seed: int,
) -> simulation.Record:  # fmt: skip
    """Walk one driver in one place, unless an earlier try did."""
    writer = episodes.Writer(folder, {"driver": driver.name, "settings": dataclasses.asdict(settings)})
    if not writer.chunks:
        sees = driver in (drivers.LEARNED, drivers.DIRECT)
        label = f"evaluate: {driver.name}, {folder.parent.name} room"
        seconds = settings.testing_seconds if folder.parent.name == "testing" else settings.seconds
        chunks = crew.walks(crew.seat(params, driver), model, rooms, seconds, label, draw=sees)
        writer.write(rollout.together(list(chunks)), episode=0, rooms=range(settings.robots), seed=seed)
    return episodes.batched(episodes.read(folder))


def _trajectories(walked: Mapping[str, Mapping[str, simulation.Record]]) -> dict[str, np.ndarray]:
    arrays = {}
    for place, records in walked.items():
        for name, record in records.items():
            key = f"{place}_{name}"
            arrays |= {key: record.position, f"{key}_setbacks": record.setbacks, f"{key}_contact": record.contact}
    return arrays


def _one(record: simulation.Record, robot: int) -> simulation.Record:
    return jax.tree.map(lambda leaf: leaf[robot], record)


def _liveliest(record: simulation.Record) -> int:
    """Pick the robot that turned most without a touch, or with the fewest."""
    turning = np.abs(record.velocity[..., 1] - record.velocity[..., 0]).mean(axis=1)
    return int(np.argmax(turning - 1e3 * record.contact.sum(axis=1) - 1e6 * ~record.ok[:, -1]))


def _layers(detector: lgmd.Params, eyes: scales.Eyes, walk: simulation.Record) -> dict[str, np.ndarray]:
    """Draw the frame of a walk that excited its left eye most, whole and at the paper's resolution, with its layers."""
    fine = camera.Params()
    detector = dataclasses.replace(detector, pooling=max(detector.pooling * fine.width // eyes.width, 1))
    steady = np.where(np.asarray(walk.setbacks) == walk.setbacks[-1], walk.excitation[:, 0], 0.0)
    last = max(int(np.argmax(steady)), 2)
    frames = jax.tree.map(lambda leaf: np.asarray(leaf)[None, last - 2 : last + 1], walk)
    room = jax.tree.map(lambda leaf: leaf[None], scenes.testing_room())
    pictures = redraw.walks(fine, room, frames)[0, :, 0]
    state, _ = lgmd.step(detector, lgmd.init(detector, pictures[0]), pictures[1])
    cells = lgmd.layers(detector, state, pictures[2])
    named = {"E": cells.excitation, "I": cells.inhibition, "S": cells.summation}
    return {"picture": pictures[2]} | {name: np.asarray(layer) for name, layer in named.items()}
