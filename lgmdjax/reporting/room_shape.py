"""Shape of a room as arrays that can be drawn without JAX (`lgmdjax.reporting.playback.RoomShape`)."""

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.reporting.playback import RoomShape
from lgmdjax.world import arena


def shape_of(room: arena.Arena) -> RoomShape:
    """Return the shape of a room."""

    def both(name: str) -> np.ndarray:
        return np.concatenate([np.asarray(getattr(prisms, name)) for prisms in (room.boxes, room.cylinders)])

    boxes, cylinders = len(room.boxes.top), len(room.cylinders.top)
    return RoomShape(
        bounds=np.asarray(room.bounds),
        wall_height=float(room.wall_height),
        half_size=both("half_size"),
        yaw=both("yaw"),
        bottom=both("bottom"),
        top=both("top"),
        is_round=np.arange(boxes + cylinders) >= boxes,
    )


def centres_of(room: arena.Arena) -> np.ndarray:
    """Return the centres [m] of all obstacles, boxes first, before any motion."""
    return np.concatenate([np.asarray(room.boxes.centre), np.asarray(room.cylinders.centre)])


def centres_during(room: arena.Arena, time: np.ndarray) -> np.ndarray:
    """Return the centres of all obstacles at some times [s]; a single row if nothing moves."""
    goals = np.concatenate([np.asarray(room.boxes.goal), np.asarray(room.cylinders.goal)])
    if np.array_equal(goals, centres_of(room)):
        return centres_of(room)[None]
    moved = jax.vmap(lambda now: arena.at_time(room, now))(jnp.asarray(time))
    return np.concatenate([np.asarray(moved.boxes.centre), np.asarray(moved.cylinders.centre)], axis=1)
