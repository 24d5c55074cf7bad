"""`lgmdjax drive` against `lgmdjax sim-robot`, each a process as a user starts it: a walk, and the end of every fault.

Both go by a slow clock, so that a busy computer changes nothing.
"""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lgmdjax.hardware import drive_log, postures
from lgmdjax.paths import PACKAGE_DIR

pytestmark = pytest.mark.slow
SPEED = os.environ.get("LGMDJAX_TEST_SPEED", "0.2")  # of both clocks; lower on a busy computer
PATIENCE = 900.0  # s of the wall, after which a test gives up
SEATED, STANDING = 0.04, 0.09  # m, of the trunk's centre: below, above
ENVIRONMENT = os.environ | {"PYTHONPATH": str(PACKAGE_DIR.parent), "PYTHONUNBUFFERED": "1"}


def start(command: str, *flags: str | Path, out: Path) -> subprocess.Popen[str]:
    with out.open("w") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "lgmdjax", command, *map(str, flags), "--speed", SPEED],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            text=True,
            env=ENVIRONMENT,
            preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background job ignores it
        )


def wait_until(holds: Callable[[], object], what: Callable[[], str]) -> None:
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end, what()
        time.sleep(0.05)


class Robot:
    """The simulated robot's process."""

    def __init__(self, folder: Path):
        self.folder, self.drives = folder, 0
        self.output = folder / "sim.txt"
        self.process = start("sim-robot", "--port", "0", "--out", folder, out=self.output)
        wait_until(lambda: "faults" in self.output.read_text() or self.process.poll(), self.output.read_text)
        self.camera = re.findall(r"camera: (\S+)", self.output.read_text())[0]

    def command(self, line: str) -> None:
        """Switch a fault on, or all off, and wait until it is."""
        assert self.process.stdin is not None
        before = self.output.read_text()
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        wait_until(lambda: self.output.read_text() != before, self.output.read_text)

    def trace(self) -> dict[str, np.ndarray]:
        """Return what the robot did so far, by column."""
        with (self.folder / "trace.csv").open() as file:
            header, *rows = csv.reader(file)
        rows = [row for row in rows if len(row) == len(header)]
        return dict(zip(header, np.array(rows[:-1], float).T, strict=True))  # the last line may be half written

    def drive(self, *flags: str) -> "Drive":
        self.drives += 1
        return Drive(self, f"drive-{self.drives}", flags)


class Drive:
    """A process that drives the simulated robot."""

    def __init__(self, robot: Robot, name: str, flags: tuple[str, ...]):
        self.log, self.output = robot.folder / name, robot.folder / f"{name}.txt"
        plugs = ("--camera", robot.camera, "--servos", robot.folder / "bus", "--map", robot.folder / "servos.toml")
        self.process = start("drive", *plugs, "--out", robot.folder, "--name", name, *flags, out=self.output)

    def wait_for(self, mode: str, count: int = 1) -> None:
        """Wait until a mode was entered so many times."""
        pattern = re.compile(rf"^ *[\d.]+ s: {mode}", re.M)
        wait_until(lambda: len(pattern.findall(self.output.read_text())) >= count, self.output.read_text)

    def end(self) -> tuple[int, str]:
        """Wait for the end; return exit code and output."""
        wait_until(lambda: self.process.poll() is not None, self.output.read_text)
        return self.process.returncode, self.output.read_text()


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    made = Robot(tmp_path_factory.mktemp("robot"))
    yield made
    made.process.send_signal(signal.SIGINT)
    assert made.process.wait(PATIENCE) == 130


def assert_lies_without_torque(robot: Robot) -> None:
    """The robot came down slowly and then let go."""
    trace = robot.trace()
    assert trace["z"][-1] < SEATED and trace["upright"][-1] > 0.95 and trace["torque"][-1] == 0
    let_go = np.flatnonzero(np.diff(trace["torque"]) < 0)[-1]
    standing = np.flatnonzero(trace["z"][: let_go + 1] > STANDING)[-1]
    assert trace["time"][let_go] - trace["time"][standing] > 0.8
    assert trace["z"][let_go] < SEATED


def test_it_walks_without_touching_anything_though_some_packets_are_corrupt(robot: Robot) -> None:
    drive = robot.drive("--seconds", "5")
    drive.wait_for("walk")
    robot.command("corrupt")
    code, output = drive.end()
    robot.command("clear")
    assert code == 0, output
    assert re.search(r"frame to target: median [\d.]+ ms, 99th percentile [\d.]+ ms; \d+ frames, \d+ missed", output)
    trace = robot.trace()
    assert trace["touched"][-1] == 0 and trace["upright"].min() > 0.9
    assert np.hypot(trace["x"][-1] - trace["x"][0], trace["y"][-1] - trace["y"][0]) > 0.1
    assert_lies_without_torque(robot)

    log = drive_log.read(drive.log)
    modes = log["mode"].to_pylist()
    order = [mode for before, mode in zip(["", *modes], modes, strict=False) if mode != before]
    assert order == ["rise", "stand", "walk", "sit"]
    assert log["bus_failures"].to_pylist()[-1] > 0
    targets = drive_log.joints(log, "target")
    walking = np.array(modes) == "walk"
    assert np.ptp(targets[walking], axis=0).min() > 0.1  # every joint took part
    joints = drive_log.joints(log, "joint")
    for joint in range(18):  # read every tenth of a second, and so a little late
        assert np.corrcoef(joints[walking][90:, joint], targets[walking][90:, joint])[0, 1] > 0.5
    assert {"u_left", "velocity_right", "voltage"} <= set(log.column_names)


def test_without_frames_it_stands_walks_on_when_they_come_back_and_sits_down_after_ctrl_c(robot: Robot) -> None:
    drive = robot.drive()
    drive.wait_for("walk")
    robot.command("frames-stopped")
    drive.wait_for("stand", 2)
    robot.command("clear")
    drive.wait_for("walk", 2)
    drive.process.send_signal(signal.SIGINT)
    code, output = drive.end()
    assert code == 0 and "sit, because asked to stop" in output
    assert_lies_without_torque(robot)
    log = drive_log.read(drive.log)
    modes, ages = log["mode"].to_pylist(), log["frame_age"].to_pylist()
    stopped = modes.index("stand", modes.index("walk"))
    assert 0.2 < ages[stopped] < 0.3 and modes[stopped - 1] == "walk"


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("hot-servo", "stopped, because a servo is hot"),
        ("dead-servo", "stopped, because servos did not answer as they should (servos 5)"),
    ],
)
def test_a_faulty_servo_makes_it_sit_down(robot: Robot, fault: str, words: str) -> None:
    drive = robot.drive()
    drive.wait_for("walk")
    robot.command(fault)
    code, output = drive.end()
    assert code == 1 and words in output
    assert ("servos 5 did not say that they let go" in output) == (fault == "dead-servo")
    robot.command("clear")
    assert_lies_without_torque(robot)
    temperatures = drive_log.joints(drive_log.read(drive.log), "temperature")
    assert (np.nanmax(temperatures) >= 70) == (fault == "hot-servo")


def test_after_kill_9_it_stands_still_and_the_next_start_is_gentle(robot: Robot) -> None:
    drive = robot.drive()
    drive.wait_for("walk")
    drive.process.kill()
    drive.process.wait()
    killed = robot.trace()["time"][-1]
    wait_until(lambda: robot.trace()["time"][-1] > killed + 1.0, robot.output.read_text)
    trace = robot.trace()
    still = trace["time"] > killed + 0.6
    assert trace["torque"][-1] == 18 and trace["z"][still].min() > 0.08
    assert np.ptp(trace["x"][still]) < 0.002 and np.ptp(trace["joint_4"][still]) < 0.01

    again = robot.drive()
    again.wait_for("walk")
    again.process.send_signal(signal.SIGINT)
    again.wait_for("sit")
    again.process.send_signal(signal.SIGINT)  # the second one
    code, output = again.end()
    assert code == 0 and "off, because asked to stop" in output
    assert robot.trace()["torque"][-1] == 0
    log = drive_log.read(again.log)
    modes, targets = np.array(log["mode"].to_pylist()), drive_log.joints(log, "target")
    speeds = np.abs(np.diff(targets, axis=0)).max(axis=1) / np.diff(log["time"].to_numpy())
    slow = np.isin(modes[1:], ["rise", "stand", "sit"])
    assert np.percentile(speeds[slow], 99) < 1.5 * postures.SLOW
    assert np.abs(targets[0] - drive_log.joints(log, "joint")[0]).max() < 0.05  # from where the legs were
    assert modes[-1] == "sit" and np.abs(targets[-1] - postures.row()[0].reshape(18)).max() > 0.1  # it had not sat yet


def test_a_cut_bus_and_a_pulled_plug_end_with_a_warning(robot: Robot) -> None:
    drive = robot.drive()
    drive.wait_for("walk")
    robot.command("bus-cut")
    code, output = drive.end()
    assert code == 1 and "servos did not answer as they should" in output and "switch their power off" in output
    assert robot.trace()["torque"][-1] == 18 and robot.trace()["z"][-1] > 0.08  # nobody told it to sit down
    robot.command("clear")
    drive = robot.drive()
    drive.wait_for("stand")
    robot.command("unplugged")
    code, output = drive.end()
    assert code == 1 and "the servos' port is gone" in output and "switch their power off" in output
