"""`lgmdjax drive` against `lgmdjax sim-robot`, each a process as a user starts it: pictures that stop, and kill -9.

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

from lgmdjax.paths import PACKAGE_DIR

pytestmark = pytest.mark.slow
SPEED = os.environ.get("LGMDJAX_TEST_SPEED", "0.15")  # of both clocks; lower on a busy computer
PATIENCE = 300.0  # s of the wall, after which a test gives up
LONGEST = "150"  # s of the robot, after which it ends even if nobody stops it
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
        self.output = robot.folder / f"{name}.txt"
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


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    made = Robot(tmp_path_factory.mktemp("robot"))
    yield made
    made.process.send_signal(signal.SIGINT)
    assert made.process.wait(PATIENCE) == 130


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
