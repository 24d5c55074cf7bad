"""The viewer: one page with a robot in its room, recorded or live.

This process shows recorded walks, without JAX. The live simulation runs in a separate process. While it compiles, the
recorded walk continues; the page switches to the simulation when the robot has entered its room.
"""

import queue
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import get_args

import numpy as np

from lgmdjax.errors import InputError
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.reporting import playback as playbacks
from lgmdjax.reporting.playback import Playback
from lgmdjax.reporting.walk_scene import HAS_VISER, WalkScene
from lgmdjax.runtime import interruption
from lgmdjax.viewer import markdown
from lgmdjax.viewer.controls import LivePanel, Playing, Transport
from lgmdjax.viewer.dashboard import Dashboard
from lgmdjax.viewer.messages import (
    RANDOM_ROOM,
    Controls,
    Entered,
    Live,
    LiveFrame,
    Move,
    Open,
    Place,
    RecordCommand,
    Report,
    SensedFrames,
    Status,
    Step,
    Walks,
)
from lgmdjax.viewer.simulator import Simulator

if HAS_VISER:
    import viser

TICK = 1 / 60  # s; the loop pauses for half of it
PICTURES_EVERY = 2  # frames between two updates of the pictures


class Viewer:
    """The page and its loop."""

    def __init__(self, server: "viser.ViserServer", out: Path, run: Path | None = None):
        self.server = server
        self.simulator, self.out, self.run_folder = Simulator(), out, run
        self.playing = Playing()
        self.playback: Playback | None = None
        self.is_live, self.is_recording, self.contacts = False, False, 0
        self.opened: Open | None = None
        self.walks: Walks | None = None
        self.sensed, self._shown_frame = 0, -1
        # Calls that viser's threads leave to the loop.
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.scene = WalkScene(self.server)
        self._lay_out()

    def play(self, walks: Walks) -> None:
        """Show a recorded walk from its beginning."""
        playback, names, index = walks.playback, walks.names, walks.index
        self.is_live, self.walks, self.playback, self.playing.frame = False, walks, playback, 0.0
        self.scene.set_body(walks.body)
        self.scene.set_room(playback.room, playback.centres_at(0))
        self.scene.trace(playback)
        self.scene.point_camera(playback.room)
        self.transport.enter(playback, names, index)
        self.transport.folder.visible = True
        self.live_panel.leave()
        self.sensed = 0 if playback.pictures is None else len(playback.pictures)
        if not self.sensed:
            self.dashboard.show_nothing()

    def start_live(self) -> None:
        """Start the live simulation in the room that the controls name."""
        if self.is_recording:
            self._toggle_recording()
        self.live_panel.set_paused(False)
        self.status.content = "**live: starting**"
        room = Live(self.live_panel.room.value, int(self.live_panel.seed.value), self.run_folder)
        self.simulator.send(self.live_panel.controls, room)

    def run(self) -> None:
        """Run the page until the user interrupts."""
        before = shown = time.monotonic()
        try:
            while True:
                interruption.check()
                while not self._todo.empty():
                    self._todo.get()()
                self._take_all(list(self.simulator.reports()))
                now = time.monotonic()
                if not self.is_live and now - shown >= 1 / 30:
                    self._advance(now - before)
                    before, shown = now, now
                elif self.is_live:
                    before = now
                time.sleep(TICK / 2)
        finally:
            self.simulator.close()
            self.server.stop()

    def _take_all(self, reports: list[Report]) -> None:
        """Show reports; of several simulated frames that arrive together show only the last, so that none is late."""
        frames = [report for report in reports if isinstance(report, LiveFrame)]
        for report in reports:
            if isinstance(report, LiveFrame) and report is not frames[-1]:
                self._note(report)
            else:
                self.take(report)

    def take(self, report: Report) -> None:
        """Show a report of the simulator."""
        match report:
            case Status(text=text, failed=failed):
                self.status.content = markdown.bold(text)
                if failed:
                    self._fail(text)
            case Walks():
                self.play(report)
            case SensedFrames():
                self._add_senses(report)
            case Entered():
                self._enter(report)
            case LiveFrame():
                self._show_live(report)

    def _lay_out(self) -> None:
        gui = self.server.gui
        senses = gui.add_panel()
        with senses.add_tab("Senses", viser.Icon.EYE):
            self.dashboard = Dashboard(self.server)
        senses.dock_left()
        senses.set_width(410)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self.status = gui.add_markdown("**recorded**")
        self.clock = gui.add_markdown("")
        follow = gui.add_checkbox("Follow the robot", initial_value=True)
        self.transport = Transport(self.server, self.playing, self._choose)
        self.live_panel = LivePanel(self.server, self._steer, (RANDOM_ROOM, *get_args(TrialName)))

        @follow.on_update
        def _(_: object) -> None:
            self.scene.follows = follow.value

        self._listen()

    def _listen(self) -> None:
        panel = self.live_panel

        @panel.start.on_click
        def _(_: object) -> None:
            self.start_live()

        @panel.back.on_click
        def _(_: object) -> None:
            panel.set_paused(True)
            self._todo.put(self._go_back)

        @panel.step.on_click
        def _(_: object) -> None:
            panel.set_paused(True)
            self.simulator.send(Step())

        @panel.record.on_click
        def _(_: object) -> None:
            self._toggle_recording()

        @panel.place.on_click
        def _(_: object) -> None:
            self.server.scene.remove_click_callback()
            panel.place.label = "... click the floor"

            @self.server.scene.on_click()
            def _(event: "viser.SceneClickEvent") -> None:
                x, y = self.scene.to_floor(event.ray_origin, event.ray_direction)
                self.server.scene.remove_click_callback()
                panel.place.label = "Place the robot: click the floor"
                if np.isfinite([x, y]).all():
                    self.simulator.send(Place(x, y, panel.yaw()))

    def _steer(self, controls: Controls) -> None:
        if self.simulator.runs:
            self.simulator.send(controls)

    def _toggle_recording(self) -> None:
        """Start to record, or stop and write the recording."""
        self.is_recording = not self.is_recording
        self.live_panel.record.label = "Stop and write" if self.is_recording else "Record"
        folder = self.out / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        self.simulator.send(RecordCommand(True) if self.is_recording else RecordCommand(False, folder))

    def _choose(self, walk: int) -> None:
        if self.opened is not None:
            self.simulator.send(self.opened._replace(walk=walk))

    def open(self, path: Path) -> None:
        """Show the recorded walks of a path."""
        self.opened = Open(path.resolve())
        self.simulator.send(self.opened)

    def _go_back(self) -> None:
        """Show the recorded walk again, while the live simulation is paused."""
        if self.walks is not None and self.playback is not None:
            sensed = self.sensed
            self.play(self.walks._replace(playback=self.playback))
            self.sensed = sensed
            self.status.content = "**recorded**"

    def _fail(self, text: str) -> None:
        """Show an error on the page; raise `InputError` if there is no walk to show."""
        self.live_panel.leave()
        if self.playback is None:
            raise InputError(text)
        if self.is_live:
            self._go_back()
            self.status.content = markdown.bold(text)

    def _advance(self, elapsed: float) -> None:
        """Show the next frame of the recorded walk."""
        playback, playing = self.playback, self.playing
        if playback is None:
            return
        if not playing.paused:
            playing.frame += elapsed * playing.speed * playbacks.FRAME_RATE
        if playing.frame >= len(playback.time):
            playing.frame = 0.0
        playing.frame = max(playing.frame, 0.0)
        frame = int(playing.frame)
        if frame == self._shown_frame and playing.paused:
            return
        self._shown_frame = frame
        self.scene.show(playback.qpos[frame], playback.centres_at(frame))
        if frame % PICTURES_EVERY == 0 or playing.paused:
            self._show_senses(playback, frame)
        self._tell_time(
            float(playback.time[frame]), playback.u[frame], playback.velocity[frame], playback.contact[frame]
        )

    def _show_senses(self, playback: Playback, frame: int) -> None:
        if playback.pictures is not None and playback.layers is not None and frame < self.sensed:
            self.dashboard.show_pictures(playback.pictures[frame], playback.layers[frame])
        self.dashboard.show_curves(playback, frame)
        self.transport.show(float(playback.time[frame]))

    def _add_senses(self, report: SensedFrames) -> None:
        """Store what the robot sensed in some frames of the present walk."""
        playback = self.playback
        if playback is None or self.is_live:
            return
        self.playback = playbacks.with_senses(playback, report.first, report.pictures, report.layers)
        self.sensed = report.first + len(report.pictures)

    def _enter(self, entered: Entered) -> None:
        self.is_live, self.contacts, self.is_recording = True, 0, False
        self.transport.folder.visible = False
        self.scene.set_body(entered.body)
        self.scene.set_room(entered.shape, entered.centres)
        self.scene.enable_drag(lambda index, x, y: self.simulator.send(Move(index, x, y)))
        self.scene.point_camera(entered.shape)
        self.live_panel.enter(entered.constants)

    def _show_live(self, frame: LiveFrame) -> None:
        if not self.is_live:
            return
        self._note(frame)
        self.scene.show(frame.qpos, frame.centres)
        if round(frame.time * 30) % PICTURES_EVERY == 0 or self.live_panel.controls.paused:
            self.dashboard.show_pictures(frame.pictures, frame.layers)
        self._tell_time(frame.time, frame.u, frame.velocity, frame.contact, self._pace(frame))
        if not frame.ok:
            self.status.content = "**the robot fell: place it somewhere, or enter a room**"

    def _note(self, frame: LiveFrame) -> None:
        """Add a frame to the curves, and mark its contact."""
        self.dashboard.append(frame.time, frame.u, frame.velocity, frame.contact)
        if frame.contact:
            self.scene.mark(self.contacts, frame.qpos[:2])
            self.contacts += 1

    def _pace(self, frame: LiveFrame) -> str:
        """Return a line about the speed of the simulation and the age of the frame."""
        delay = 1e3 * (time.monotonic() - frame.computed)
        return f"a frame takes {frame.milliseconds:.0f} ms of 33; shown {delay:.0f} ms after it was simulated"

    def _tell_time(self, now: float, u: np.ndarray, v: np.ndarray, contact: bool, more: str = "") -> None:
        touch = " &nbsp; **contact**" if contact else ""
        self.clock.content = (
            f"t = {now:.2f} s &nbsp; u = {u[0]:.2f}, {u[1]:.2f} &nbsp; v = {v[0]:+.2f}, {v[1]:+.2f}{touch}\n\n{more}"
        )
