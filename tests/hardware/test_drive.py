"""`lgmdjax drive` against `lgmdjax sim-robot`, each a process as a user starts it: three drives of one robot.

Both go by a slow clock, so that a busy computer changes nothing. The other faults end in `test_faults`, in one process.
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
SPEED = os.environ.get("LGMDJAX_TEST_SPEED", "0.15")  # of both clocks; lower on a busy computer
PATIENCE = 300.0  # s of the wall, after which a test gives up
LONGEST = "150"  # s of the robot, after which it ends even if nobody stops it
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
        self.process = start("sim-robot", "--port", "0", "--seconds", LONGEST, "--out", folder, out=self.output)
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

    def wait(self, seconds: float) -> None:
        """Let the robot go on for some seconds of its time."""
        end = self.trace()["time"][-1] + seconds
        wait_until(lambda: self.trace()["time"][-1] > end, self.output.read_text)

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
        self.wait_for_line(rf"^ *[\d.]+ s: {mode}", count)

    def wait_for_line(self, pattern: str, count: int = 1) -> None:
        """Wait until so many lines were printed; fail if the process ends without."""
        found, ended = re.compile(pattern, re.M), False
        while len(found.findall(self.output.read_text())) < count:
            assert not ended, self.output.read_text()
            ended = self.process.poll() is not None
            time.sleep(0.05)

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


def test_frames_stop_and_come_back_and_after_kill_9_the_robot_stands_still(robot: Robot) -> None:
    drive = robot.drive()
    drive.wait_for("walk")
    robot.command("frames-stopped")
    drive.wait_for("stand", 2)
    robot.command("clear")
    drive.wait_for("walk", 2)
    robot.wait(0.5)
    drive.process.kill()
    drive.process.wait()
    killed = robot.trace()["time"][-1]
    robot.wait(1.0)
    trace = robot.trace()
    still = trace["time"] > killed + 0.6
    assert trace["torque"][-1] == 18 and trace["z"][still].min() > 0.08
    assert np.ptp(trace["x"][still]) < 0.002 and np.ptp(trace["joint_4"][still]) < 0.01


def test_the_next_start_is_gentle_and_after_a_walk_ctrl_c_makes_it_sit_down(robot: Robot) -> None:
    drive = robot.drive()
    drive.wait_for("walk")
    before = robot.trace()
    robot.command("corrupt")
    robot.wait(2.0)
    drive.process.send_signal(signal.SIGINT)
    code, output = drive.end()
    robot.command("clear")
    assert code == 0 and "sit, because asked to stop" in output, output
    assert re.search(r"frame to target: median [\d.]+ ms, 99th percentile [\d.]+ ms; \d+ frames, \d+ missed", output)
    trace = robot.trace()
    assert trace["touched"][-1] == 0 and trace["upright"].min() > 0.9
    assert np.hypot(trace["x"][-1] - before["x"][-1], trace["y"][-1] - before["y"][-1]) > 0.02
    assert_lies_without_torque(robot)

    log = drive_log.read(drive.log)
    modes, targets, joints = np.array(log["mode"].to_pylist()), *(drive_log.joints(log, n) for n in ("target", "joint"))
    assert [mode for k, mode in enumerate(modes) if k == 0 or modes[k - 1] != mode] == ["rise", "stand", "walk", "sit"]
    assert log["bus_failures"].to_pylist()[-1] > 0
    walking = modes == "walk"
    assert np.ptp(targets[walking], axis=0).min() > 0.1  # every joint took part
    for joint in range(18):  # read every tenth of a second, and so a little late
        assert np.corrcoef(joints[walking][90:, joint], targets[walking][90:, joint])[0, 1] > 0.5
    assert np.abs(targets[0] - joints[0]).max() < 0.05  # from where the legs were
    speeds = np.abs(np.diff(targets, axis=0)).max(axis=1) / np.diff(log["time"].to_numpy())
    assert np.percentile(speeds[~walking[1:]], 99) < 1.5 * postures.SLOW


def test_a_cut_bus_ends_with_a_warning(robot: Robot) -> None:
    drive = robot.drive()
    drive.wait_for_line("log in")
    robot.wait(0.3)
    robot.command("bus-cut")
    code, output = drive.end()
    assert code == 1 and "servos did not answer as they should" in output and "switch their power off" in output
    assert robot.trace()["torque"][-1] == 18  # nobody told them to let go
