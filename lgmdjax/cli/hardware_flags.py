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
    """The robot's plugs, and what drives it."""

    camera: tuple[str, ...]
    """a source with both eyes side by side, or those of the left and the right eye: /dev/video0, tcp://..., rtsp://...,
    http://..., a pipe or a file"""
    servos: str
    """serial port of the servos, as /dev/ttyUSB0"""
    map: Path = Path("servos.toml")
    """which servo is which joint (`lgmdjax servos map` makes it)"""
    robot: Path = Path(PRETRAINED)
    """run folder of the robot whose nervous system drives, or the word pretrained"""
    calibration: tuple[Path, ...] = ()
    """calibrated lens of the cameras, or those of the left and the right one (`lgmdjax calibrate-camera` makes them)"""
    mono: tyro.conf.FlagCreatePairsOff[bool] = False
    """the camera is one picture, of which each eye sees its side"""
    imu: str | None = None
    """serial port of an inertial sensor that sends lines of three numbers: acceleration forward, left, up"""
    seconds: float | None = None
    """how long the robot walks; until Ctrl-C if left out"""
    out: Path = Path("runs/drive")
    """folder that holds one folder with the log of each drive"""
    name: str = ""
    """name of the log's folder; date and time if empty"""
    speed: float = 1.0
    """seconds of the robot for each second; below 1 for a simulated robot that is as slow"""

    def run(self) -> Path | None:
        """Return the run folder; None stands for the pretrained robot."""
        return None if self.robot == Path(PRETRAINED) else self.robot


@dataclass(frozen=True, kw_only=True)
class SimRobotFlags:
    """The room of the simulated robot, and where its plugs are."""

    room: RoomName = "testing"
    """the room that it stands in"""
    seed: int = 0
    """seed of the room's textures, and of random rooms"""
    port: int = 5600
    """port of 127.0.0.1 for the eyes' pictures; any free one if 0"""
    width: int = 80
    """width of an eye's picture [px]"""
    out: Path = Path("runs/sim-robot")
    """folder for its joint map servos.toml, trace.csv, and the links bus and imu to its pseudo-terminals"""
    fault: tuple[str, ...] = ()
    """faults from the start; lines on stdin switch others on and `clear` all off"""
    seconds: float | None = None
    """how long it runs; until Ctrl-C if left out"""
    speed: float = 1.0
    """seconds of the robot for each second; below 1 on a busy computer"""


@dataclass(frozen=True, kw_only=True)
class CalibrateCameraFlags:
    """Pictures of a chessboard, and what is made of them."""

    folder: tyro.conf.Positional[Path]
    """folder with ten or more pictures (PNG, JPEG, ...) of one chessboard, from all sides and in all corners"""
    board: str = "9x6"
    """inner corners of the board, along and across"""
    square: float = 25.0
    """side of a square [mm]"""
    model: Literal["fisheye", "pinhole"] = "fisheye"
    """fisheye for lenses over 100 degrees wide, else pinhole"""
    out: Path = Path("camera.json")
    """file to write, .json, or .yaml as OpenCV writes it; the picture beside it ends in .png"""


@dataclass(frozen=True, kw_only=True)
class ServosMapFlags:
    """The bus whose servos are named."""

    servos: str
    """serial port of the servos, as /dev/ttyUSB0"""
    out: Path = Path("servos.toml")
    """file to write"""
    baud: int = 1_000_000
    """bits per second"""
    highest_id: int = 30
    """servos are looked for from 0 to this id; at most 252"""
    speed: float = 1.0
    """seconds of the robot for each second; below 1 for a simulated robot that is as slow"""


def parse_drive(description: str, arguments: Sequence[str]) -> DriveFlags:
    """Read the flags of command drive."""
    given = flags.parse(DriveFlags(camera=tyro.MISSING, servos=tyro.MISSING), "drive", description, arguments)
    if len(given.camera) not in (1, 2):
        raise InputError(f"expected one or two sources after --camera, got {len(given.camera)}; left eye first")
    if len(given.calibration) > (1 if given.mono else 2):
        raise InputError(f"expected a --calibration for each eye, or one for both, got {len(given.calibration)}")
    if given.mono and len(given.camera) == 2:
        raise InputError("expected one --camera with --mono, got two; leave one out")
    if given.seconds is not None and not given.seconds > 0:
        raise InputError(f"expected --seconds above 0, got {given.seconds:g}; leave it out to walk until Ctrl-C")
    return given


def parse_sim_robot(description: str, arguments: Sequence[str]) -> SimRobotFlags:
    """Read the flags of command sim-robot."""
    given = flags.parse(SimRobotFlags(), "sim-robot", description, arguments)
    if not 0 <= given.port < 65536:
        raise InputError(f"expected a --port of 0 to 65535, got {given.port}; 0 takes any free one")
    return given


def parse_calibrate_camera(description: str, arguments: Sequence[str]) -> CalibrateCameraFlags:
    """Read the flags of command calibrate-camera."""
    return flags.parse(CalibrateCameraFlags(folder=tyro.MISSING), "calibrate-camera", description, arguments)


def parse_servos_map(description: str, arguments: Sequence[str]) -> ServosMapFlags:
    """Read the flags of command servos map."""
    given = flags.parse(ServosMapFlags(servos=tyro.MISSING), "servos map", description, arguments)
    if not 0 <= given.highest_id <= 252:
        raise InputError(f"expected --highest-id of 0 to 252, got {given.highest_id}; robots are numbered from 1")
    return given
