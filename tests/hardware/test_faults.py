"""The end of every fault: driver, bus and supervisor against servos, body and eyes of the simulated robot.

All of it is in one process whose time passes only where somebody waits. So it takes no longer than the computer needs,
and a busy one changes nothing. How the processes themselves begin and end is the matter of `test_drive`.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.deployment import exporter
from lgmdjax.hardware import drive_log, joint_map, supervisor
from lgmdjax.hardware.camera_reader import Eyes, Frame
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.driver import Brain, Driver
from lgmdjax.hardware.faults import Faults
from lgmdjax.hardware.inertial import InertialSensor
from lgmdjax.hardware.servo_bus import ServoBus
from lgmdjax.hardware.simulated_body import Body
from lgmdjax.hardware.simulated_robot import PictureServer, Renderer, SimulatedRobot, Terminal
from lgmdjax.hardware.simulated_servos import Bank
from lgmdjax.hardware.supervisor import Mode, Reason
from lgmdjax.sensors import camera
from lgmdjax.world import scenes
from lgmdjax.world.arena import Arena

SEATED, STANDING = 0.04, 0.085  # m, of the trunk's centre: below, above
LONGEST = 15.0  # s of a drive
TICK = 0.002  # s


class WaitingTime(Clock):
    """Time of the robot's process, which passes by a tick wherever the process would wait."""

    time = 0.0

    def now(self) -> float:
        return self.time

    def to_wall(self, duration: float) -> float:
        self.time += min(max(duration, 0.0), TICK)
        return 0.0


class DriverTime(Clock):
    """The same time, for the driver: while it waits, the robot goes on."""

    def __init__(self, robot: SimulatedRobot):
        super().__init__()
        self.robot = robot

    def now(self) -> float:
        return self.robot.clock.now()

    def to_wall(self, duration: float) -> float:
        assert self.now() < LONGEST, "the drive does not end"
        if duration > 0:
            self.robot.turn()
        return 0.0


class PromptRenderer(Renderer):
    """A renderer that is done before time goes on."""

    def start(self, pose: hexapod.Pose) -> None:
        super().start(pose)
        assert self._pending is not None
        self._pending.result()


class Sent(PictureServer):
    """Keeps the newest picture."""

    newest: np.ndarray | None = None

    def send(self, picture: np.ndarray) -> None:
        self.newest = picture


class Received(Eyes):
    """Takes the picture that was kept."""

    def __init__(self, sent: Sent, clock: Clock):
        self._sent, self._clock, self._count = sent, clock, 0

    def take(self, timeout: float) -> Frame | None:
        end = self._clock.now() + timeout
        while self._sent.newest is None:
            if self._clock.now() >= end:
                return None
            self._clock.to_wall(end - self._clock.now())
        picture, self._sent.newest = self._sent.newest, None
        self._count += 1
        return Frame(self._count, self._clock.now(), np.stack(np.split(picture, 2, axis=1)))


Bench = tuple[Brain, Arena, Renderer]


@pytest.fixture(scope="module")
def compiled() -> Bench:
    """What has to be compiled, once for all robots."""
    with jax.enable_x64(False):
        params = exporter.load(None)
        room = jax.jit(scenes.testing_room)(jax.random.key(0))
        whole = camera.Params(width=params.camera.width, height=params.camera.height)  # as a real camera's pictures are
        made = Brain(params), room, PromptRenderer(room, whole)
    return made


class Drive:
    """A robot, and a driver to whom a hook happens at each change of the mode."""

    def __init__(self, compiled: Bench, folder: Path, act: Callable[["Drive", str], None]):
        brain, room, renderer = compiled
        servos, eyes, self.stops, self.modes = joint_map.default(), Sent(0), 0, list[str]()
        bank = Bank(servos.ids)
        self.robot = SimulatedRobot(
            body=Body(room, servos, bank),
            bank=bank,
            faults=Faults(),
            renderer=renderer,
            clock=WaitingTime(),
            bus=Terminal(),
            inertial=Terminal(),
            eyes=eyes,
            tell=lambda _: None,
        )
        clock = DriverTime(self.robot)
        self.heights: list[float] = []

        def tell(line: str) -> None:
            self.modes.append(line.split(": ")[1].split(",")[0])
            self.heights.append(float(self.robot.body.data.qpos[2]))
            act(self, self.modes[-1])

        bus = ServoBus(self.robot.bus.name, servos.baud, clock)
        with bus, InertialSensor(self.robot.inertial.name) as inertial, drive_log.Writer(folder, {}) as log:
            self.driver = Driver(
                brain=brain,
                eyes=Received(eyes, clock),
                bus=bus,
                servos=servos,
                clock=clock,
                log=log,
                stops=lambda: self.stops,
                tell=tell,
                params=supervisor.Params(),
                inertial=inertial,
            )
            self.reason = self.driver.run().reason
        self.height = float(self.robot.body.data.qpos[2])
        self.torque = int(self.robot.body.torques().sum())
        self.log = drive_log.read(folder)

    def times(self, mode: str) -> np.ndarray:
        return self.log["time"].to_numpy()[np.array(self.log["mode"].to_pylist()) == mode]


@pytest.fixture
def drive(compiled: Bench, tmp_path: Path) -> Iterator[Callable[..., Drive]]:
    made: list[Drive] = []

    def start(act: Callable[[Drive, str], None]) -> Drive:
        with jax.enable_x64(False):
            made.append(Drive(compiled, tmp_path / "log", act))
        return made[-1]

    yield start
    for each in made:
        each.robot.close()


def switch(fault: str, drive: Drive, mode: str, at: str = "walk") -> None:
    """Switch a fault on when a mode begins."""
    if mode == at:
        drive.robot.faults.obey(fault)


@pytest.mark.parametrize(
    ("fault", "reason", "holding"),
    [
        ("hot-servo", Reason.HOT, []),
        ("low-voltage", Reason.LOW_VOLTAGE, []),
        ("dead-servo", Reason.BUS_ERROR, [5]),
        ("garbled", Reason.BUS_ERROR, None),
    ],
)
def test_a_servo_at_fault_makes_it_sit_down_slowly_and_then_let_go(
    drive: Callable[..., Drive], fault: str, reason: Reason, holding: list[int] | None
) -> None:
    found = drive(partial(switch, fault))
    assert found.modes == ["stand", "walk", "sit", "off"] and found.reason is reason
    assert found.heights[2] > STANDING and found.heights[3] < SEATED  # it let go when it sat
    assert np.ptp(found.times("sit")) > 0.8
    if holding is not None:
        assert found.driver.holding == holding and found.torque == 0


def test_a_fall_makes_it_sit_down_and_let_go(drive: Callable[..., Drive]) -> None:
    found = drive(partial(switch, "fall"))
    assert found.modes[-2:] == ["sit", "off"] and found.reason is Reason.FALLEN
    assert found.torque == 0 and found.driver.holding == []


def test_a_cut_bus_leaves_all_servos_holding_and_says_so(drive: Callable[..., Drive]) -> None:
    found = drive(partial(switch, "bus-cut"))
    assert found.modes[-2:] == ["sit", "off"] and found.reason is Reason.BUS_ERROR
    assert found.driver.holding == list(range(1, 19))
    assert found.torque == 18 and found.height > STANDING  # nobody could tell it to sit down


def test_a_pulled_plug_ends_the_drive_at_once(drive: Callable[..., Drive]) -> None:
    found = drive(partial(switch, "unplugged"))
    assert found.reason is Reason.BUS_LOST and found.driver.state.mode is Mode.OFF
    assert found.modes == ["stand", "walk"] and found.driver.holding == list(range(1, 19))
    assert found.times("walk")[-1] - found.times("walk")[0] < 0.1


def test_without_frames_it_stands_and_walks_on_and_a_stop_makes_it_sit_down(drive: Callable[..., Drive]) -> None:
    def act(drive: Drive, mode: str) -> None:
        walks = drive.modes.count("walk")
        if mode == "walk":
            drive.stops = walks - 1
            drive.robot.faults.obey("frames-stopped")
        if mode == "stand" and walks:
            drive.robot.faults.obey("clear")

    found = drive(act)
    assert found.modes == ["stand", "walk", "stand", "walk", "sit", "off"]
    assert found.reason is Reason.STOPPED and found.height < SEATED and found.torque == 0
    modes, ages = found.log["mode"].to_pylist(), found.log["frame_age"].to_pylist()
    stopped = modes.index("stand", modes.index("walk"))
    assert 0.2 < ages[stopped] < 0.25 and modes[stopped - 1] == "walk"


def test_a_second_stop_lets_go_at_once_and_corrupt_packets_do_not_matter(drive: Callable[..., Drive]) -> None:
    def act(drive: Drive, mode: str) -> None:
        drive.robot.faults.obey("corrupt")
        drive.stops = {"walk": 1, "sit": 2}.get(mode, drive.stops)

    found = drive(act)
    assert found.modes == ["stand", "walk", "sit", "off"] and found.reason is Reason.STOPPED
    assert found.driver.bus.failed > 0 and found.height > SEATED and found.torque == 0
