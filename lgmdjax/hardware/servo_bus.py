"""The servos' half-duplex bus, through dynamixel-sdk: Protocol 1.0 of AX-12A and AX-18A.

Set points go to all servos in one packet (sync write), which no servo answers. Position, speed, load, voltage and
temperature are adjacent in a servo's table, and are read from one servo at a time. A servo whose answer is missing or
garbled `MAX_FAILURES` times in a row counts as a fault; a port that fails counts as lost.
"""

import select
import termios
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, TypeVar

from lgmdjax.errors import InputError, one_line
from lgmdjax.hardware import ax_servo
from lgmdjax.hardware.ax_servo import Address, StatusError
from lgmdjax.hardware.clock import Clock

HAS_SDK = find_spec("dynamixel_sdk") is not None and find_spec("serial") is not None
if TYPE_CHECKING or HAS_SDK:
    from dynamixel_sdk import COMM_SUCCESS, GroupSyncWrite, PortHandler, Protocol1PacketHandler
    from serial import SerialException
else:  # so that the class below can be defined
    COMM_SUCCESS, PortHandler, SerialException = 0, object, OSError

Result = TypeVar("Result")

STATUS_LENGTH = 8  # bytes: position, speed, load, voltage, temperature
ANSWER_TIMEOUT = 0.012  # s; a USB adapter may hold back an answer for some milliseconds
MAX_FAILURES = 4  # of a servo in a row
CONNECT_ATTEMPTS, RELEASE_ATTEMPTS = 10, 6  # a servo may need time to start


class BusLost(Exception):
    """The port failed, for example because it was unplugged."""


@dataclass(frozen=True, kw_only=True)
class Status:
    """The status that a servo reports."""

    position: int
    speed: float  # rad/s, positive counter-clockwise
    load: float  # of the stall torque, positive counter-clockwise
    voltage: float  # V
    temperature: float  # degrees Celsius
    errors: StatusError


class ServoBus:
    """An open bus; use it in a `with` block.

    Args:
        port: path of the serial port.
        baud: bits per second.
        clock: the robot's clock.

    Raises InputError if the port cannot be opened.
    """

    def __init__(self, port: str, baud: int, clock: Clock):
        check_installed()
        self._port = _Port(port, clock)
        self._packets = Protocol1PacketHandler()
        try:
            opened = self._port.setBaudRate(baud)
        except (OSError, ValueError, termios.error) as error:
            reason = one_line(error)[:200]
            raise InputError(f"expected the port of the servos, got {port} ({reason}); check cable and name") from error
        if not opened:
            raise InputError(
                f"expected a baud rate that the port supports, got {baud}; servos leave the factory with 1000000"
            )
        self._goals = GroupSyncWrite(self._port, self._packets, Address.GOAL_POSITION, 2)
        self.failures: dict[int, int] = {}  # missing or garbled answers of each servo since its last good one
        self.failed = 0  # answers that were missing or garbled so far
        self.answered = 0

    def __enter__(self) -> "ServoBus":
        return self

    def __exit__(self, *_: object) -> None:
        self._port.closePort()

    def find(self, ids: Iterable[int]) -> dict[int, int]:
        """Return the model numbers of the servos that answer, by id."""
        found = {}
        for servo in ids:
            model, result, _ = self._call(lambda servo=servo: self._packets.ping(self._port, servo))
            if result == COMM_SUCCESS:
                found[servo] = model
        return found

    def configure(self, ids: Sequence[int], *, speed: float, torque: float) -> None:
        """Set the highest speed [rad/s] and torque [of stall] of some servos; their torque stays on or off.

        Raises InputError if a servo does not accept them.
        """
        for servo in ids:
            for address, entry in (
                (Address.MOVING_SPEED, ax_servo.speed_entry(speed)),
                (Address.TORQUE_LIMIT, round(torque * ax_servo.HIGHEST)),
            ):
                self._write_word(servo, address, entry)

    def write_goals(self, positions: dict[int, int]) -> None:
        """Send the set points of some servos in one packet, which turns their torque on."""
        self._goals.clearParam()
        for servo, position in positions.items():
            self._goals.addParam(servo, position.to_bytes(2, "little"))
        self._call(self._goals.txPacket)

    def read_status(self, servo: int) -> Status | None:
        """Return the status of a servo; None if the answer is missing or garbled, which counts as a failure."""
        data, result, error = self._call(
            lambda: self._packets.readTxRx(self._port, servo, Address.PRESENT_POSITION, STATUS_LENGTH)
        )
        if result != COMM_SUCCESS or len(data) != STATUS_LENGTH:
            self.failed += 1
            self.failures[servo] = self.failures.get(servo, 0) + 1
            return None
        self.answered += 1
        self.failures[servo] = 0
        position, speed, load = (int.from_bytes(bytes(data[k : k + 2]), "little") for k in (0, 2, 4))
        return Status(
            position=position,
            speed=ax_servo.from_signed(speed) * ax_servo.SPEED_UNIT,
            load=ax_servo.from_signed(load) / ax_servo.HIGHEST,
            voltage=data[6] * ax_servo.VOLTAGE_UNIT,
            temperature=float(data[7]),
            errors=StatusError(error),
        )

    def has_error(self) -> bool:
        """Return whether answers of a servo were missing or garbled `MAX_FAILURES` times in a row."""
        return max(self.failures.values(), default=0) >= MAX_FAILURES

    def silent_servos(self) -> list[int]:
        """Return the ids of the servos for which `has_error` is true."""
        return sorted(servo for servo, count in self.failures.items() if count >= MAX_FAILURES)

    def release(self, ids: Sequence[int]) -> list[int]:
        """Turn the torque of all servos off; return those of `ids` that did not confirm it."""
        left = list(ids)
        try:
            for _ in range(RELEASE_ATTEMPTS):
                self._write_torque_off(ax_servo.BROADCAST)
                left = [servo for servo in left if not self._is_released(servo)]
                if not left:
                    break
        except BusLost:
            return left
        return left

    def release_one(self, servo: int) -> None:
        """Turn the torque of a servo off."""
        self._write_torque_off(servo)

    def _write_torque_off(self, servo: int) -> None:
        self._call(lambda: self._packets.write1ByteTxOnly(self._port, servo, Address.TORQUE_ENABLE, 0))

    def _is_released(self, servo: int) -> bool:
        torque, result, _ = self._call(lambda: self._packets.read1ByteTxRx(self._port, servo, Address.TORQUE_ENABLE))
        return result == COMM_SUCCESS and torque == 0

    def _write_word(self, servo: int, address: Address, entry: int) -> None:
        refused = StatusError.RANGE | StatusError.CHECKSUM | StatusError.INSTRUCTION
        for _ in range(CONNECT_ATTEMPTS):
            result, error = self._call(lambda: self._packets.write2ByteTxRx(self._port, servo, address, entry))
            if result == COMM_SUCCESS and not error & refused:
                return
        raise InputError(f"expected servo {servo} to accept its limits, got no answer; check its cable")

    def _call(self, send: Callable[[], Result]) -> Result:
        """Call a function of the SDK; raise `BusLost` for the errors of a port that is gone."""
        try:
            return send()
        except (SerialException, OSError, termios.error, TypeError) as error:  # pyserial's port is None once closed
            raise BusLost(one_line(error)) from error
        finally:
            self._port.is_using = False  # the SDK leaves it set after an exception


class _Port(PortHandler):
    """The SDK's port on the robot's clock, which waits for bytes instead of polling."""

    def __init__(self, name: str, clock: Clock):
        super().__init__(name)
        self._clock = clock

    def getCurrentTime(self) -> float:
        return 1000.0 * self._clock.now()

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(1000.0 * ANSWER_TIMEOUT + self.tx_time_per_byte * packet_length)

    def readPort(self, length: int) -> bytes:
        if self.ser is None:
            raise OSError("the port was never opened")
        remaining = self.packet_timeout - self.getTimeSinceStart()
        select.select([self.ser.fileno()], [], [], self._clock.to_wall(remaining / 1000.0))
        return self.ser.read(length)


def check_installed() -> None:
    """Raise `InputError` if dynamixel-sdk or pyserial is missing."""
    if not HAS_SDK:
        raise InputError(
            "expected dynamixel-sdk and pyserial, got an environment without them; pip install 'lgmdjax[drive]'"
        )
