"""Messages between the viewer and its simulator, a separate process.

Only the simulator imports JAX, so that the viewer's page appears at once.

| from the viewer | meaning                                                              |
| --------------- | -------------------------------------------------------------------- |
| `Open`          | send the names of the recorded walks of a path, and one of the walks |
| `Live`          | simulate a robot in a room from now on                               |
| `Controls`      | simulate with these numbers; all are inputs of the compiled program  |
| `Move`          | move an obstacle                                                     |
| `Place`         | move the robot                                                       |
| `Step`          | simulate one more frame, while paused                                |
| `RecordCommand` | start to record frames, or stop and write them                       |

| from the simulator  | meaning                                              |
| ------------------- | ---------------------------------------------------- |
| `Status`            | what it does; `failed` if it cannot continue         |
| `Walks`             | what a path contains, and one of its walks           |
| `SensedFrames`      | pictures and layers of some frames of that walk      |
| `Entered`           | the room of the live simulation                      |
| `LiveFrame`         | one simulated frame                                  |
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from numpy import ndarray

from lgmdjax.body.robot_xml import Body
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
    run: Path | None = None  # run folder of the robot; the pretrained robot if None


@dataclass(frozen=True, kw_only=True)
class Controls:
    """Numbers of the live simulation that can change from one frame to the next."""

    policy: PolicyName = "learned"
    threshold: float | None = None  # T_s, grey; None is the robot's own
    suppression: float | None = None  # T_f, grey
    inhibition: float | None = None  # W_I
    turn_gain: float = 1.0  # of v_right - v_left
    speed: float = 1.0  # of the mean of v_left and v_right
    pace: float = 1.0  # simulated seconds per second
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


class RecordCommand(NamedTuple):
    """Record frames from now on if `on`, else write the recording into `folder`."""

    on: bool
    folder: Path | None = None


class Status(NamedTuple):
    """What the simulator does."""

    text: str
    failed: bool = False


class Constants(NamedTuple):
    """Constants of a robot's LGMDs."""

    threshold: float
    suppression: float
    inhibition: float


class Walks(NamedTuple):
    """The names of all walks of a path, and one of them."""

    names: tuple[str, ...]
    index: int
    playback: Playback
    body: Body | None = None  # of the robot that walked


class SensedFrames(NamedTuple):
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
    body: Body | None = None  # of the robot


class LiveFrame(NamedTuple):
    """One simulated frame; arrays as in `Playback`, without the axis of frames."""

    time: float  # s, since the robot entered the room
    computed: float  # s, of the system's monotonic clock
    milliseconds: float  # mean duration of a frame
    qpos: ndarray
    u: ndarray
    velocity: ndarray
    contact: bool
    is_first: bool
    ok: bool
    centres: ndarray
    pictures: ndarray
    layers: ndarray


Command = Open | Live | Controls | Move | Place | Step | RecordCommand
Report = Status | Walks | SensedFrames | Entered | LiveFrame
