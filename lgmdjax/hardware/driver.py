"""The loop that drives a robot: pictures in, set points out, with the supervisor between them.

The loop makes a step at the rate of the gait, and whenever pictures arrive. Each step runs the nervous system on new
pictures, lets the supervisor choose the mode, and sends the set points of that mode within the limits. At the rate of
the gait it also reads the status of one servo and logs a row. For each frame the nervous system returns the set points
of `SUBSTEPS` steps; if the next frame is late, the last set points are held.
"""

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from lgmdjax.deployment import nervous_system
from lgmdjax.hardware import drive_log, joint_map, postures, supervisor
from lgmdjax.hardware.ax_servo import StatusError
from lgmdjax.hardware.camera_reader import Frame, StereoReader
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.inertial import InertialSensor
from lgmdjax.hardware.joint_map import JointMap
from lgmdjax.hardware.servo_bus import BusLost, ServoBus, Status
from lgmdjax.hardware.supervisor import Mode, Readings
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS

STEP = 1 / (FRAME_RATE * SUBSTEPS)  # s
SLOW_MODES = {Mode.RISE: -1, Mode.STAND: -1, Mode.SIT: 0}  # and the index of the posture that they move to
NO_ERROR = StatusError(0)
LATE = 1.5  # frame periods between two pictures; if it is more, a frame was missed


class NervousSystem:
    """The nervous system, compiled, and its state."""

    def __init__(self, params: nervous_system.Params):
        self.params = params
        self._step = jax.jit(partial(nervous_system.step, params))
        self.restart()
        self(np.zeros(nervous_system.picture_shape(params), np.uint8))  # compiles
        self.restart()

    def restart(self) -> None:
        """Return to the state before the first picture."""
        self._state = nervous_system.init(self.params)

    def __call__(self, pictures: np.ndarray) -> nervous_system.Output:
        """Process the pictures of a frame; return its output as NumPy arrays."""
        self._state, output = self._step(self._state, pictures)
        return jax.tree.map(np.asarray, output)


@dataclass
class ServoReadings:
    """The last readings of the servos, by joint."""

    angles: Float[np.ndarray, "6 3"]
    loads: list[float | None] = field(default_factory=lambda: [None] * 18)
    temperatures: list[float | None] = field(default_factory=lambda: [None] * 18)
    voltages: list[float | None] = field(default_factory=lambda: [None] * 18)
    errors: StatusError = NO_ERROR

    def take(self, servos: JointMap, joint: int, status: Status) -> None:
        """Store the status of a servo."""
        turn = int(servos.directions[joint])
        self.angles.reshape(18)[joint] = joint_map.to_angle(servos, joint, status.position)
        self.loads[joint], self.temperatures[joint] = turn * status.load, status.temperature
        self.voltages[joint], self.errors = status.voltage, self.errors | status.errors

    def voltage(self) -> float | None:
        """Return the median voltage of the servos [V], as one may measure badly; 0 if one reports it out of range."""
        if self.errors & StatusError.VOLTAGE:
            return 0.0
        known = [value for value in self.voltages if value is not None]
        return statistics.median(known) if known else None

    def temperature(self) -> float | None:
        """Return the highest temperature [degrees Celsius]; infinite if a servo reports that it is too hot."""
        known = [value for value in self.temperatures if value is not None]
        hottest = max(known, default=None)
        return math.inf if self.errors & StatusError.OVERHEATING else hottest


@dataclass
class Timing:
    """Delays from frames to their set points, in wall-clock time, and the number of missed frames."""

    latencies: list[float] = field(default_factory=list)  # s
    missed: int = 0

    def describe(self) -> str:
        """Return a summary of one line."""
        if not self.latencies:
            return "no frame was used for walking"
        median, late = np.percentile(self.latencies, [50, 99]) * 1000
        frames = len(self.latencies)
        counts = f"{frames} frames, {self.missed} missed"
        return f"frame to target: median {median:.1f} ms, 99th percentile {late:.1f} ms; {counts}"


@dataclass(kw_only=True)
class Driver:
    """A robot that is driven: its open devices, and its state."""

    nervous_system: NervousSystem
    eyes: StereoReader
    bus: ServoBus
    servos: JointMap
    clock: Clock
    log: drive_log.Writer
    stop_requests: Callable[[], int]  # requests to stop so far
    print_line: Callable[[str], None]  # prints a line for the user
    params: supervisor.Params
    inertial: InertialSensor | None = None
    seconds: float = math.inf  # of walking

    def __post_init__(self) -> None:
        self.state = supervisor.init(self.clock.now())
        self.timing = Timing()
        self.servo_readings = ServoReadings(self._read_all())
        self.setpoints = self.servo_readings.angles.copy()
        self._output: nervous_system.Output | None = None
        self._frame: Frame | None = None
        self._walked_on: float | None = None  # time of the frame that the output is for
        self.holding: list[int] = []  # servos that did not confirm that their torque is off
        self._walk_ends, self._next_joint = math.inf, 0
        self._last, self._due = self.clock.now(), self.clock.now()

    def run(self) -> supervisor.State:
        """Drive until the torque is off; return the last state, with the reason."""
        try:
            while self.state.mode is not Mode.OFF:
                self._step()
        except BusLost:
            self.state = supervisor.step(self.params, self.state, self._readings(self.clock.now(), bus_lost=True))
        except BaseException:
            self._sit_blindly()
            raise
        finally:
            self.holding = self.bus.release(self.servos.ids)
        return self.state

    def _read_all(self) -> Float[np.ndarray, "6 3"]:
        """Return the joint angles [rad]; raise `BusLost` if a servo does not answer."""
        found = [self._read_patiently(servo) for servo in self.servos.ids]
        return joint_map.to_angles(self.servos, np.array(found))

    def _read_patiently(self, servo: int) -> int:
        for _ in range(10):
            if (status := self.bus.read_status(servo)) is not None:
                return status.position
        raise BusLost(f"servo {servo} does not answer")

    def _step(self) -> None:
        """Wait for pictures or for the next step of the gait, then make a step of the loop."""
        frame = self.eyes.take(self._due - self.clock.now())
        now = self.clock.now()
        if frame is not None:
            self._see(frame)
        before, self.state = self.state.mode, supervisor.step(self.params, self.state, self._readings(now))
        if self.state.mode is not before:
            self._enter(now)
        if self.state.mode is Mode.OFF:
            return
        self._send(now)
        if frame is not None and self._walked_on == frame.time:
            self.timing.latencies.append(self.clock.to_wall(self.clock.now() - frame.time))
        if now >= self._due:
            self._due = max(self._due + STEP, now)
            self._ask_one_servo()
            self._record(now)

    def _see(self, frame: Frame) -> None:
        """Run the nervous system on a frame, if the robot walks."""
        walking = self.state.mode is Mode.WALK
        if walking and self._frame is not None:
            gap = (frame.time - self._frame.time) * FRAME_RATE
            self.timing.missed += max(round(gap) - 1, 0) if gap > LATE else 0
        self._frame = frame
        if walking:
            self._output, self._walked_on = self.nervous_system(frame.pictures), frame.time

    def _readings(self, now: float, *, bus_lost: bool = False) -> Readings:
        target = SLOW_MODES.get(self.state.mode)
        return Readings(
            time=now,
            frame_age=math.inf if self._frame is None else now - self._frame.time,
            arrived=target is not None and postures.has_reached(target, self.setpoints),
            stop_requests=self.stop_requests(),
            finished=now >= self._walk_ends,
            bus_error=self.bus.has_error(),
            bus_lost=bus_lost,
            voltage=self.servo_readings.voltage(),
            temperature=self.servo_readings.temperature(),
            overloaded=bool(self.servo_readings.errors & StatusError.OVERLOAD),
            fallen=self.inertial is not None and self.inertial.has_fallen(now),
        )

    def _enter(self, now: float) -> None:
        """Begin a mode."""
        mode, reason = self.state.mode, self.state.reason
        self.print_line(f"{now:6.1f} s: {mode.value}" + (f", because {reason.value}" if reason else ""))
        self._output = None
        if mode is Mode.WALK:
            self.nervous_system.restart()
            self._walk_ends = min(self._walk_ends, now + self.seconds)

    def _send(self, now: float) -> None:
        """Send the set points of the mode, within the limits."""
        elapsed, self._last = min(now - self._last, 3 * STEP), now  # no jump after a pause
        target = SLOW_MODES.get(self.state.mode)
        limits = self.servos.limits()
        if target is not None:
            wanted, speed = postures.toward(target, self.setpoints, postures.SLOW * elapsed), postures.SLOW
        else:
            wanted = self._targets(now)
            share = min((now - self.state.since) / postures.RAMP, 1.0)
            speed = postures.SLOW + share * max(limits.speed - postures.SLOW, 0.0)
        self.setpoints = postures.limit(limits, self.setpoints, wanted, speed * elapsed)
        self._write_goals()

    def _write_goals(self) -> None:
        self.bus.write_goals(
            dict(zip(self.servos.ids, joint_map.to_positions(self.servos, self.setpoints), strict=True))
        )

    def _targets(self, now: float) -> Float[np.ndarray, "6 3"]:
        """Return the nervous system's set points for the present time; before its first frame, the last ones sent."""
        if self._output is None or self._walked_on is None:
            return self.setpoints
        return np.asarray(self._output.targets[min(int((now - self._walked_on) / STEP), SUBSTEPS - 1)], float)

    def _ask_one_servo(self) -> None:
        joint, self._next_joint = self._next_joint, (self._next_joint + 1) % len(self.servos.ids)
        if self.state.mode is Mode.SIT:
            return  # waiting for answers would make the motion jerky
        if (status := self.bus.read_status(self.servos.ids[joint])) is not None:
            self.servo_readings.take(self.servos, joint, status)

    def _record(self, now: float) -> None:
        """Log a step."""
        output, reason, frame = self._output, self.state.reason, self._frame
        row: drive_log.Row = {
            "time": now,
            "mode": self.state.mode.value,
            "reason": reason.value if reason else "",
            "frame": frame.number if frame else 0,
            "frame_age": now - frame.time if frame else None,
            "voltage": self.servo_readings.voltage(),
            "bus_failures": self.bus.failed,
            "stops": self.stop_requests(),
        }
        for index, side in enumerate(drive_log.SIDES):
            row[f"u_{side}"] = None if output is None else float(output.u[index])
            row[f"velocity_{side}"] = None if output is None else float(output.velocity[index])
        angles, targets = self.servo_readings.angles.reshape(18).tolist(), self.setpoints.reshape(18).tolist()
        row |= {f"target_{joint}": value for joint, value in enumerate(targets)}
        row |= {f"joint_{joint}": value for joint, value in enumerate(angles)}
        row |= {f"load_{joint}": value for joint, value in enumerate(self.servo_readings.loads)}
        row |= {f"temperature_{joint}": value for joint, value in enumerate(self.servo_readings.temperatures)}
        self.log.add(row)

    def _sit_blindly(self) -> None:
        """Lower the robot without reading any sensor, after an error in this program."""
        end = self.clock.now() + self.params.sit_timeout
        try:
            while self.clock.now() < end and self.stop_requests() < 2 and not postures.has_reached(0, self.setpoints):
                self.setpoints = postures.toward(0, self.setpoints, postures.SLOW * STEP)
                self._write_goals()
                self.eyes.take(STEP)
        except BusLost:
            return
