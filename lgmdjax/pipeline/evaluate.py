"""Stage evaluate: the drivers in the paper's experiments, each in the same rooms from the same starts.

Writes evaluation.json (what came of every trial and driver), trajectories.npz (fig. 13), <trial>.svg (figs. 14 to 16),
kinds.json (why the learned controller collided), walk.npz (the film) and layers.npz (fig. 6b), and one Parquet folder
of walks a trial and driver, from which an interrupted run carries on with the crowd that it was at.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation import collision_causes, run_trial, trials
from lgmdjax.evaluation.settings import TrialPlan
from lgmdjax.pipeline.settings import EvaluateSettings
from lgmdjax.reporting.figures import style
from lgmdjax.runtime.storage import write_json
from lgmdjax.sensors import camera
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, episodes, rerender
from lgmdjax.world import scenes


def work(folder: Path, inputs: Mapping[str, Path], settings: EvaluateSettings, seed: int) -> None:
    """Walk every driver of every trial, sum the walks up, and keep what the figures need."""
    robot = assembly.trained(inputs["fit-gait"], inputs["train"])
    walked = {
        place.trial: {driver: _walk(folder, place, robot, driver, seed) for driver in place.drivers}
        for place in settings.places
    }
    results = {
        trial: {driver: run_trial.summary(trials.TRIALS[trial], record) for driver, record in records.items()}
        for trial, records in walked.items()
    }
    write_json(folder / "evaluation.json", results)
    for place in settings.places:
        trial = trials.TRIALS[place.trial]
        if trial.ends:
            rooms = trials.draw_rooms(trial.name, place.seeds, seed)
            drawing = run_trial.draw(trial, rooms, walked[trial.name]["learned"])
            (folder / f"{trial.name}.svg").write_bytes(style.to_svg(drawing))
    write_json(folder / "kinds.json", _kinds(settings, walked, seed))
    roaming = {trial: records for trial, records in walked.items() if not trials.TRIALS[trial].ends}
    np.savez(folder / "trajectories.npz", allow_pickle=False, **_trajectories(roaming))
    shown = _one(walked["testing"]["learned"], _liveliest(walked["testing"]["learned"]))
    np.savez(folder / "walk.npz", allow_pickle=False, **{name: getattr(shown, name) for name in episodes.FIELDS})
    eyes = next(place.eyes for place in settings.places if place.trial == "testing")
    np.savez(folder / "layers.npz", allow_pickle=False, **_layers(robot.controller.lgmd, eyes, shown))


def _walk(folder: Path, place: TrialPlan, robot: closed_loop.Params, driver: str, seed: int) -> closed_loop.Record:
    """Walk one driver of one trial, unless an earlier try did."""
    coarse = None if driver == "learned" else place.coarse
    eyed = assembly.with_eyes(robot, coarse or place.eyes)
    seconds = place.seconds or trials.TRIALS[place.trial].seconds
    tried = run_trial.tried(eyed, place.trial, driver, place.seeds, seconds)
    return run_trial.walk(folder / place.trial / driver, tried, eyed, seed)[1]


def _kinds(
    settings: EvaluateSettings, walked: Mapping[str, Mapping[str, closed_loop.Record]], seed: int
) -> dict[str, dict[str, int]]:
    """Count the kinds of the learned controller's collisions in each trial; nothing if it walked too little to tell.

    What u is with nothing near is that of the unseen rooms, whatever the eyes: cells of one size say the same.
    """
    try:
        yardstick = collision_causes.measure(walked["unseen"]["learned"])
    except InputError:
        return {}
    counts = {}
    for place in settings.places:
        trial, record = trials.TRIALS[place.trial], walked[place.trial]["learned"]
        found = collision_causes.find(record, trials.draw_rooms(trial.name, place.seeds, seed).arena, yardstick)
        if trial.ends:
            ends = trials.judge(trial, record).frames
            found = [collision for collision in found if collision.frame < ends[collision.robot]]
        counts[trial.name] = collision_causes.count(found)
    return counts


def _trajectories(walked: Mapping[str, Mapping[str, closed_loop.Record]]) -> dict[str, np.ndarray]:
    arrays = {}
    for place, records in walked.items():
        for name, record in records.items():
            key = f"{place}_{name}"
            arrays |= {key: record.position, f"{key}_setbacks": record.setbacks, f"{key}_contact": record.contact}
    return arrays


def _one(record: closed_loop.Record, robot: int) -> closed_loop.Record:
    return jax.tree.map(lambda leaf: leaf[robot], record)


def _liveliest(record: closed_loop.Record) -> int:
    """Pick the robot that turned most without a touch, or with the fewest."""
    turning = np.abs(record.velocity[..., 1] - record.velocity[..., 0]).mean(axis=1)
    return int(np.argmax(turning - 1e3 * record.contact.sum(axis=1) - 1e6 * ~record.ok[:, -1]))


def _layers(detector: lgmd.Params, eyes: CameraSettings, walk: closed_loop.Record) -> dict[str, np.ndarray]:
    """Draw the frame of a walk that excited its left eye most, whole and at the paper's resolution, with its layers."""
    fine = camera.Params()
    detector = dataclasses.replace(detector, pooling=max(eyes.pooling * fine.width // eyes.width, 1))
    steady = np.where(np.asarray(walk.setbacks) == walk.setbacks[-1], walk.excitation[:, 0], 0.0)
    last = max(int(np.argmax(steady)), 2)
    frames = jax.tree.map(lambda leaf: np.asarray(leaf)[None, last - 2 : last + 1], walk)
    room = jax.tree.map(lambda leaf: leaf[None], scenes.testing_room())
    pictures = rerender.walks(fine, room, frames)[0, :, 0]
    state, _ = lgmd.step(detector, lgmd.init(detector, pictures[0]), pictures[1])
    cells = lgmd.layers(detector, state, pictures[2])
    named = {"E": cells.excitation, "I": cells.inhibition, "S": cells.summation}
    return {"picture": pictures[2]} | {name: np.asarray(layer) for name, layer in named.items()}
