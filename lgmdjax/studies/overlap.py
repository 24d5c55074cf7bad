"""How wide should the field of view of each detector be? From half of the picture (0.5) up to all of it (1.0).

| measure  | meaning                                                                                          |
| -------- | ------------------------------------------------------------------------------------------------ |
| episodes | correlation of left minus right u with left minus right proximity, over recorded walks that are  |
|          | rendered again; averaged over about a gait cycle, as in `lgmdjax.learning.lgmd_grid_search`      |
| tube     | share of walks toward the tube of fig. 14 in which the detector on the tube's side responds more |
|          | strongly, while the tube is `TUBE_DISTANCES` away                                                |

What both cameras see does not distinguish the sides, and a far obstacle ahead is seen by both.

Writes overlap.json, a row for each overlap: overlap, one score for each recorded episode, and the share for the tube.
Needs a run whose stage collect is done.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from lgmdjax.control import policies
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation import trials
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly, episodes, recording, room_batches
from lgmdjax.simulation.closed_loop import Params, Record
from lgmdjax.studies.settings import OverlapSettings
from lgmdjax.world import arena

TUBE_DISTANCES = (0.9, 0.7)  # m, from the trunk to the middle of the tube
SECONDS = 12.0  # of a walk toward the tube


def run(folder: Path, inputs: Mapping[str, Path], settings: OverlapSettings, seed: int) -> None:
    """Score every overlap on the recorded walks and in front of the tube."""
    if "collect" not in inputs:
        raise InputError("expected a run whose recorded walks can be rendered again, got none; name one with --run")
    header = episodes.read_parameters(inputs["collect"] / "episodes")
    detector = assembly.load_detector(inputs["collect"])
    camera_settings = assembly.read_camera_settings(header)
    robot = assembly.assemble_robot(inputs["fit-gait"], camera_settings, detector, assembly.make_policies())
    recorded = _recorded(inputs["collect"] / "episodes", header["robots"], settings.robots)
    rows = []
    for overlap in settings.overlaps:
        changed = assembly.with_camera(robot, replace(camera_settings, overlap=overlap))
        scores = [proximity_correlation(changed.controller.detector, changed.camera, *walks) for walks in recorded]
        tube = side_accuracy(folder / f"tube-{overlap:g}", changed, settings.seeds, seed)
        rows.append({"overlap": overlap, "episodes": scores, "tube": tube})
    storage.write_json(folder / "overlap.json", rows)


def _recorded(folder: Path, room_count: int, robots: int) -> list[tuple[arena.Arena, Record]]:
    """Read the first `robots` walks of every episode, with their rooms."""
    walks = episodes.read(folder)
    recorded = []
    for episode in sorted({walk.episode for walk in walks}):
        some = [walk for walk in walks if walk.episode == episode][:robots]
        rooms = room_batches.training_rooms(some[0].seed, episode, room_count).arena
        recorded.append((jax.tree.map(lambda leaf: leaf[:robots], rooms), episodes.stack_walks(some)))
    return recorded


def proximity_correlation(
    detector: lgmd.Params, camera_params: camera.Params, rooms: arena.Arena, record: Record
) -> float:
    """Correlate left minus right u with left minus right proximity, over recorded walks that are rendered again."""
    candidate = lgmd_grid_search.candidate_grid([float(detector.threshold)], [float(detector.inhibition)])
    u, feed_forward = lgmd_grid_search.evaluate(detector, camera_params, rooms, record, candidate)
    return lgmd_grid_search.select(record, np.asarray(u), np.asarray(feed_forward), candidate).table[0]["score"]


def side_accuracy(folder: Path, robot: Params, seeds: int, seed: int) -> float:
    """Return the share of walks in which the detector on the tube's side responds more strongly.

    Robots walk straight toward the tube. Walks with the tube straight ahead do not count.
    """
    rooms = trials.sample_rooms("tube", seeds, seed)
    parameters = {"overlap": robot.camera.overlap, "seeds": seeds, "robot": assembly.fingerprint(robot)}
    label = f"overlap {robot.camera.overlap:g}"
    record = recording.record_rollouts(
        folder, robot, rooms, SECONDS, policies.BLIND, seed=seed, parameters=parameters, label=label, render=True
    )
    side = np.asarray(rooms.arena.handedness)  # 1: the tube is to the left
    aside = np.resize(np.repeat(trials.LATERAL_OFFSETS, 2), len(side)) > 0
    distance = trials.TUBE_DISTANCE - np.asarray(record.position)[..., 0]
    measured = (distance < TUBE_DISTANCES[0]) & (distance > TUBE_DISTANCES[1])
    u = np.asarray(record.u)
    correct = np.sum((u[..., 0] - u[..., 1]) * measured, axis=1) * side > 0
    return float(np.mean(correct[aside]))


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot the scores of every episode and the share for the tube against the overlap; rows as in overlap.json."""
    figure = Figure(figsize=(style.WIDTH, 2.6), layout="constrained")
    correlation, accuracy = figure.subplots(1, 2)
    overlap = [row["overlap"] for row in rows]
    for scores in zip(*(row["episodes"] for row in rows), strict=True):
        correlation.plot(overlap, scores, "o-", color=style.GREY, markersize=3, linewidth=1)
    correlation.plot(overlap, [np.mean(row["episodes"]) for row in rows], "o-", color=style.DARK, label="mean")
    correlation.set(
        xlabel="share of the picture that a detector gets", ylabel="r of u with proximity, left minus right"
    )
    correlation.legend()
    accuracy.plot(overlap, [100 * row["tube"] for row in rows], "o-", color=style.DARK)
    accuracy.set(
        xlabel="share of the picture that a detector gets", ylabel="correct side of the tube [%]", ylim=(0, 104)
    )
    return figure
