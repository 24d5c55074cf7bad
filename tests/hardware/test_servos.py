"""The simulated servos say what the protocol's manual says, and the SDK understands them through a pseudo-terminal."""

import contextlib
import select
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.hardware import ax_servo, joint_map, servo_bus
from lgmdjax.hardware.ax_servo import Address, StatusError
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.servo_bus import BusLost, ServoBus
from lgmdjax.hardware.simulated_robot import Terminal
from lgmdjax.hardware.simulated_servos import ServoBank, checksum


def packet(servo: int, instruction: int, *parameters: int) -> bytes:
    body = bytes([servo, len(parameters) + 2, instruction, *parameters])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def answers(bank: ServoBank, sent: bytes) -> list[str]:
    return [answer.content.hex(" ") for answer in bank.receive(sent)]


# Examples of the e-manual of Protocol 1.0: instruction packets and the status packets that follow them.
@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ("ff ff 01 02 01 fb", ["ff ff 01 02 00 fc"]),  # ping
        ("ff ff 01 04 02 2b 01 cc", ["ff ff 01 03 00 20 db"]),  # temperature, 32 degrees
        ("ff ff 01 05 03 18 01 00 dd", ["ff ff 01 02 00 fc"]),  # write of two bytes
        ("ff ff fe 04 03 03 01 f6", []),  # a broadcast: nobody answers
    ],
)
def test_examples_of_the_manual(sent: str, expected: list[str]) -> None:
    bank = ServoBank((1,))
    bank.servos[1].write_entry(Address.PRESENT_TEMPERATURE, 32)
    assert answers(bank, bytes.fromhex(sent)) == expected


def test_errors_are_bits_of_the_answer() -> None:
    bank = ServoBank((1, 2))
    errors = {
        StatusError.CHECKSUM: packet(1, 1)[:-1] + b"\x00",
        StatusError.INSTRUCTION: packet(1, 0x55),
        StatusError.RANGE: packet(1, 2, 48, 3),
        StatusError.ANGLE: packet(1, 3, Address.GOAL_POSITION, 0x20, 0x03),
    }
    bank.servos[1].write_entry(Address.HIGHEST_POSITION, 700)
    for fault, sent in errors.items():
        (answer,) = bank.receive(sent)
        assert answer.content[4] == fault, fault
    assert bank.servos[1].entry(Address.GOAL_POSITION) == 700
    assert answers(bank, packet(1, 3, Address.MOVING_SPEED, 0, 8)) == ["ff ff 01 02 08 f4"]  # 2048: out of range
    assert bank.servos[1].entry(Address.MOVING_SPEED) == 0
    bank.servos[1].write_entry(Address.PRESENT_TEMPERATURE, 71)
    assert bank.receive(packet(1, 1))[0].content[4] == StatusError.OVERHEATING
    bank.shut_down()
    assert [servo.entry(Address.TORQUE_LIMIT) for servo in bank.servos.values()] == [0, 1023]


def test_registered_writes_wait_for_the_action_and_sync_writes_do_not() -> None:
    bank = ServoBank((1, 2))
    bank.receive(packet(1, 4, Address.GOAL_POSITION, 0, 2))
    assert (bank.servos[1].entry(Address.GOAL_POSITION), bank.servos[1].entry(Address.REGISTERED)) == (0, 1)
    bank.receive(packet(254, 5))
    assert bank.servos[1].entry(Address.GOAL_POSITION) == 512
    assert bank.receive(packet(254, 0x83, Address.GOAL_POSITION, 2, 1, 10, 0, 2, 20, 1)) == []
    assert [servo.entry(Address.GOAL_POSITION) for servo in bank.servos.values()] == [10, 276]
    assert all(servo.entry(Address.TORQUE_ENABLE) for servo in bank.servos.values())


def test_the_parser_finds_the_next_packet_after_damage_whatever_the_pieces() -> None:
    stream = b"\x00\xff" + packet(1, 1) + b"\xff\xff\xff\x01" + packet(2, 1) + packet(1, 1)[:3]
    for size in (1, 2, 3, 7, 100):
        bank = ServoBank((1, 2))
        heard = [a.content[2] for k in range(0, len(stream), size) for a in bank.receive(stream[k : k + size])]
        assert heard[0] == 1 and heard[-1] == 2
    assert checksum(b"\x01\x02\x01") == 0xFB


@pytest.fixture
def terminal() -> Iterator[tuple[Terminal, ServoBank, list[bytes]]]:
    """Eighteen servos on a pseudo-terminal, answered by a thread; the list may hold what they answer instead."""
    plug, bank, spoil = Terminal(), ServoBank(tuple(range(1, 19))), list[bytes]()
    ended = threading.Event()

    def serve() -> None:
        with contextlib.suppress(OSError, ValueError):  # the test may close the plug
            while not ended.is_set():
                if select.select([plug.file], [], [], 0.02)[0]:
                    for answer in bank.receive(plug.read()):
                        plug.write(spoil[0] if spoil else answer.content)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield plug, bank, spoil
    ended.set()
    thread.join()
    plug.close()


def test_the_sdk_and_the_simulated_servos_understand_each_other(terminal) -> None:
    plug, bank, spoil = terminal
    servos = joint_map.default()
    clock = Clock(0.05)  # for a busy computer
    with ServoBus(plug.name, servos.baud, clock) as bus:
        assert bus.find([1, 7, 18, 30]) == {1: 12, 7: 12, 18: 12}
        bus.configure([7], speed=5.0, torque=0.8)
        assert bank.servos[7].entry(Address.MOVING_SPEED) == round(5.0 / 0.111 * 60 / (2 * np.pi))
        assert bank.servos[7].entry(Address.TORQUE_LIMIT) == round(0.8 * 1023)
        bus.write_goals({1: 100, 18: 900})
        assert bus.read_status(1) is not None
        assert (bank.servos[1].entry(Address.GOAL_POSITION), bank.servos[18].entry(Address.GOAL_POSITION)) == (100, 900)
        bank.servos[3].table[Address.PRESENT_POSITION : 44] = [0x2A, 2, 10, 4, 200, 0, 111, 45]
        status = bus.read_status(3)
        assert status is not None
        assert (status.position, round(status.voltage, 3), status.temperature) == (554, 11.1, 45.0)
        assert status.speed == pytest.approx(-10 * ax_servo.SPEED_UNIT) and status.load == pytest.approx(200 / 1023)
        bank.servos[5].dead = True
        for _ in range(servo_bus.MAX_FAILURES):
            assert not bus.has_error()
            assert bus.read_status(5) is None
        assert bus.has_error() and bus.silent_servos() == [5]
        spoil.append(b"\xff\xff\x06\x0a\x00garbled")
        assert bus.read_status(6) is None
        spoil.clear()
        assert bus.read_status(6) is not None and bus.failures[6] == 0
        assert bus.release(servos.ids) == [5]
        assert not any(servo.entry(Address.TORQUE_ENABLE) for servo in bank.servos.values())
        plug.close()
        with pytest.raises(BusLost):
            for _ in range(20):
                bus.write_goals({1: 100})
                bus.read_status(1)
        assert bus.release([1]) == [1]


def test_a_port_that_does_not_open_is_one_line(tmp_path) -> None:
    with pytest.raises(InputError, match="check cable and name"):
        ServoBus(str(tmp_path / "none"), 1_000_000, Clock())


def test_joint_maps_are_read_as_they_were_written(tmp_path) -> None:
    servos = joint_map.default()
    joint_map.write(tmp_path / "servos.toml", servos)
    found = joint_map.read(tmp_path / "servos.toml")
    assert joint_map.to_toml(found) == joint_map.to_toml(servos)
    angles = np.random.default_rng(0).uniform(-1, 1, (6, 3))
    back = joint_map.to_angles(found, np.array(joint_map.to_positions(found, angles)))
    assert np.abs(back - angles).max() <= 0.5001 * np.deg2rad(300 / 1023)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("baud = 1000000", "baud = ", "joint map in TOML"),
        ("id = 2\n", "id = 1\n", "an id that left_front_coxa does not have"),
        ("direction = 1\n", "direction = 0\n", "1 or -1"),
        ("[joints.left_front_tibia]", "[joints.left_tibia]", "left_front_tibia"),
        ("highest = 75.0", "highest = 80.0", "in -75 to 75 deg"),
        ("lowest = -100.0", "lowest = 40.0", "around the stance"),
        ("temperature = 70.0", "temperature = 90.0", "30 to 70"),
        ("zero = 512", "zero = true", "integer"),
    ],
)
def test_a_wrong_map_is_one_line(tmp_path, before: str, after: str, words: str) -> None:
    text = joint_map.to_toml(joint_map.default())
    assert before in text
    path = tmp_path / "servos.toml"
    path.write_text(text.replace(before, after, 1))
    with pytest.raises(InputError) as error:
        joint_map.read(path)
    assert words in str(error.value) and "\n" not in str(error.value) and "servos map" in str(error.value)


def test_a_missing_map_is_one_line(tmp_path) -> None:
    with pytest.raises(InputError, match="found no file"):
        joint_map.read(tmp_path / "none.toml")
