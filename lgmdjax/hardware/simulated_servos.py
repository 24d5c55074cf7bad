"""Simulated AX-12A servos: bytes of the bus in, bytes of their answers out, according to Protocol 1.0.

An instruction packet is 0xFF 0xFF, id, length, instruction, parameters, checksum; a status packet has an error byte in
place of the instruction. The length counts what follows it; the checksum is the inverse of the sum of all bytes between
the header and itself. A servo answers when its return delay has passed, and never to a broadcast. It sets an error bit
for a wrong checksum, an unknown instruction, an entry out of range, a goal beyond its limits, and for temperature,
voltage and load. It turns its torque off after the errors that its table lists at `SHUTDOWN`.

Source: the maker's e-manual of Protocol 1.0 and of the AX-12A. Nothing here comes from the SDK that drives the servos.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8

from lgmdjax.hardware import ax_servo
from lgmdjax.hardware.ax_servo import Address, Instruction, StatusError

HEADER = b"\xff\xff"
SHORTEST = 6  # bytes of a packet
MAX_LENGTH = 250  # of the length byte
WORDS = frozenset(
    {  # entries of two bytes
        *(Address.MODEL, Address.LOWEST_POSITION, Address.HIGHEST_POSITION, Address.MAX_TORQUE, Address.GOAL_POSITION),
        *(Address.MOVING_SPEED, Address.TORQUE_LIMIT, Address.PRESENT_POSITION, Address.PRESENT_SPEED),
        *(Address.PRESENT_LOAD, Address.PUNCH),
    }
)
FACTORY = {  # nonzero values in the table of a new AX-12A
    **{Address.MODEL: 12, Address.FIRMWARE: 24, Address.ID: 1, Address.BAUD: 1, Address.RETURN_DELAY: 250},
    **{Address.HIGHEST_POSITION: 1023, Address.HIGHEST_TEMPERATURE: 70, Address.LOWEST_VOLTAGE: 60},
    **{Address.HIGHEST_VOLTAGE: 140, Address.MAX_TORQUE: 1023, Address.STATUS_RETURN_LEVEL: 2},
    **{Address.ALARM_LED: 36, Address.SHUTDOWN: 36, 26: 1, 27: 1, 28: 32, 29: 32, Address.TORQUE_LIMIT: 1023},
    **{Address.PRESENT_POSITION: 512, Address.PRESENT_VOLTAGE: 111, Address.PRESENT_TEMPERATURE: 36, Address.PUNCH: 32},
}
LARGEST: Mapping[int, int] = {  # largest values of entries whose range is limited
    **dict.fromkeys((Address.LOWEST_POSITION, Address.HIGHEST_POSITION, Address.GOAL_POSITION), 1023),
    **dict.fromkeys((Address.MOVING_SPEED, Address.TORQUE_LIMIT, Address.MAX_TORQUE, Address.PUNCH), 1023),
    **dict.fromkeys((Address.TORQUE_ENABLE, Address.LED, Address.LOCK), 1),
    **{Address.ID: 253, Address.RETURN_DELAY: 254, Address.STATUS_RETURN_LEVEL: 2, Address.ALARM_LED: 127},
    **{Address.SHUTDOWN: 127, Address.HIGHEST_TEMPERATURE: 150},
}
WRITABLE = range(Address.ID, Address.PRESENT_POSITION)
LATER_WRITABLE = range(Address.LOCK, ax_servo.TABLE_SIZE)


@dataclass(frozen=True)
class Packet:
    """An instruction packet; `intact` is whether its checksum is right."""

    servo: int
    instruction: int
    parameters: bytes
    intact: bool = True


@dataclass(frozen=True)
class Answer:
    """A status packet, and how long after the instruction it is sent [s]."""

    delay: float
    content: bytes


def checksum(body: bytes) -> int:
    """Return the checksum of the bytes between header and checksum.

    >>> hex(checksum(bytes([1, 2, 1])))  # the ping of servo 1 in the manual
    '0xfb'
    """
    return ~sum(body) & 0xFF


class Parser:
    """Cuts a stream of bytes into packets, and finds the next header after damage."""

    def __init__(self) -> None:
        self._bytes = b""

    def feed(self, received: bytes) -> Iterator[Packet]:
        """Yield the complete packets."""
        self._bytes += received
        while True:
            start = self._bytes.find(HEADER)
            if start < 0:
                self._bytes = self._bytes[-1:]
                return
            self._bytes = self._bytes[start:]
            if len(self._bytes) < SHORTEST:
                return
            servo, length = self._bytes[2:4]
            if servo > ax_servo.BROADCAST or not 2 <= length <= MAX_LENGTH:
                self._bytes = self._bytes[1:]
                continue
            if len(self._bytes) < length + 4:
                return
            body, self._bytes = self._bytes[2 : length + 4], self._bytes[length + 4 :]
            yield Packet(servo, body[2], body[3:-1], checksum(body[:-1]) == body[-1])


class Servo:
    """One servo: its control table, what is registered for an ACTION, and whether it is dead.

    Args:
        number: the id.
        table: bytes of the control table, which the servo fills and changes.
    """

    def __init__(self, number: int, table: UInt8[np.ndarray, "50"]):
        self.number, self.table = number, table
        self.registered, self.dead = b"", False
        self.reset()

    def reset(self) -> None:
        """Restore the factory's table, except for the id."""
        self.table[:] = 0
        for address, value in FACTORY.items():
            self.write_entry(address, value)
        self.table[Address.ID] = self.number

    def entry(self, address: int) -> int:
        """Return an entry of the table."""
        return int(self.table[address]) + (256 * int(self.table[address + 1]) if address in WORDS else 0)

    def write_entry(self, address: int, value: int) -> None:
        """Write an entry of the table without any check."""
        self.table[address] = value & 0xFF
        if address in WORDS:
            self.table[address + 1] = value >> 8

    def alarms(self) -> StatusError:
        """Return the errors of voltage and temperature, which last as long as their causes."""
        voltage, found = self.entry(Address.PRESENT_VOLTAGE), StatusError(0)
        if not self.entry(Address.LOWEST_VOLTAGE) <= voltage <= self.entry(Address.HIGHEST_VOLTAGE):
            found |= StatusError.VOLTAGE
        if self.entry(Address.PRESENT_TEMPERATURE) > self.entry(Address.HIGHEST_TEMPERATURE):
            found |= StatusError.OVERHEATING
        return found

    def execute(self, packet: Packet) -> Answer | None:
        """Execute a packet; return the answer, or None if there is none."""
        if self.dead:
            return None
        if not packet.intact:
            return self._answer(packet, StatusError.CHECKSUM)
        content, error = b"", StatusError(0)
        match packet.instruction:
            case Instruction.PING:
                return self._answer(packet, error, always=True)
            case Instruction.READ if len(packet.parameters) == 2:
                content, error = self._read(*packet.parameters)
            case Instruction.WRITE if len(packet.parameters) >= 2:
                error = self._write(packet.parameters)
            case Instruction.REG_WRITE if len(packet.parameters) >= 2:
                self.registered = packet.parameters
                self.write_entry(Address.REGISTERED, 1)
            case Instruction.ACTION if self.registered:
                error, self.registered = self._write(self.registered), b""
                self.write_entry(Address.REGISTERED, 0)
            case Instruction.RESET:
                self.reset()
            case _:
                error = StatusError.INSTRUCTION
        return self._answer(packet, error, content)

    def _read(self, address: int, size: int) -> tuple[bytes, StatusError]:
        if address + size > ax_servo.TABLE_SIZE:
            return b"", StatusError.RANGE
        return self.table[address : address + size].tobytes(), StatusError(0)

    def _write(self, parameters: bytes) -> StatusError:
        """Write bytes, starting at an address, all or none; return the error."""
        address, content = parameters[0], parameters[1:]
        span = range(address, address + len(content))
        if not all(byte in WRITABLE or byte in LATER_WRITABLE for byte in span):
            return StatusError.RANGE
        before = self.table.copy()
        self.table[span.start : span.stop] = np.frombuffer(content, np.uint8)
        if any(self.entry(entry) > LARGEST[entry] for entry in span if entry in LARGEST):
            self.table[:] = before
            return StatusError.RANGE
        if Address.GOAL_POSITION not in span:
            return StatusError(0)
        lowest, highest = self.entry(Address.LOWEST_POSITION), self.entry(Address.HIGHEST_POSITION)
        goal = self.entry(Address.GOAL_POSITION)
        self.write_entry(Address.GOAL_POSITION, min(max(goal, lowest), highest))
        self.write_entry(Address.TORQUE_ENABLE, 1)
        return StatusError(0) if lowest <= goal <= highest else StatusError.ANGLE

    def _answer(
        self, packet: Packet, error: StatusError, content: bytes = b"", *, always: bool = False
    ) -> Answer | None:
        """Return a status packet if the table asks for one: level 0 for pings, 1 for reads too, 2 for all."""
        needed = 0 if always else 1 if packet.instruction == Instruction.READ else 2
        if packet.servo == ax_servo.BROADCAST or self.entry(Address.STATUS_RETURN_LEVEL) < needed:
            return None
        body = bytes([self.number, len(content) + 2, error | self.alarms()]) + content
        delay = self.entry(Address.RETURN_DELAY) * ax_servo.DELAY_UNIT
        return Answer(delay, HEADER + body + bytes([checksum(body)]))


class ServoBank:
    """Servos on one bus, whose tables are the rows of one array, in the order of `ids`."""

    def __init__(self, ids: tuple[int, ...]):
        self._tables = np.zeros((len(ids), ax_servo.TABLE_SIZE), np.uint8)
        self.servos = {number: Servo(number, table) for number, table in zip(ids, self._tables, strict=True)}
        self._parser = Parser()

    def entries(self, address: Address) -> Int[np.ndarray, "servos"]:
        """Return one entry of every table."""
        low = self._tables[:, address].astype(int)
        return low + 256 * self._tables[:, address + 1].astype(int) if address in WORDS else low

    def write_entries(self, address: Address, values: Int[np.ndarray, "servos"]) -> None:
        """Write one entry of every table without any check."""
        self._tables[:, address] = values & 0xFF
        if address in WORDS:
            self._tables[:, address + 1] = values >> 8

    def shut_down(self) -> None:
        """Turn off the torque of servos with an alarm that their tables list at `SHUTDOWN`."""
        for servo in self.servos.values():
            if servo.alarms() & servo.entry(Address.SHUTDOWN):
                servo.write_entry(Address.TORQUE_ENABLE, 0)
                servo.write_entry(Address.TORQUE_LIMIT, 0)

    def receive(self, received: bytes) -> list[Answer]:
        """Pass bytes of the bus to the servos; return their answers."""
        answers = []
        for packet in self._parser.feed(received):
            if packet.instruction == Instruction.SYNC_WRITE and packet.intact:
                self._write_in_sync(packet.parameters)
                continue
            everyone = packet.servo == ax_servo.BROADCAST
            addressed = self.servos.values() if everyone else filter(None, [self.servos.get(packet.servo)])
            answers += filter(None, [servo.execute(packet) for servo in addressed])
        return answers

    def _write_in_sync(self, parameters: bytes) -> None:
        """Write to several servos: address, size, and for each servo its id and that many bytes."""
        if len(parameters) < 2 or (len(parameters) - 2) % (parameters[1] + 1):
            return
        address, size = parameters[:2]
        for first in range(2, len(parameters), size + 1):
            servo, content = parameters[first], parameters[first + 1 : first + 1 + size]
            if servo in self.servos:
                write = Packet(ax_servo.BROADCAST, Instruction.WRITE, bytes([address]) + content)
                self.servos[servo].execute(write)
