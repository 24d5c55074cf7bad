"""Rooms whose robots have faulty cameras, for training and for scores in the closed loop.

A navigator that was trained with perfect cameras takes the noise of a real one for something near: noise raises the
mean of u, while its left-right difference tells nearness almost as well as before. Trained with faults drawn anew for
each robot, it learns what they do.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.simulation import faulty_cameras, room_batches
from lgmdjax.simulation.closed_loop import Room
from lgmdjax.transfer import faults
from lgmdjax.transfer.names import FaultName

TRAINING_PROBABILITY = 0.5  # of each fault in training rooms: half of the robots see without it


def training_rooms(seed: int, episode: int, robots: int, names: Sequence[FaultName] = ()) -> Room:
    """Return the rooms of a training episode, whose robots have each of some camera faults with probability 1/2."""
    return randomise_cameras(room_batches.training_rooms(seed, episode, robots), names, TRAINING_PROBABILITY)


def randomise_cameras(rooms: Room, names: Sequence[FaultName], probability: float = 1.0) -> Room:
    """Return rooms whose robots have faulty cameras, drawn with each room's key; without names, the same rooms.

    ```python
    import jax
    import lgmdjax as lj

    rooms = lj.transfer.randomisation.randomise_cameras(
        lj.random_rooms(jax.random.key(0), 4), ("noise", "blur"), probability=0.5
    )
    record = lj.rollout(lj.load_robot(), rooms, seconds=30)
    ```

    Args:
        rooms: a batch of rooms.
        names: of the faults that may occur (`lgmdjax.transfer.faults`).
        probability: with which a robot has each of them, independently of the others.

    Raises InputError for vignetting, which the closed loop cannot have.
    """
    if not names:
        return rooms
    keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(rooms.key, 1)
    drawn = [faults.draw(key, *_choose(key, names, probability)).camera for key in keys]
    for one in drawn:
        faulty_cameras.check(one)
    stacked = jax.tree.map(lambda *leaves: _array(np.stack([np.asarray(leaf) for leaf in leaves])), *drawn)
    return replace(rooms, faults=stacked)


def _choose(key: jax.Array, names: Sequence[FaultName], probability: float) -> list[FaultName]:
    occurs = np.asarray(jax.random.uniform(jax.random.fold_in(key, len(faults.FAULTS)), (len(names),))) < probability
    return [name for name, one in zip(names, occurs, strict=True) if one]


def _array(values: np.ndarray) -> jax.Array:
    return jnp.asarray(values, jnp.int32 if values.dtype.kind == "i" else float)
