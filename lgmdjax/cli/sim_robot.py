"""`lgmdjax sim-robot`: a process that simulates the robot, to try `lgmdjax drive` without hardware."""

import contextlib
import math
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
from lgmdjax.hardware.simulated_body import Body
from lgmdjax.hardware.simulated_robot import TRACE, PictureServer, Renderer, SimulatedRobot, Terminal
from lgmdjax.hardware.simulated_servos import ServoBank
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


def run_robot(flags: SimRobotFlags) -> None:
    """Simulate the robot until the time is up or Ctrl-C."""
    for fault in flags.fault:
        if fault not in FAULTS:
            raise InputError(f"expected a known --fault, got {fault}; choose from {', '.join(FAULTS)}")
    with jax.enable_x64(False), contextlib.ExitStack() as stack:
        robot = _assemble(flags, stack)
        robot.renderer.compile(robot.body.pose())
        print(f"servos: {flags.out / 'bus'} ({robot.bus.name}), joint map {flags.out / 'servos.toml'}")
        print(f"camera: {robot.eyes.address}")
        print(f"inertial sensor: {flags.out / 'imu'} ({robot.inertial.name})")
        print(f"faults that can be typed on stdin: {', '.join(FAULTS)}; clear", flush=True)
        robot.run(flags.seconds or math.inf, sys.stdin.fileno())


def _assemble(flags: SimRobotFlags, stack: contextlib.ExitStack) -> SimulatedRobot:
    """Open the ports of a robot, write its joint map, and link its pseudo-terminals."""
    room = jax.jit(ROOMS[flags.room])(jax.random.key(flags.seed))
    servos = joint_map.default()
    bank, eye = ServoBank(servos.ids), camera.Params(width=flags.width, height=flags.width * 3 // 4)
    try:
        flags.out.mkdir(parents=True, exist_ok=True)
        eyes = PictureServer(flags.port)
    except OSError as error:
        raise InputError(f"expected a folder and a free port, got {error}; choose another --out or --port") from error
    trace = stack.enter_context((flags.out / "trace.csv").open("w", encoding="ascii"))
    trace.write(",".join(TRACE) + "\n")
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
    joint_map.write(flags.out / "servos.toml", servos)
    for name, terminal in (("bus", robot.bus), ("imu", robot.inertial)):
        _link(flags.out / name, terminal.name)
        stack.callback((flags.out / name).unlink, missing_ok=True)
    return robot


def _link(path: Path, target: str) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(target)
