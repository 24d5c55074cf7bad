"""Flags of the commands for cameras and servos. Nothing here imports NumPy or JAX."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from lgmdjax.cli import flags
from lgmdjax.deployment.formats import PRETRAINED
from lgmdjax.errors import InputError

RoomName = Literal["testing", "training", "indoor", "outdoor", "random", "empty"]


@dataclass(frozen=True, kw_only=True)
class DriveFlags:
    """The robot's cameras and ports, and the nervous system that drives it."""

    camera: tuple[str, ...]
    """one source with both eyes side by side, or one source for the left and one for the right eye: /dev/video0,
    tcp://..., rtsp://..., http://..., a pipe or a file"""
    servos: str
    """serial port of the servos, such as /dev/ttyUSB0"""
    map: Path = Path("servos.toml")
    """file that says which servo is which joint (`lgmdjax servos map` writes it)"""
    robot: Path = Path(PRETRAINED)
    """run folder of the robot whose nervous system drives, or the word pretrained"""
    calibration: tuple[Path, ...] = ()
    """lens of both cameras, or one of the left and one of the right (`lgmdjax calibrate-camera` writes the files)"""
    mono: tyro.conf.FlagCreatePairsOff[bool] = False
    """the camera sends one picture, of which each eye sees its side"""
    imu: str | None = None
    """serial port of an inertial sensor that sends lines of three numbers: acceleration forward, left, up"""
    seconds: float | None = None
    """how long the robot walks; until Ctrl-C if left out"""
    out: Path = Path("runs/drive")
    """folder that holds one folder with the log of each drive"""
    name: str = ""
    """name of the log's folder; date and time if empty"""
    speed: float = 1.0
    """seconds of robot time per real second; below 1 for a simulated robot that is as slow"""

    def run(self) -> Path | None:
        """Return the run folder; None means the pretrained robot."""
        return None if self.robot == Path(PRETRAINED) else self.robot


@dataclass(frozen=True, kw_only=True)
class SimRobotFlags:
    """The room of the simulated robot, and its ports."""

    room: RoomName = "testing"
    """room of the robot"""
    seed: int = 0
    """seed of the room's textures, and of random rooms"""
    port: int = 5600
    """port of 127.0.0.1 for the eyes' pictures; any free one if 0"""
    width: int = 80
    """width of an eye's picture [px]"""
    out: Path = Path("runs/sim-robot")
    """folder for its joint map servos.toml, trace.csv, and the links bus and imu to its pseudo-terminals"""
    fault: tuple[str, ...] = ()
    """faults from the start on; a line on stdin adds another one, `clear` ends all"""
    seconds: float | None = None
    """how long it runs; until Ctrl-C if left out"""
    speed: float = 1.0
    """seconds of robot time per real second; below 1 on a busy computer"""


@dataclass(frozen=True, kw_only=True)
class CalibrateCameraFlags:
    """Pictures of a chessboard, and the lens that is fitted to them."""

    folder: tyro.conf.Positional[Path]
    """folder with ten or more pictures (PNG, JPEG, ...) of one chessboard, from all sides and in all corners"""
    board: str = "9x6"
    """inner corners of the board, along and across"""
    square: float = 25.0
    """side of a square [mm]"""
    model: Literal["fisheye", "pinhole"] = "fisheye"
    """fisheye for lenses over 100 degrees wide, else pinhole"""
    out: Path = Path("camera.json")
    """file to write: .json, or .yaml as OpenCV writes it; a plot beside it ends in .png"""


@dataclass(frozen=True, kw_only=True)
class ServosMapFlags:
    """The bus whose servos are mapped."""

    servos: str
    """serial port of the servos, such as /dev/ttyUSB0"""
    out: Path = Path("servos.toml")
    """file to write"""
    baud: int = 1_000_000
    """bits per second"""
    highest_id: int = 30
    """highest id that is tried, from 0 on; at most 252"""
    speed: float = 1.0
    """seconds of robot time per real second; below 1 for a simulated robot that is as slow"""


def parse_drive(description: str, arguments: Sequence[str]) -> DriveFlags:
    """Read the flags of command drive."""
    given = flags.parse(DriveFlags(camera=tyro.MISSING, servos=tyro.MISSING), "drive", description, arguments)
    if len(given.camera) not in (1, 2):
        raise InputError(f"expected one or two sources after --camera, got {len(given.camera)}; left eye first")
    if len(given.calibration) > (1 if given.mono else 2):
        raise InputError(f"expected a --calibration for each eye, or one for both, got {len(given.calibration)}")
    if given.mono and len(given.camera) == 2:
        raise InputError("expected one --camera with --mono, got two; leave one out")
    _check_seconds(given.seconds)
    return given


def parse_sim_robot(description: str, arguments: Sequence[str]) -> SimRobotFlags:
    """Read the flags of command sim-robot."""
    given = flags.parse(SimRobotFlags(), "sim-robot", description, arguments)
    if not 0 <= given.port < 65536:
        raise InputError(f"expected a --port of 0 to 65535, got {given.port}; 0 takes any free one")
    _check_seconds(given.seconds)
    return given


def parse_calibrate_camera(description: str, arguments: Sequence[str]) -> CalibrateCameraFlags:
    """Read the flags of command calibrate-camera."""
    return flags.parse(CalibrateCameraFlags(folder=tyro.MISSING), "calibrate-camera", description, arguments)


def parse_servos_map(description: str, arguments: Sequence[str]) -> ServosMapFlags:
    """Read the flags of command servos map."""
    given = flags.parse(ServosMapFlags(servos=tyro.MISSING), "servos map", description, arguments)
    if not 0 <= given.highest_id <= 252:
        raise InputError(f"expected --highest-id of 0 to 252, got {given.highest_id}; servos are numbered from 1")
    return given


def _check_seconds(seconds: float | None) -> None:
    if seconds is not None and not seconds > 0:
        raise InputError(f"expected --seconds above 0, got {seconds:g}; leave it out to run until Ctrl-C")
