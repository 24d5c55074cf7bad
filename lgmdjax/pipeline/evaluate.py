"""Stage evaluate: all policies in the paper's experiments, each in the same rooms from the same start poses.

| file                     | contents                                                                        |
| ------------------------ | ------------------------------------------------------------------------------- |
| evaluation.json          | the summary of every trial and policy                                           |
| trajectories.npz         | fig. 13                                                                         |
| <trial>.svg              | figs. 14 to 16                                                                  |
| kinds.json               | causes of the learned policy's collisions                                       |
| walk.npz                 | the walk of the video                                                           |
| layers.npz               | fig. 6b                                                                         |
| <trial>/<policy>/        | the walks, in Parquet; an interrupted run resumes after the last finished batch |
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from lgmdjax.body.robot_xml import Body
from lgmdjax.control.names import PolicyName
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation import collision_causes, run_trial, trials
from lgmdjax.evaluation.settings import TrialPlan
from lgmdjax.pipeline.settings import EvaluateSettings
from lgmdjax.reporting import selection
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import distributed
from lgmdjax.runtime.storage import write_arrays, write_json
from lgmdjax.sensors import camera
from lgmdjax.sensors.settings import Resolution
from lgmdjax.simulation import assembly, closed_loop, episodes, rerender
from lgmdjax.world import scenes

Records = Mapping[str, Mapping[str, closed_loop.Record]]  # by trial and policy


def run(folder: Path, inputs: Mapping[str, Path], settings: EvaluateSettings, seed: int) -> None:
    """Record every policy in every trial, summarise the walks, and save what the figures need."""
    robot = assembly.load_robot(inputs["fit-gait"], inputs["train"])
    records = {
        plan.trial: {policy: _record(folder, plan, robot, policy, seed) for policy in plan.policies}
        for plan in settings.trials
    }
    if distributed.is_first():
        with distributed.alone():
            _write(folder, settings, records, robot, seed)


def _write(folder: Path, settings: EvaluateSettings, records: Records, robot: closed_loop.Params, seed: int) -> None:
    """Summarise the walks, and save what the figures need."""
    results = {
        trial: {policy: run_trial.summarise(trials.TRIALS[trial], record) for policy, record in by_policy.items()}
        for trial, by_policy in records.items()
    }
    write_json(folder / "evaluation.json", results)
    for plan in settings.trials:
        trial = trials.TRIALS[plan.trial]
        if trial.ends_at_contact:
            rooms = trials.sample_rooms(trial.name, plan.seeds, seed)
            figure = run_trial.plot_trial(trial, rooms, records[trial.name]["learned"])
            (folder / f"{trial.name}.svg").write_bytes(style.to_svg(figure))
    write_json(folder / "kinds.json", _collision_causes(settings, records, seed, robot.body))
    continuing = {trial: some for trial, some in records.items() if not trials.TRIALS[trial].ends_at_contact}
    write_arrays(folder / "trajectories.npz", _trajectories(continuing))
    shown = _one(records["testing"]["learned"], selection.select_walk(records["testing"]["learned"]))
    write_arrays(folder / "walk.npz", {name: getattr(shown, name) for name in episodes.FIELDS})
    resolution = next(plan.eyes for plan in settings.trials if plan.trial == "testing")
    write_arrays(folder / "layers.npz", _layers(robot, resolution, shown))


def _record(
    folder: Path, plan: TrialPlan, robot: closed_loop.Params, policy: PolicyName, seed: int
) -> closed_loop.Record:
    """Record one policy in one trial, or read its walks if they are on disk."""
    coarse = None if policy == "learned" else plan.coarse
    robot = run_trial.equip(assembly.with_resolution(robot, coarse or plan.eyes), plan.trial)
    seconds = plan.seconds or trials.TRIALS[plan.trial].seconds
    trial_run = run_trial.describe_run(robot, plan.trial, policy, plan.seeds, seconds)
    return run_trial.record_trial(folder / plan.trial / policy, trial_run, robot, seed)[1]


def _collision_causes(
    settings: EvaluateSettings, records: Records, seed: int, body: Body | None
) -> dict[str, dict[str, int]]:
    """Count the causes of the learned policy's collisions in each trial; empty if it walked too little for that.

    The baseline of u is that of the held-out rooms for every camera, since cells of the same size respond alike.
    """
    try:
        baseline = collision_causes.fit_baseline(records["unseen"]["learned"])
    except InputError:
        return {}
    counts = {}
    for plan in settings.trials:
        trial, record = trials.TRIALS[plan.trial], records[plan.trial]["learned"]
        rooms = trials.sample_rooms(trial.name, plan.seeds, seed)
        collisions = collision_causes.classify(record, rooms.arena, baseline, body)
        if trial.ends_at_contact:
            ends = trials.find_outcome(trial, record).frames
            collisions = [collision for collision in collisions if collision.frame < ends[collision.robot]]
        counts[trial.name] = collision_causes.count_causes(collisions)
    return counts


def _trajectories(records: Records) -> dict[str, np.ndarray]:
    """Return positions, resets and contacts of every trial and policy, by name."""
    arrays = {}
    for trial, by_policy in records.items():
        for policy, record in by_policy.items():
            name = f"{trial}_{policy}"
            arrays |= {name: record.position, f"{name}_resets": record.resets, f"{name}_contact": record.contact}
    return arrays


def _one(record: closed_loop.Record, robot: int) -> closed_loop.Record:
    return jax.tree.map(lambda leaf: leaf[robot], record)


def _layers(robot: closed_loop.Params, resolution: Resolution, walk: closed_loop.Record) -> dict[str, np.ndarray]:
    """Render the frame that excited the left detector most; return its picture and layers (fig. 6b).

    The whole picture is rendered, at the paper's resolution.
    """
    fine = camera.Params(mounts=robot.camera.mounts)
    detector = dataclasses.replace(
        robot.controller.detector, pooling=max(resolution.pooling * fine.width // resolution.width, 1)
    )
    steady = np.where(np.asarray(walk.resets) == walk.resets[-1], walk.excitation[:, 0], 0.0)
    last = max(int(np.argmax(steady)), 2)
    frames = jax.tree.map(lambda leaf: np.asarray(leaf)[None, last - 2 : last + 1], walk)
    room = jax.tree.map(lambda leaf: leaf[None], scenes.testing_room())
    pictures = rerender.render_walks(fine, room, frames)[0, :, 0]
    state, _ = lgmd.step(detector, lgmd.init(detector, pictures[0]), pictures[1])
    layers = lgmd.layers(detector, state, pictures[2])
    named = {"E": layers.excitation, "I": layers.inhibition, "S": layers.summation}
    return {"picture": pictures[2]} | {name: np.asarray(layer) for name, layer in named.items()}
