"""How much of the teacher's labels can be known? `python experiments/explain_labels.py RUN`.

The learned robot can be only as good as its labels can be told from its eyes. Three networks are fitted to the same
walks and scored in the same held-out rooms: the paper's, one with ten times its weights, and one that gets the
distances to which the teacher reacts in the place of u. What the second explains more than the first is missing in the
network; what the third explains more than the second, in the eyes.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from lgmdjax.cli.main import exit_code
from lgmdjax.control import braitenberg, navigator
from lgmdjax.learning import behaviour_cloning, dagger
from lgmdjax.simulation import episodes
from lgmdjax.simulation.episodes import Walk

EPOCHS, SEED = 60, 0
LARGE = 105  # units: ten times the weights of 32


def nearness(walk: Walk) -> Walk:
    """Return the walk with the nearness that the teacher reacts to in the place of u."""
    nearest, corridor = jnp.asarray(walk.distances), jnp.asarray(walk.corridor)
    distances = braitenberg.sensed_distances(braitenberg.Params(), nearest, corridor)
    return replace(walk, u=1 / np.asarray(distances))


def main(run: tyro.conf.Positional[Path]) -> None:
    """Fit the three networks to the walks of a run and print their scores in held-out rooms.

    Args:
        run: the run folder
    """
    walks = episodes.segments(dagger.read_all_walks({stage: run / stage for stage in ("collect", "train")}))
    from_eyes = dagger.split_rooms(walks, SEED)
    from_laser = [[nearness(walk) for walk in some] for some in from_eyes]
    cases = (
        ("u", from_eyes, navigator.UNITS),
        ("u, ten times the weights", from_eyes, LARGE),
        ("1/r, of the teacher", from_laser, navigator.UNITS),
    )
    for name, (train, test, unseen), units in cases:
        start = navigator.create(jax.random.key(SEED), units=units)
        weights = sum(leaf.size for leaf in jax.tree.leaves(start.weights))
        best = behaviour_cloning.fit(start, train, test, behaviour_cloning.Settings(epochs=EPOCHS)).best
        print(json.dumps({"input": name, "weights": weights} | behaviour_cloning.score(best, unseen)), flush=True)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: tyro.cli(main)))
