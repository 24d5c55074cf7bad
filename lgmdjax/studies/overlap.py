"""How much of its picture should each LGMD look at? Printed by `python experiments/overlap.py`; no stage of a run.

Asks it twice, for eyes that look at half of their picture (0.5) up to all of it (1.0):

- Walks that `lgmdjax collect` recorded are drawn once more, and scored as `lgmdjax.learning.lgmd_grid_search` does: by
  how well the difference of the two u, averaged over about a gait cycle, follows the difference of nearness.
- Blind robots walk straight at the tube of fig. 14. In which share of the walks is the eye on its side the louder,
  while it is `AHEAD` away? What both eyes see tells nothing about sides, and from afar that is all that is ahead.
"""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import tyro

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.detectors import lgmd
from lgmdjax.evaluation import trials
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.runtime.storage import read_json
from lgmdjax.sensors import camera
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, episodes, recording, room_batches
from lgmdjax.simulation.closed_loop import Params, Record
from lgmdjax.world import arena

OVERLAPS = (0.5, 0.6, 0.7, 0.8, 1.0)
AHEAD = (0.9, 0.7)  # m, from the trunk to the middle of the tube
SECONDS = 12.0  # until then


def main(
    run: tyro.conf.Positional[Path], robots: int = 8, seeds: int = 4, overlaps: Sequence[float] = OVERLAPS
) -> None:
    """Print for each overlap the score of every episode, and the share of the walks at the tube.

    Args:
        run: a run folder whose stage collect is done
        robots: how many of an episode's robots to look through the eyes of
        seeds: of the walks at the tube, 30 each
        overlaps: fractions of the picture's width
    """
    facts = read_json(run / "run.json")
    settings, seed = facts["settings"]["collect"], facts["seed"]
    robot = assembly.robot(
        run / "fit-gait",
        CameraSettings(**settings["eyes"]),
        assembly.load_detector(run / "collect"),
        assembly.everyone(),
    )
    walks, numbers = episodes.read(run / "collect" / "episodes"), range(settings["episodes"])
    records = [episodes.batched([walk for walk in walks if walk.episode == number][:robots]) for number in numbers]
    rooms = [room_batches.rooms_of(seed, number, settings["robots"]).arena for number in numbers]
    rooms = jax.tree.map(lambda leaf: leaf[:robots], rooms)
    rows: list[tuple[str, ...]] = [("overlap", *(f"episode {number}" for number in numbers), "tube")]
    for overlap in overlaps:
        looking = assembly.with_eyes(robot, CameraSettings(**settings["eyes"] | {"overlap": overlap}))
        detector, eyes = looking.controller.lgmd, looking.camera
        scores = [score(detector, eyes, *walked) for walked in zip(rooms, records, strict=True)]
        rows.append((f"{overlap:g}", *(f"{number:.3f}" for number in (*scores, told_apart(looking, seeds, seed)))))
    for row in rows:
        print(*(f"{cell:<11}" for cell in row))


def score(detector: lgmd.Params, eyes: camera.Params, rooms: arena.Arena, record: Record) -> float:
    """Correlate left minus right u with left minus right nearness, over recorded walks."""
    alone = lgmd_grid_search.grid([float(detector.threshold)], [float(detector.inhibition)])
    u, feed_forward = lgmd_grid_search.survey(detector, eyes, rooms, record, alone)
    return lgmd_grid_search.choose(record, np.asarray(u), np.asarray(feed_forward), alone).table[0]["score"]


def told_apart(robot: Params, seeds: int, seed: int) -> float:
    """Walk straight at the tube; give the share of the walks in which the eye on its side is the louder."""
    rooms = trials.draw_rooms("tube", seeds, seed)
    blind = assembly.seat(robot, policies.BLIND)
    crowds = recording.crowds(blind, hexapod.build(), rooms, SECONDS, f"overlap {robot.camera.overlap:g}")
    side = np.asarray(rooms.arena.handedness)  # 1: the tube is to the left
    aside = np.resize(np.repeat(trials.LATERALS, 2), len(side)) > 0
    louder = []
    for numbers, record in crowds:
        ahead = trials.TUBE - np.asarray(record.position)[..., 0]
        there = (ahead < AHEAD[0]) & (ahead > AHEAD[1])
        u = np.asarray(record.u)
        louder += list(np.sum((u[..., 0] - u[..., 1]) * there, axis=1) * side[numbers] > 0)
    return float(np.mean(np.array(louder)[aside]))
