"""Recorded walks of a path, with the rooms in which they were walked.

| path                                  | rooms                                                             |
| ------------------------------------- | ----------------------------------------------------------------- |
| chunk-*.parquet, or their folder      | those that the header of the walks describes, see below           |
| folder of a trial (`lgmdjax trial`)   | of the trial                                                      |
| run folder (`lgmdjax reproduce`)      | of the learned policy's walks in the testing room, else of the teacher's |

Every frame has the joint angles, so the legs are drawn as they moved. Pictures are not recorded: they are rendered
again, as the robot's camera sees the room, and the LGMDs run on them again.

The header of the walks says how their rooms were made (`lgmdjax.datasets.recorded_rooms`); that of a walk of the live
simulation contains its room and every move of an obstacle (`lgmdjax.viewer.edits`).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from lgmdjax.datasets import recorded_rooms
from lgmdjax.reporting import selection
from lgmdjax.reporting.playback import Playback
from lgmdjax.reporting.room_shape import centres_during
from lgmdjax.reporting.walk_page import to_playback
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, episodes
from lgmdjax.simulation.episodes import Walk
from lgmdjax.viewer import edits, live_step
from lgmdjax.viewer.messages import Open, Report, SensedFrames, Status, Walks
from lgmdjax.viewer.walk_paths import find_walks
from lgmdjax.world.arena import Arena

FRAMES_PER_CALL = 30  # rendered at once; the last call is padded
SHOWN_WIDTH = 160  # px; wider pictures are subsampled


class WalkSource:
    """The walks of a path, one of which is sent: first its poses, then what the robot sensed, part by part."""

    def __init__(self, command: Open, report: Callable[[Report], None]):
        report(Status(f"reading {command.path}"))
        folder, names = find_walks(command.path)
        recorded = episodes.read(folder)
        self.walks_read = [walk for walk in recorded if names is None or walk.episode in names]
        self.parameters, self.folder, self.report = episodes.read_parameters(folder), folder, report
        self.robot = robot_of(folder)
        self.index = select(self.walks_read) if command.walk is None else command.walk
        self.room, self.centres = room_of(self.parameters, self.walk, len(recorded), folder)
        self.done, self.state = 0, live_step.start_replay(self.robot)

    @property
    def walk(self) -> Walk:
        """Return the walk that is sent."""
        return self.walks_read[self.index % len(self.walks_read)]

    def walks(self) -> Walks:
        """Return the names of all walks, and the poses of the one that is sent."""
        walk = self.walk
        names = tuple(f"{n}: {_describe(walk)}" for n, walk in enumerate(self.walks_read))
        playback = to_playback(walk, self.room)._replace(
            title=f"{self.folder.name}, {names[self.index]}", centres=self.centres
        )
        self.report(Status("rendering what the eyes saw; the first pictures take a minute"))
        return Walks(names, self.index, playback, self.robot.body)

    def is_behind(self) -> bool:
        """Return whether some frames are not rendered yet."""
        return self.done < len(self.walk)

    def sense(self) -> SensedFrames:
        """Return what the robot sensed in the next frames."""
        walk, first = self.walk, self.done
        rows = np.minimum(np.arange(first, first + FRAMES_PER_CALL), len(walk) - 1)
        poses = live_step.Poses(
            position=jnp.asarray(walk.position[rows], float),
            quaternion=jnp.asarray(walk.quaternion[rows], float),
            is_first=jnp.asarray(walk.is_first[rows]),
            centres=jnp.asarray(self.centres[np.minimum(rows, len(self.centres) - 1)], float),
        )
        self.state, senses = live_step.replay(self.robot, self.room, self.state, poses)
        count = min(FRAMES_PER_CALL, len(walk) - first)
        self.done = first + count
        if not self.is_behind():
            self.report(Status("recorded"))
        step = max(self.robot.camera.width // SHOWN_WIDTH, 1)
        pictures = np.asarray(senses.pictures)[:count, :, ::step, ::step]
        return SensedFrames(self.index, first, pictures, np.asarray(senses.layers)[:count])

    def sense_all(self, frames: int) -> Playback:
        """Return the poses of the walk, and what the robot sensed in the first frames."""
        parts: list[SensedFrames] = []
        while self.is_behind() and self.done < frames:
            parts.append(self.sense())
        pictures, layers = (np.concatenate([getattr(part, name) for part in parts]) for name in ("pictures", "layers"))
        return self.walks().playback._replace(pictures=pictures, layers=layers)


def select(walks: list[Walk]) -> int:
    """Return the number of the walk that `selection.select_walk` selects; the first if they differ in length."""
    if len({len(walk) for walk in walks}) > 1:
        return 0
    return selection.select_walk(episodes.stack_walks(walks))


def robot_of(folder: Path) -> closed_loop.Params:
    """Return the robot of the run that a folder belongs to; the pretrained robot if it belongs to none."""
    for run in folder.resolve().parents:
        if (run / "train" / "controller.safetensors").is_file() and (run / "fit-gait").is_dir():
            return _as_live(assembly.load_robot(run / "fit-gait", run / "train"))
    return _as_live(assembly.load_robot())


def _as_live(robot: closed_loop.Params) -> closed_loop.Params:
    """Return the robot without what a replay does not need, so that all share one compiled program."""
    return replace(robot, controller=replace(robot.controller, policy=()))


def room_of(parameters: JsonObject, walk: Walk, recorded: int, folder: Path) -> tuple[Arena, np.ndarray]:
    """Return the room of a walk, and where its obstacles were in every frame (a single row if they stood still).

    Raises InputError for walks of a kind whose rooms cannot be built again.
    """
    live = parameters.get("live")
    if isinstance(live, dict):
        return edits.read_edits(live, len(walk), folder)
    room = recorded_rooms.find_rooms(parameters, [walk], recorded, folder)[0]
    return room, centres_during(room, np.asarray(walk.time))


def _describe(walk: Walk) -> str:
    """Describe a walk in a few words."""
    touches = int(np.sum(np.diff(np.asarray(walk.contact, int), prepend=0) > 0))
    return f"room {walk.room}, {walk.time[-1]:.0f} s, {touches or 'no'} collision{'s' if touches != 1 else ''}"
