"""The live simulation of one robot: what the worker does between two commands."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.errors import InputError
from lgmdjax.evaluation import trials
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.reporting import room_shape
from lgmdjax.simulation import assembly, closed_loop, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record, Room
from lgmdjax.viewer import edits, live_step
from lgmdjax.viewer.messages import (
    RANDOM_ROOM,
    Constants,
    Controls,
    Entered,
    Live,
    LiveFrame,
    Move,
    Place,
    RecordCommand,
    Report,
    Status,
    Step,
)
from lgmdjax.world import arena

ROOM_NAMES = (RANDOM_ROOM, *get_args(TrialName))
MAX_LAG = 0.25  # s; the simulation does not catch up with a longer lag
SMOOTHING = 0.95  # of the mean duration of a frame


class LiveSimulation:
    """A robot that walks in a room, at the pace of the controls if the machine is fast enough."""

    def __init__(self, command: Live, controls: Controls, report: Callable[[Report], None]):
        report(Status("live: loading the robot and its room"))
        self.command, self.report = command, report
        run = command.run
        self.robot = assembly.load_robot(run / "fit-gait", run / "train") if run else assembly.load_robot()
        self.model = closed_loop.build_model(self.robot)
        self.room = sample_room(command.room, command.seed)
        self.controls, self.params = controls, live_step.steer(self.robot, controls)
        report(Status("live: compiling the simulation, which takes a minute or two the first time"))
        self.state = live_step.start(self.params, self.model, self.room)
        jax.block_until_ready(live_step.frame(self.params, self.model, self.room, self.state))
        self.steps = 0  # frames to simulate while paused
        self.due, self.seconds = time.monotonic(), 0.0
        self.recording: edits.LiveRecording | None = None
        report(Status("live"))

    def entered(self) -> Entered:
        """Return the room, and the constants of the robot's detectors."""
        detector = self.robot.controller.detector
        constants = Constants(*(float(getattr(detector, name)) for name in Constants._fields))
        return Entered(room_shape.shape_of(self.room.arena), self._centres(), constants, self.robot.body)

    def is_due(self) -> bool:
        """Return whether it is time for the next frame."""
        return self.steps > 0 or (not self.controls.paused and time.monotonic() >= self.due)

    def steer(self, controls: Controls) -> None:
        """Apply new controls."""
        if self.controls.paused and not controls.paused:
            self.due = time.monotonic()
        self.controls, self.params = controls, live_step.steer(self.robot, controls)

    def execute(self, command: Move | Place | Step | RecordCommand) -> None:
        """Change the room or the robot's pose, step, or record."""
        match command:
            case Move():
                self.room = replace(self.room, arena=edits.move(self.room.arena, *command))
            case Place():
                self.state = live_step.place(
                    self.params, self.model, self.room, self.state, jnp.asarray(command, float)
                )
            case Step():
                self.steps += 1
            case RecordCommand(on=True):
                self.recording = edits.LiveRecording(self.room.arena)
                self.report(Status("live: recording"))
            case RecordCommand(folder=folder) if self.recording is not None and folder is not None:
                self._write(folder, self.recording)

    def advance(self) -> LiveFrame:
        """Simulate a frame and return it."""
        started = time.monotonic()
        self.steps = max(self.steps - 1, 0)
        self.state, record, senses = live_step.frame(self.params, self.model, self.room, self.state)
        record, senses = jax.tree.map(np.asarray, (record, senses))
        took = time.monotonic() - started
        self.seconds = SMOOTHING * self.seconds + (1 - SMOOTHING) * took if self.seconds else took
        self.due = max(self.due + 1 / (FRAME_RATE * self.controls.pace), time.monotonic() - MAX_LAG)
        if self.recording is not None:
            self.recording.append(record, self._centres())
        return self._frame(record, senses)

    def _frame(self, record: Record, senses: live_step.SensedFrame) -> LiveFrame:
        return LiveFrame(
            time=float(record.time),
            computed=time.monotonic(),
            milliseconds=1e3 * self.seconds,
            qpos=np.concatenate([record.position, record.quaternion, np.ravel(record.joints)]),
            u=np.asarray(record.u),
            velocity=np.asarray(record.velocity),
            contact=bool(record.contact),
            is_first=bool(record.is_first),
            ok=bool(record.ok),
            centres=self._centres(),
            pictures=np.asarray(senses.pictures),
            layers=np.asarray(senses.layers),
        )

    def _centres(self) -> np.ndarray:
        return room_shape.centres_of(arena.at_time(self.room.arena, int(self.state.frame) / FRAME_RATE))

    def _write(self, folder: Path, recording: edits.LiveRecording) -> None:
        self.recording = None
        self.report(Status("live: writing the episode and its video"))
        place = {"room": self.command.room, "seed": self.command.seed}
        written = recording.write(folder, self.robot, self.controls.policy, place)
        self.due = time.monotonic()
        self.report(Status(f"live; wrote {written}"))


def sample_room(name: str, seed: int) -> Room:
    """Return a random room or that of a trial; raise `InputError` for any other name."""
    if name == RANDOM_ROOM:
        rooms = room_batches.random_rooms(jax.random.key(seed), 1)
    elif name in ROOM_NAMES:
        rooms = trials.sample_rooms(name, 1, seed)
    else:
        raise InputError(f"expected the name of a room, got {name!r}; choose one of {', '.join(ROOM_NAMES)}")
    return jax.tree.map(lambda leaf: leaf[0], rooms)
