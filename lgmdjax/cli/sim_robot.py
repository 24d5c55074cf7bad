"""`lgmdjax sim-robot`: a process that simulates the robot, to try `lgmdjax drive` without hardware."""

import contextlib
import math
import os
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import jax

from lgmdjax.cli.hardware_flags import RoomName, SimRobotFlags
from lgmdjax.errors import InputError
from lgmdjax.hardware import joint_map
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.faults import FAULTS, ActiveFaults
from lgmdjax.hardware.joint_map import JointMap
from lgmdjax.hardware.simulated_body import Body
from lgmdjax.hardware.simulated_robot import TRACE, PictureServer, Renderer, SimulatedRobot, Terminal
from lgmdjax.hardware.simulated_servos import ServoBank
from lgmdjax.runtime import partial_files
from lgmdjax.sensors import camera
from lgmdjax.world import scenes
from lgmdjax.world.arena import Arena, empty_room

ROOMS: Mapping[RoomName, Callable[[jax.Array], Arena]] = {
    "testing": scenes.testing_room,
    "training": scenes.training_room,
    "indoor": lambda key: scenes.indoor_scene(key),
    "outdoor": lambda key: scenes.outdoor_scene(key),
    "random": lambda key: scenes.random_room(key, 0.15),
    "empty": lambda key: scenes.with_random_textures(empty_room(), key),
}
LINKS, MAP, TRACES = ("bus", "imu"), "servos.toml", "trace.csv"
"""Names of its files: links to the pseudo-terminals, the joint map, the trace."""
TRACE_HEADER = ",".join(TRACE) + "\n"


def run_robot(flags: SimRobotFlags) -> None:
    """Simulate the robot until the time is up or Ctrl-C."""
    for fault in flags.fault:
        if fault not in FAULTS:
            raise InputError(f"expected a known --fault, got {fault}; choose from {', '.join(FAULTS)}")
    with jax.enable_x64(False), contextlib.ExitStack() as stack:
        robot = _assemble(flags, stack)
        robot.renderer.compile(robot.body.pose())
        print(f"servos: {flags.out / 'bus'} ({robot.bus.name}), joint map {flags.out / MAP}")
        print(f"camera: {robot.eyes.address}")
        print(f"inertial sensor: {flags.out / 'imu'} ({robot.inertial.name})")
        print(f"faults that can be typed on stdin: {', '.join(FAULTS)}; clear", flush=True)
        robot.run(flags.seconds or math.inf, sys.stdin.fileno())


def _assemble(flags: SimRobotFlags, stack: contextlib.ExitStack) -> SimulatedRobot:
    """Open the ports of a robot, write its joint map, and link its pseudo-terminals."""
    servos = joint_map.default()
    _check_folder(flags.out, servos)
    bank, eye = ServoBank(servos.ids), camera.Params(width=flags.width, height=flags.width * 3 // 4)
    room = jax.jit(ROOMS[flags.room])(jax.random.key(flags.seed))
    try:
        partial_files.make_folder(flags.out)
        eyes = PictureServer(flags.port)
    except OSError as error:
        raise InputError(f"expected a folder and a free port, got {error}; choose another --out or --port") from error
    trace = stack.enter_context((flags.out / TRACES).open("w", encoding="ascii"))
    trace.write(TRACE_HEADER)
    robot = SimulatedRobot(
        body=Body(room, servos, bank),
        bank=bank,
        faults=ActiveFaults(dict.fromkeys(flags.fault, 0.0)),
        renderer=Renderer(room, eye),
        clock=Clock(flags.speed),
        bus=Terminal(),
        inertial=Terminal(),
        eyes=eyes,
        print_line=partial(print, flush=True),
        trace=trace,
    )
    stack.callback(robot.close)
    joint_map.write(flags.out / MAP, servos)
    for name, terminal in zip(LINKS, (robot.bus, robot.inertial), strict=True):
        path = flags.out / name
        path.unlink(missing_ok=True)
        path.symlink_to(terminal.name)
        stack.callback(path.unlink, missing_ok=True)
    return robot


def _check_folder(folder: Path, servos: JointMap) -> None:
    """Raise `InputError` if a file there is not one of an earlier simulation: it may be that of a real robot."""
    for name in (*LINKS, MAP, TRACES):
        path = folder / name
        if os.path.lexists(path) and not _is_own(path, servos):
            raise InputError(
                f"expected a new folder, or that of an earlier simulation, got {path}, which is another file; "
                "choose another --out"
            )


def _is_own(path: Path, servos: JointMap) -> bool:
    """Return whether a file is one of an earlier simulation, which may have been killed before it wrote the trace."""
    if path.name in LINKS or path.is_symlink():
        return path.name in LINKS and path.is_symlink()
    try:
        with path.open(encoding="utf-8") as file:
            if path.name == TRACES:
                return file.readline() in ("", TRACE_HEADER)
            return file.read() == joint_map.to_toml(servos)
    except (OSError, ValueError):
        return False
