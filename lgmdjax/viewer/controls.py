"""Controls in viser's panel: for a recorded walk, and for the live simulation.

viser runs callbacks on its own threads. They only change `Playing` or send a command to the simulator; the loop in
`lgmdjax.viewer.page` shows the result.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from lgmdjax.control.names import POLICY_NAMES
from lgmdjax.reporting.playback import Playback, contacts_of
from lgmdjax.reporting.walk_scene import HAS_VISER
from lgmdjax.viewer import markdown
from lgmdjax.viewer.messages import RANDOM_ROOM, Constants, Controls

if HAS_VISER:
    import viser

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4", "8")
PACES = ("0.25", "0.5", "1", "2", "4")
MAX_MARKS = 12  # of collisions below the slider


@dataclass
class Playing:
    """The present frame of a recorded walk, and how fast it plays."""

    frame: float = 0.0
    speed: float = 1.0
    paused: bool = False


class Transport:
    """Controls of a recorded walk: play, pause, step, slider and speed."""

    def __init__(self, server: "viser.ViserServer", playing: Playing, choose: Callable[[int], None]):
        self.playing, self._server, self._choose = playing, server, choose
        self.folder = server.gui.add_folder("Recorded walk")
        with self.folder:
            self._title = server.gui.add_markdown("")
            self._walk: viser.GuiDropdownHandle[str] = server.gui.add_dropdown("Walk", [str(0)], visible=False)
            self._play = server.gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
            step = server.gui.add_button_group("Step", ("-1 s", "-1 frame", "+1 frame", "+1 s"))
            speed = server.gui.add_dropdown("Speed", SPEEDS, initial_value="1")
            self._slider_folder = server.gui.add_folder("Time")
        self._slider: viser.GuiSliderHandle[float] | None = None

        @self._play.on_click
        def _(_: object) -> None:
            self.set_paused(not playing.paused)

        @step.on_click
        def _(event: "viser.GuiEvent") -> None:
            self.set_paused(True)
            playing.frame += {"-1 s": -30, "-1 frame": -1, "+1 frame": 1, "+1 s": 30}[event.target.value]

        @speed.on_update
        def _(_: object) -> None:
            playing.speed = float(speed.value)

        @self._walk.on_update
        def _(event: "viser.GuiEvent") -> None:
            if event.client is not None:
                self._choose(self._walk.options.index(self._walk.value))

    def set_paused(self, paused: bool) -> None:
        """Pause or continue."""
        self.playing.paused = paused
        self._play.label = "Play" if paused else "Pause"
        self._play.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE

    def enter(self, playback: Playback, names: Sequence[str] = (), index: int = 0) -> None:
        """Show another walk: its title, and a slider with a mark for each collision."""
        touches = contacts_of(playback)
        marks = tuple((float(playback.time[frame]), "✖") for frame in touches[:MAX_MARKS])
        noun = "collision" if len(touches) == 1 else "collisions"
        self._title.content = f"{markdown.bold(playback.title)}: {len(touches) or 'no'} {noun}"
        if names:
            self._walk.options, self._walk.visible = tuple(names), len(names) > 1
            self._walk.value = names[index]
        if self._slider is not None:
            self._slider.remove()
        first, last = float(playback.time[0]), float(playback.time[-1])
        with self._slider_folder:
            slider = self._server.gui.add_slider(
                "t [s]", min=first, max=max(last, first + 0.1), step=1 / 30, initial_value=first, marks=marks
            )
        self._slider = slider

        @slider.on_update
        def _(event: "viser.GuiEvent") -> None:
            if event.client is not None:
                self.playing.frame = (slider.value - first) * 30

    def show(self, time: float) -> None:
        """Move the slider to a time [s]."""
        if self._slider is not None:
            self._slider.value = min(max(time, self._slider.min), self._slider.max)


class LivePanel:
    """Controls of the live simulation."""

    def __init__(self, server: "viser.ViserServer", changed: Callable[[Controls], None], rooms: Sequence[str]):
        self.controls, self._changed = Controls(), changed
        gui = server.gui
        self.folder = gui.add_folder("Live simulation")
        with self.folder:
            self.start = gui.add_button("Live", icon=viser.Icon.PLAYER_RECORD, hint="Simulate this robot now")
            self.room = gui.add_dropdown("Room", tuple(rooms), initial_value=RANDOM_ROOM)
            self.seed = gui.add_number("Seed", 0, min=0, max=2**31 - 1, step=1)
        self.running = gui.add_folder("Robot", visible=False)
        with self.running:
            self.pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
            self.step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT)
            self.back = gui.add_button("Back to the recorded walk", icon=viser.Icon.ARROW_BACK)
            self._policy = gui.add_dropdown("Policy", POLICY_NAMES, initial_value="learned")
            self._threshold = gui.add_slider("T_s", 0.0, 5.0, 0.05, 0.25, hint="threshold of a cell [grey]")
            self._suppression = gui.add_slider("T_f", 0.5, 60.0, 0.1, 8.5, hint="change that suppresses u [grey]")
            self._inhibition = gui.add_slider("W_I", 0.0, 2.0, 0.01, 0.1, hint="weight of the inhibition")
            self._gain = gui.add_slider("Turn gain", 0.0, 3.0, 0.05, 1.0)
            self._speed = gui.add_slider("Speed", 0.0, 2.0, 0.05, 1.0, hint="factor on the mean of both sides")
            self._pace = gui.add_dropdown("Pace", PACES, initial_value="1", hint="simulated seconds per second")
        self.place_folder = gui.add_folder("Place and record", visible=False)
        with self.place_folder:
            gui.add_markdown("Drag an obstacle to move it.")
            self.place = gui.add_button("Place the robot: click the floor", icon=viser.Icon.HAND_CLICK)
            self.heading = gui.add_slider("Heading [°]", -180, 180, 5, 0)
            self.record = gui.add_button("Record", icon=viser.Icon.VIDEO)
        self._listen()

    def enter(self, constants: Constants) -> None:
        """Show the controls, with the constants of the robot's detectors."""
        for handle, value in (
            (self._threshold, constants.threshold),
            (self._suppression, constants.suppression),
            (self._inhibition, constants.inhibition),
        ):
            handle.value = min(max(value, handle.min), handle.max)
        self.running.visible = self.place_folder.visible = True
        self.start.label = "Enter the room"

    def leave(self) -> None:
        """Hide the controls while no simulation runs."""
        self.running.visible = self.place_folder.visible = False
        self.start.label = "Live"

    def yaw(self) -> float:
        """Return the heading [rad] with which the robot is placed."""
        return math.radians(self.heading.value)

    def set_paused(self, paused: bool) -> None:
        """Pause or continue."""
        self.pause.label = "Continue" if paused else "Pause"
        self.pause.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE
        self._change(paused=paused)

    def _listen(self) -> None:
        numbers = {
            "threshold": self._threshold,
            "suppression": self._suppression,
            "inhibition": self._inhibition,
            "turn_gain": self._gain,
            "speed": self._speed,
        }
        for name, handle in numbers.items():

            @handle.on_update
            def _(event: "viser.GuiEvent", name: str = name) -> None:
                if event.client is not None:
                    self._change(**{name: float(event.target.value)})

        @self._policy.on_update
        def _(_: object) -> None:
            self._change(policy=self._policy.value)

        @self._pace.on_update
        def _(_: object) -> None:
            self._change(pace=float(self._pace.value))

        @self.pause.on_click
        def _(_: object) -> None:
            self.set_paused(not self.controls.paused)

    def _change(self, **values: object) -> None:
        self.controls = replace(self.controls, **values)  # type: ignore[arg-type]
        self._changed(self.controls)
