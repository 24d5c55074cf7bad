"""How much of the teacher's labels can be known? `python experiments/explain_labels.py RUN`.

The learned robot can be only as good as its labels can be told from its eyes. Networks are fitted to the same walks,
the navigator's own of the last rounds of DAgger, and scored in the same held-out rooms:

- the paper's network, on u of detectors with other fields of view (the walks are rendered again for each);
- the same on u of the run's own field, with ten times its weights;
- the same on the distances to which the teacher reacts, in the place of u.

What a better field explains more was missing in the eyes; what more weights explain more, in the network; what the
distances explain more, in the detectors.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from lgmdjax.cli.main import exit_code
from lgmdjax.control import braitenberg, navigator
from lgmdjax.learning import behaviour_cloning, dagger, lgmd_grid_search
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, episodes, room_batches
from lgmdjax.simulation.episodes import Walk

EPOCHS, SEED, ROUNDS = 60, 0, 3
LARGE = 105  # units: ten times the weights of 32
ROBOTS = 16  # rendered at once
FIELDS = {
    "whole hemifields, as in the paper": {"ground": 0.0, "falloff": 0.0},
    "without the ground": {"ground": 0.5, "falloff": 0.0},
    "with falloff": {"ground": 0.0, "falloff": 2.0},
    "without the ground, with falloff": {"ground": 0.5, "falloff": 2.0},
    "without the ground, with more falloff": {"ground": 0.5, "falloff": 3.0},
}


def nearness(walk: Walk) -> Walk:
    """Return the walk with the nearness that the teacher reacts to in the place of u."""
    nearest, corridor = jnp.asarray(walk.distances), jnp.asarray(walk.corridor)
    distances = braitenberg.sensed_distances(braitenberg.Params(), nearest, corridor)
    return replace(walk, u=1 / np.asarray(distances))


def render(walks: Sequence[Walk], run: Path, settings: CameraSettings) -> list[Walk]:
    """Return the walks with the u that detectors with another field of view would have had."""
    detector = assembly.fit_detector(assembly.load_detector(run / "collect"), settings)
    constants = (jnp.asarray([getattr(detector, name)]) for name in ("threshold", "inhibition"))
    candidate = lgmd_grid_search.Candidates(**dict(zip(("threshold", "inhibition"), constants, strict=True)))
    seen = []
    for episode, group in groupby(walks, key=lambda walk: walk.episode):
        of_episode = list(group)
        rooms = room_batches.training_rooms(of_episode[0].seed, episode, len(of_episode)).arena
        for first in range(0, len(of_episode), ROBOTS):
            batch = of_episode[first : first + ROBOTS]
            arenas = jax.tree.map(lambda leaf, first=first: leaf[first : first + ROBOTS], rooms)
            record, camera_params = episodes.stack_walks(batch), assembly.camera_params(settings)
            u, _ = lgmd_grid_search.evaluate(detector, camera_params, arenas, record, candidate)
            seen += [replace(walk, u=own) for walk, own in zip(batch, np.asarray(u)[..., 0], strict=True)]
    return seen


def score(name: str, walks: Sequence[Walk], units: int = navigator.UNITS) -> None:
    """Fit a network to the walks in most rooms, and print its scores in the others."""
    train, test, unseen = dagger.split_rooms(episodes.segments(walks), SEED)
    start = navigator.create(jax.random.key(SEED), units=units)
    best = behaviour_cloning.fit(start, train, test, behaviour_cloning.Settings(epochs=EPOCHS)).best
    print(json.dumps({"input": name, "units": units} | behaviour_cloning.score(best, unseen)), flush=True)


def main(run: tyro.conf.Positional[Path]) -> None:
    """Fit the networks to the walks of a run and print their scores in held-out rooms.

    Args:
        run: the run folder
    """
    _, header = navigator.load(run / "train" / "controller.safetensors")
    walks = dagger.read_rounds(run / "train")
    rounds = sorted({walk.episode for walk in walks})[-ROUNDS:]
    walks = [walk for walk in walks if walk.episode in rounds]
    for name, field in FIELDS.items():
        score(f"u, {name}", render(walks, run, replace(assembly.read_camera_settings(header), **field)))
    score("u, as recorded", walks)
    score("u, as recorded, ten times the weights", walks, LARGE)
    score("1/r, of the teacher", [nearness(walk) for walk in walks])


if __name__ == "__main__":
    sys.exit(exit_code(lambda: tyro.cli(main)))
