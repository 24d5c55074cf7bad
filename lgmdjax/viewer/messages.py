"""What the viewer and its simulator, which is a process of its own, send each other.

The viewer imports no JAX, so that its page is there at once; only the simulator does.

| from the viewer | meaning                                                              |
| --------------- | -------------------------------------------------------------------- |
| `Open`          | send the recorded walks of a path, and this one of them              |
| `Live`          | simulate a robot in a room from now on                               |
| `Controls`      | simulate with these numbers; all are inputs of the compiled program  |
| `Move`          | put an obstacle somewhere else                                       |
| `Place`         | put the robot somewhere else                                         |
| `Step`          | simulate one frame more, while paused                                |
| `Keep`          | begin to keep the frames, or end and write them                      |

| from the simulator  | meaning                                              |
| ------------------- | ---------------------------------------------------- |
| `Status`            | what it does; `failed` if it cannot go on            |
| `Walks`             | what a path contains, and one of its walks           |
| `Senses`            | pictures and layers of some frames of that walk      |
| `Entered`           | the room of the live simulation                      |
| `LiveFrame`         | one simulated frame                                  |
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from numpy import ndarray

from lgmdjax.control.names import PolicyName
from lgmdjax.reporting.playback import Playback, RoomShape

RANDOM_ROOM = "random"  # the name of rooms that are sampled from their seed; all others are those of trials


class Open(NamedTuple):
    """Read recorded walks: a run folder, the folder of a trial, or a Parquet file."""

    path: Path
    walk: int | None = None  # number of the walk; None lets `selection.select_walk` choose


class Live(NamedTuple):
    """Simulate a robot in a room."""

    room: str = RANDOM_ROOM
    seed: int = 0
    run: Path | None = None  # of the robot; the pretrained robot if None


@dataclass(frozen=True, kw_only=True)
class Controls:
    """Numbers of the live simulation that can change from one frame to the next."""

    policy: PolicyName = "learned"
    threshold: float | None = None  # T_s, grey; None is the robot's own
    suppression: float | None = None  # T_f, grey
    inhibition: float | None = None  # W_I
    turn_gain: float = 1.0  # of v_right - v_left
    speed: float = 1.0  # of the mean of v_left and v_right
    pace: float = 1.0  # simulated seconds in a second
    paused: bool = False


class Move(NamedTuple):
    """Put an obstacle at x, y [m]; `index` counts boxes, then cylinders."""

    index: int
    x: float
    y: float


class Place(NamedTuple):
    """Put the robot at x, y, yaw [m, m, rad], at rest."""

    x: float
    y: float
    yaw: float


class Step(NamedTuple):
    """Simulate one frame."""


class Keep(NamedTuple):
    """Keep frames from now on if `on`, else write what was kept into `folder`."""

    on: bool
    folder: Path | None = None


class Status(NamedTuple):
    """What the simulator does."""

    text: str
    failed: bool = False


class Constants(NamedTuple):
    """The LGMD's constants of a robot."""

    threshold: float
    suppression: float
    inhibition: float


class Walks(NamedTuple):
    """The names of all walks of a path, and one of them."""

    names: tuple[str, ...]
    index: int
    playback: Playback


class Senses(NamedTuple):
    """Pictures and layers of the walk `index` of a path, from frame `first` on; the shapes are those of `Playback`."""

    index: int
    first: int
    pictures: ndarray
    layers: ndarray


class Entered(NamedTuple):
    """The room of the live simulation, and the constants of its robot."""

    shape: RoomShape
    centres: ndarray
    constants: Constants


class LiveFrame(NamedTuple):
    """One simulated frame; arrays as in `Playback`, without the axis of frames."""

    time: float  # s, since the robot entered the room
    computed: float  # s, of the system's monotonic clock
    milliseconds: float  # that a frame took, on average
    qpos: ndarray
    u: ndarray
    velocity: ndarray
    contact: bool
    is_first: bool
    ok: bool
    centres: ndarray
    pictures: ndarray
    layers: ndarray


Command = Open | Live | Controls | Move | Place | Step | Keep
Report = Status | Walks | Senses | Entered | LiveFrame
