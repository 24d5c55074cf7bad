"""Rooms whose obstacles the user moves while a robot walks, and recordings of such walks.

A recorded walk is an episode (`lgmdjax.simulation.episodes`). Its header has the room, and every change of it:

| parameter      | meaning                                                                        |
| -------------- | ------------------------------------------------------------------------------ |
| live.room      | name of the room                                                               |
| live.seed      | of the room                                                                    |
| live.policy    | policy at the end                                                              |
| live.robot     | fingerprint of the robot                                                       |
| live.arena     | the numbers of the room at the start, in the order of `jax.tree.leaves`        |
| live.moves     | (frame, index, x, y) of every obstacle that moved since the last frame          |
"""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.control.names import PolicyName
from lgmdjax.errors import InputError
from lgmdjax.reporting import walk_video
from lgmdjax.reporting.room_shape import centres_of
from lgmdjax.runtime import partial_files
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, episodes
from lgmdjax.simulation.closed_loop import Record
from lgmdjax.viewer.live_step import with_centres
from lgmdjax.world import arena

VIDEO_SECONDS = 60.0


class LiveRecording:
    """Frames of a live simulation since the start of a recording."""

    def __init__(self, room: arena.Arena):
        self.room = jax.tree.map(np.asarray, room)
        self.records: list[Record] = []
        self.centres: list[np.ndarray] = []

    def append(self, record: Record, centres: np.ndarray) -> None:
        """Add a frame."""
        self.records.append(record)
        self.centres.append(centres)

    def write(self, folder: Path, robot: closed_loop.Params, policy: PolicyName, place: JsonObject) -> Path:
        """Write the episode and a video into a new folder; return the folder."""
        if not self.records:
            raise InputError("expected some frames to write, got none; record for longer")
        record = jax.tree.map(lambda *leaves: np.stack(leaves)[None], *self.records)
        with partial_files.new_folder(folder) as partial:
            parameters = {**place, "policy": policy, "robot": assembly.fingerprint(robot), **self._edits()}
            writer = episodes.Writer(partial, {"live": parameters})
            writer.write(record, episode=0, rooms=[0], seed=int(str(place["seed"])))
            rooms = rooms_at(self.room, np.stack(self.centres))
            seconds = min(VIDEO_SECONDS, len(self.records) / closed_loop.FRAME_RATE / 2)
            trace = walk_video.WalkTrace(*(getattr(record, name)[0] for name in walk_video.WalkTrace._fields))
            walk_video.write_trace(partial / "walk.mp4", trace, rooms, robot.camera, seconds, body=robot.body)
        return folder

    def _edits(self) -> JsonObject:
        first = centres_of(self.room)
        moved = np.any(np.diff(np.stack([first, *self.centres]), axis=0) != 0, axis=-1)
        moves = [[int(k), int(n), *map(float, self.centres[k][n])] for k, n in np.argwhere(moved)]
        leaves = [np.asarray(leaf).ravel().tolist() for leaf in jax.tree.leaves(self.room)]
        return {"arena": leaves, "moves": moves}


def read_edits(live: JsonObject, frames: int, path: Path) -> tuple[arena.Arena, np.ndarray]:
    """Return the room at the start of a recorded walk, and the centres of its obstacles in every frame."""
    template = arena.empty_room()
    shapes = [leaf.shape for leaf in jax.tree.leaves(template)]
    try:
        leaves = [np.asarray(row, float).reshape(shape) for row, shape in zip(live["arena"], shapes, strict=True)]
        room = jax.tree.unflatten(jax.tree.structure(template), [jnp.asarray(leaf) for leaf in leaves])
        centres = np.repeat(centres_of(room)[None], frames, axis=0)
        for frame, index, x, y in np.asarray(live["moves"], float).reshape(-1, 4):
            if not (0 <= frame < frames and 0 <= index < centres.shape[1] and np.isfinite([x, y]).all()):
                raise ValueError(f"an obstacle {index:g} in frame {frame:g}")
            centres[int(frame) :, int(index)] = x, y
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: expected a walk that the viewer recorded, got {error}; record it again") from error
    return arena.validate(room), centres


def rooms_at(room: arena.Arena, centres: np.ndarray) -> arena.Arena:
    """Return a room for each row of `centres`, in which nothing moves."""
    return jax.vmap(lambda row: with_centres(room, row))(jnp.asarray(centres))


def move(room: arena.Arena, index: int, x: float, y: float) -> arena.Arena:
    """Return the room with an obstacle at rest at x, y [m]; `index` counts boxes, then cylinders."""
    boxes = len(room.boxes.top)
    kind, row = ("boxes", index) if index < boxes else ("cylinders", index - boxes)
    prisms: arena.Prisms = getattr(room, kind)
    centre = jnp.asarray([x, y], prisms.centre.dtype)
    at_rest = replace(prisms, centre=prisms.centre.at[row].set(centre), goal=prisms.goal.at[row].set(centre))
    return replace(room, **{kind: at_rest})
