"""The servos AX-12A and AX-18A: addresses of the control table, units, instructions and error bits.

| quantity    | unit in the table                | range                                         |
| ----------- | -------------------------------- | --------------------------------------------- |
| position    | 300 degrees / 1023               | 0 (150 degrees clockwise) to 1023             |
| speed       | 0.111 rpm                        | 0 (as fast as the voltage allows) to 1023     |
| torque      | 1/1023 of the stall torque       | 0 to 1023                                     |
| load        | as torque; bit 10: clockwise     | 0 to 2047                                     |
| voltage     | 0.1 V                            |                                               |
| temperature | 1 degree Celsius                 |                                               |

Seen from the horn, higher positions are counter-clockwise. Entries at addresses below `RAM` are kept without power;
each can be written only some thousand times. Writing a goal position turns the torque on.

Source: the maker's e-manual of the AX-12A and AX-18A, and of the DYNAMIXEL Protocol 1.0.
"""

import math
from enum import IntEnum, IntFlag

import numpy as np
from jaxtyping import Float, Int


class Address(IntEnum):
    """Address of the (lower) byte in the control table."""

    MODEL = 0
    FIRMWARE = 2
    ID = 3
    BAUD = 4
    RETURN_DELAY = 5
    LOWEST_POSITION = 6
    HIGHEST_POSITION = 8
    HIGHEST_TEMPERATURE = 11
    LOWEST_VOLTAGE = 12
    HIGHEST_VOLTAGE = 13
    MAX_TORQUE = 14
    STATUS_RETURN_LEVEL = 16
    ALARM_LED = 17
    SHUTDOWN = 18
    TORQUE_ENABLE = 24
    LED = 25
    GOAL_POSITION = 30
    MOVING_SPEED = 32
    TORQUE_LIMIT = 34
    PRESENT_POSITION = 36
    PRESENT_SPEED = 38
    PRESENT_LOAD = 40
    PRESENT_VOLTAGE = 42
    PRESENT_TEMPERATURE = 43
    REGISTERED = 44
    MOVING = 46
    LOCK = 47
    PUNCH = 48


class Instruction(IntEnum):
    """Instruction of a packet of Protocol 1.0."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    SYNC_WRITE = 0x83


class StatusError(IntFlag):
    """Error bits of a status packet."""

    VOLTAGE = 1
    ANGLE = 2
    OVERHEATING = 4
    RANGE = 8
    CHECKSUM = 16
    OVERLOAD = 32
    INSTRUCTION = 64


RAM = 24  # first address that is lost without power
TABLE_SIZE = 50  # bytes
BROADCAST = 254  # the id that means all servos
HIGHEST_ID = 252
BAUD_RATE = 1_000_000  # bit/s, the factory setting
BITS_PER_BYTE = 10  # on the wire: start, eight bits, stop
DELAY_UNIT = 2e-6  # s, of the return delay
MODELS = {12: "AX-12A", 18: "AX-18A"}
HIGHEST, CENTRE = 1023, 512  # positions
POSITION_UNIT = math.radians(300) / HIGHEST  # rad
SPEED_UNIT = 0.111 * 2 * math.pi / 60  # rad/s
VOLTAGE_UNIT = 0.1  # V
LOAD_CLOCKWISE = 1024  # bit of the load and of the present speed


def from_signed(value: int) -> int:
    """Return a present speed or load as a signed number, positive counter-clockwise.

    >>> from_signed(5), from_signed(LOAD_CLOCKWISE + 5)
    (5, -5)
    """
    return -(value - LOAD_CLOCKWISE) if value >= LOAD_CLOCKWISE else value


def to_signed(value: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """Return the table entries of signed speeds or loads (positive counter-clockwise), at most 1023 in size.

    >>> to_signed(np.array([5.0, -5.0])).tolist()
    [5, 1029]
    """
    size = np.minimum(np.rint(np.abs(value)), HIGHEST).astype(int)
    return np.where(value < 0, size + LOAD_CLOCKWISE, size)


def speed_entry(speed: float) -> int:
    """Return the table entry of a speed limit [rad/s], at least 1, because 0 means no limit.

    >>> speed_entry(0.0), speed_entry(6.18)
    (1, 532)
    """
    return min(max(round(speed / SPEED_UNIT), 1), HIGHEST)
