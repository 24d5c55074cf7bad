"""Choose which part of which walk to show: one in which the robot turns and moves on.

The score of a stretch of walking is the product of its mean turn |v_r - v_l| and the distance between its ends. For a
robot that turns on the spot the distance is zero, and for one that walks straight ahead the turn is zero; a robot that
walks around something has both.

Works on host arrays.
"""

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from lgmdjax.errors import InputError
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record, Room
from lgmdjax.world.arena import Arena

STRETCH = 10.0  # s, by which walks are compared
_EVERY = 15  # frames between two stretches that are compared


def choose_walk(record: Record, room: Room | Arena, index: int | None = None) -> tuple[Record, Arena]:
    """Return one walk of a record, axis (frame,), and its room; that of `select_walk` if no index is given.

    Args:
        record: of one robot or of several.
        room: of all robots, or a batch with one for each.
        index: of the robot; negative ones count from the end.

    Raises InputError if there is no such robot.
    """
    batch = jax.tree.map(np.asarray, record if np.ndim(record.time) == 2 else jax.tree.map(lambda x: x[None], record))
    index = select_walk(batch) if index is None else index
    if not -len(batch.time) <= index < len(batch.time):
        raise InputError(f"expected an index of one of {len(batch.time)} walks, got {index}; choose another")
    scene = room.arena if isinstance(room, Room) else room
    if np.ndim(scene.bounds) == 2:
        scene = jax.tree.map(lambda leaf: leaf[index], scene)
    return jax.tree.map(lambda leaf: leaf[index], batch), scene


def select_walk(record: Record) -> int:
    """Return the index of the robot with the best stretch of walking; axes (robot, frame).

    Robots with fewer collisions are preferred; robots that were lost come last.
    """
    frames = min(round(STRETCH * FRAME_RATE), np.shape(record.time)[1])
    best = [
        _turn_and_distance(np.asarray(position), np.asarray(velocity), frames).max()
        for position, velocity in zip(record.position, record.velocity, strict=True)
    ]
    return int(np.argmax(np.array(best) - 1e3 * record.contact.sum(axis=1) - 1e6 * ~record.ok[:, -1]))


def select_segment(
    position: Float[ndarray, "total 3"], velocity: Float[ndarray, "total 2"], frames: int
) -> Int[ndarray, " frames"]:
    """Return the best consecutive frames of one walk, if possible without a reset."""
    frames = min(max(frames, 1), len(position))
    first = _EVERY * int(np.argmax(_turn_and_distance(position, velocity, frames)))
    return np.arange(first, first + frames)


def detect_resets(position: Float[ndarray, "frames 3"]) -> Bool[ndarray, " steps"]:
    """Find the steps between frames in which the robot was reset: it cannot walk 5 cm in 1/30 s."""
    return np.linalg.norm(np.diff(position, axis=0), axis=1) > 0.05


def _turn_and_distance(
    position: Float[ndarray, "total 3"], velocity: Float[ndarray, "total 2"], frames: int
) -> Float[ndarray, " starts"]:
    """Return mean turn times distance [m] of every stretch of `frames`, minus 1000 for each reset in it."""
    starts = np.arange(0, len(position) - frames + 1, _EVERY)
    turn = np.concatenate([[0.0], np.cumsum(np.abs(velocity[:, 1] - velocity[:, 0]))])
    resets = np.concatenate([[0.0, 0.0], np.cumsum(detect_resets(position))])
    distance = np.linalg.norm(position[starts + frames - 1, :2] - position[starts, :2], axis=1)
    crossed = resets[starts + frames] - resets[starts + 1]
    return (turn[starts + frames] - turn[starts]) / frames * distance - 1e3 * crossed
