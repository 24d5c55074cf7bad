"""How much of its picture should each LGMD look at? `python experiments/overlap.py runs/quick-0` (3 minutes of a core).

Draws walks that `lgmdjax collect` recorded once more, for eyes that look at half of their picture (0.5) up to all of it
(1.0), and scores what the run's detector makes of them as `lgmdjax.calibration` does: by how well the difference of the
two u, averaged over about a gait cycle, follows the difference of nearness.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import tyro

from lgmdjax import arena, calibration, camera, episodes, lgmd, scales
from lgmdjax.files import read_json
from lgmdjax.simulation import Record
from lgmdjax.stages import collect, crew

OVERLAPS = (0.5, 0.6, 0.7, 0.8, 1.0)


def main(run: tyro.conf.Positional[Path], robots: int = 8, overlaps: Sequence[float] = OVERLAPS) -> None:
    """Print the score of each overlap, a column an episode.

    Args:
        run: a run folder whose stage collect is done
        robots: how many of an episode's robots to look through the eyes of
        overlaps: fractions of the picture's width
    """
    facts = read_json(run / "run.json")
    settings, seed = facts["settings"]["collect"], facts["seed"]
    seen = scales.Eyes(**settings["eyes"])
    detector, eyes = replace(collect.load_detector(run / "collect"), pooling=seen.pooling), crew.eyes(seen)
    walks, numbers = episodes.read(run / "collect" / "episodes"), range(settings["episodes"])
    records = [episodes.batched([walk for walk in walks if walk.episode == number][:robots]) for number in numbers]
    rooms = [crew.rooms_of(seed, number, settings["robots"]).arena for number in numbers]
    rooms = jax.tree.map(lambda leaf: leaf[:robots], rooms)
    _print_row("overlap", *(f"episode {number}" for number in numbers))
    for overlap in overlaps:
        looking = replace(eyes, overlap=overlap)
        scores = [score(detector, looking, *walked) for walked in zip(rooms, records, strict=True)]
        _print_row(f"{overlap:g}", *(f"{number:.3f}" for number in scores))


def score(detector: lgmd.Params, eyes: camera.Params, rooms: arena.Arena, record: Record) -> float:
    """Correlate left minus right u with left minus right nearness, over recorded walks."""
    alone = calibration.grid([float(detector.threshold)], [float(detector.inhibition)])
    u, feed_forward = calibration.survey(detector, eyes, rooms, record, alone)
    return calibration.choose(record, np.asarray(u), np.asarray(feed_forward), alone).table[0]["score"]


def _print_row(*cells: str) -> None:
    print(*(f"{cell:<11}" for cell in cells), flush=True)


if __name__ == "__main__":
    tyro.cli(main)
