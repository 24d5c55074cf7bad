"""`lgmdjax drive`: a trained nervous system drives a robot, from its camera to its servos."""

import contextlib
import math
import sys
import time
from pathlib import Path

import jax

from lgmdjax.body import robot_xml
from lgmdjax.cli.hardware_flags import DriveFlags
from lgmdjax.deployment import exporter
from lgmdjax.errors import InputError
from lgmdjax.hardware import drive_log, joint_map, lens, live_source, servo_bus, supervisor
from lgmdjax.hardware.camera_reader import StereoReader
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.driver import Driver, NervousSystem
from lgmdjax.hardware.inertial import InertialSensor
from lgmdjax.hardware.joint_map import JointMap
from lgmdjax.hardware.servo_bus import BusLost, ServoBus
from lgmdjax.hardware.supervisor import Reason
from lgmdjax.runtime import interruption

ORDERLY = (Reason.STOPPED, Reason.FINISHED)  # ends with exit code 0; any other ends with 1


def drive(flags: DriveFlags) -> int:
    """Drive a robot until it sits without torque; return the exit code."""
    servo_bus.check_installed()
    _refuse_other_body(flags.run())
    clock, servos = Clock(flags.speed), joint_map.read(flags.map)
    lenses = tuple(lens.read(path) for path in flags.calibration)
    params = exporter.load(flags.run())
    with jax.enable_x64(False):
        nervous_system = NervousSystem(params)
        with contextlib.ExitStack() as stack:
            eyes = stack.enter_context(StereoReader(flags.camera, lenses, params.camera, clock, mono=flags.mono))
            inertial = None if flags.imu is None else stack.enter_context(InertialSensor(flags.imu))
            bus = stack.enter_context(ServoBus(flags.servos, servos.baud, clock))
            _connect(bus, servos, flags.map)
            facts = {
                "camera": [live_source.without_login(name) for name in flags.camera],
                "robot": str(flags.robot),
                "speed": flags.speed,
            }
            log = stack.enter_context(drive_log.Writer(_folder(flags), facts))
            print(f"the cameras see {100 * eyes.seen():.0f} % of the eyes' field; log in {log.folder}", flush=True)
            stop_requests = stack.enter_context(interruption.counting())
            limits = supervisor.Params(lowest_voltage=servos.voltage, highest_temperature=servos.temperature)
            try:
                driver = Driver(
                    nervous_system=nervous_system,
                    eyes=eyes,
                    bus=bus,
                    servos=servos,
                    clock=clock,
                    log=log,
                    stop_requests=stop_requests,
                    print_line=_print_line,
                    params=limits,
                    inertial=inertial,
                    seconds=flags.seconds or math.inf,
                )
            except BusLost as error:
                raise InputError(f"expected servos that report their positions, got {error}; check cables") from error
            return _run(flags, driver)


def _refuse_other_body(run: Path | None) -> None:
    """Raise `InputError` for a run with a body of its own, since sitting and standing are those of the package's."""
    if run is not None and robot_xml.read_body(run / "fit-gait") is not None:
        raise InputError(
            f"expected a robot with the package's body, got {run} with one of its own, for which no motion to sit and "
            "to stand is known; drive it by its exported nervous system (`lgmdjax export`)"
        )


def _run(flags: DriveFlags, driver: Driver) -> int:
    """Run a driver, print the result, and return the exit code."""
    reason = driver.run().reason or Reason.STOPPED
    print(driver.timing.describe() + (f", on a clock at {flags.speed:g}" if flags.speed < 1 else ""))
    print(f"bus: {driver.bus.answered} answers, {driver.bus.failed} missing or garbled", flush=True)
    if driver.holding:
        held = ", ".join(map(str, driver.holding))
        print(f"lgmdjax: servos {held} did not confirm that torque is off: switch off their power", file=sys.stderr)
    if reason in ORDERLY and not driver.holding:
        return 0
    silent = driver.bus.silent_servos()
    named = f" (servos {', '.join(map(str, silent))})" if reason is Reason.BUS_ERROR and silent else ""
    print(f"lgmdjax: stopped, because {reason.value}{named}", file=sys.stderr)
    return 1


def _connect(bus: ServoBus, servos: JointMap, path: Path) -> None:
    """Find all servos of the map and set their limits; raise `InputError` if one is missing."""
    try:
        missing = set(servos.ids)
        for _ in range(servo_bus.CONNECT_ATTEMPTS):
            missing -= set(bus.find(sorted(missing)))
        if missing:
            names = ", ".join(
                f"{number} ({joint_map.JOINT_NAMES[servos.ids.index(number)]})" for number in sorted(missing)
            )
            raise InputError(
                f"expected the servos of {path} on the bus, got no answer from {names}; check power and cables"
            )
        bus.configure(servos.ids, speed=servos.speed, torque=servos.torque)
    except BusLost as error:
        raise InputError(f"expected a bus with servos, got {error}; check power and cables") from error


def _folder(flags: DriveFlags) -> Path:
    return flags.out / (flags.name or time.strftime("%Y%m%d-%H%M%S"))


def _print_line(line: str) -> None:
    print(line, flush=True)
