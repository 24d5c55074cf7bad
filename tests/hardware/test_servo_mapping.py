"""`lgmdjax servos map`: a person who sees which joint moves, and how, ends with the true map."""

import os
import select
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lgmdjax.cli import main
from lgmdjax.errors import InputError
from lgmdjax.hardware import ax_servo, joint_map
from lgmdjax.hardware.ax_servo import Address
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.joint_map import JOINT_NAMES, JointMap
from lgmdjax.hardware.servo_bus import ServoBus
from lgmdjax.hardware.servo_mapping import Mapper
from lgmdjax.hardware.simulated_servos import ServoBank

TRUE = replace(
    joint_map.default(),
    ids=tuple(np.random.default_rng(0).permutation(np.arange(1, 19)).tolist()),
    directions=np.random.default_rng(1).choice([-1, 1], 18),
    zeros=ax_servo.CENTRE + np.random.default_rng(2).integers(-20, 21, 18),
)


class Bench:
    """Servos on a pseudo-terminal, which go at once where they are told to."""

    def __init__(self, ids: tuple[int, ...]):
        self.bank, (self._file, self._slave) = ServoBank(ids), os.openpty()
        tty.setraw(self._slave)
        self.port, self._ended = os.ttyname(self._slave), threading.Event()
        self.moves: list[tuple[int, int]] = []  # servo, and by how many positions
        self._busy = time.monotonic()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._ended.is_set():
            if not select.select([self._file], [], [], 0.02)[0]:
                continue
            self._busy = time.monotonic()
            for answer in self.bank.receive(os.read(self._file, 4096)):
                os.write(self._file, answer.content)
            for number, servo in self.bank.servos.items():
                goal, before = servo.entry(Address.GOAL_POSITION), servo.entry(Address.PRESENT_POSITION)
                if servo.entry(Address.TORQUE_ENABLE) and goal != before:
                    self.moves.append((number, goal - before))
                    servo.write_entry(Address.PRESENT_POSITION, goal)

    def settle(self, _: float) -> None:
        """Wait until nothing came for a while."""
        pause = threading.Event()  # `time.sleep` may be replaced by this
        pause.wait(0.05)
        while time.monotonic() - self._busy < 0.05:
            pause.wait(0.01)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        os.close(self._file)
        os.close(self._slave)


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench(TRUE.ids)
    yield made
    made.close()


def person(bench: Bench, questions: list[str]):
    """Answer as a person does who watches the robot; the first question of all is not understood at first."""

    def ask(question: str) -> str:
        questions.append(question)
        bench.settle(0.0)
        if "press Enter" in question:
            for joint, servo in enumerate(TRUE.ids):
                bench.bank.servos[servo].write_entry(Address.PRESENT_POSITION, int(TRUE.zeros[joint]))
            return ""
        servo, change = bench.moves[-2]  # away, and then back
        joint = TRUE.ids.index(servo)
        if "which joint" in question:
            return "what?" if len(questions) == 1 else str(joint + 1)
        return "y" if change * TRUE.directions[joint] > 0 else "n"

    return ask


def assert_is_true(found: JointMap) -> None:
    assert found.ids == TRUE.ids
    np.testing.assert_array_equal(found.directions, TRUE.directions)
    np.testing.assert_array_equal(found.zeros, TRUE.zeros)


def test_a_person_who_watches_ends_with_the_true_map(bench: Bench) -> None:
    questions: list[str] = []
    clock = Clock(0.05)
    with ServoBus(bench.port, ax_servo.BAUD_RATE, clock) as bus:
        mapper = Mapper(bus=bus, clock=clock, ask=person(bench, questions), wait=bench.settle)
        found = mapper.map(sorted(bus.find(range(1, 19))), ax_servo.BAUD_RATE)
    assert_is_true(found)
    assert len(questions) == 2 * 18 + 2
    assert all(name in questions[0] for name in JOINT_NAMES)
    assert not any(servo.entry(Address.TORQUE_ENABLE) for servo in bench.bank.servos.values())
    assert max(abs(change) for _, change in bench.moves) <= 24


def test_the_command_writes_a_file_that_can_be_read(bench: Bench, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("builtins.input", person(bench, []))
    monkeypatch.setattr("time.sleep", bench.settle)
    out = tmp_path / "servos.toml"
    flags = ["--servos", bench.port, "--out", str(out), "--highest-id", "18", "--speed", "0.2"]
    assert main.main(["servos", "map", *flags]) == 0
    assert_is_true(joint_map.read(out))
    assert main.main(["servos", "map", *flags]) == 2
    assert "which exists" in capsys.readouterr().err


def test_too_few_servos_and_an_end_of_the_answers_are_one_line(tmp_path: Path, monkeypatch, capsys) -> None:
    small = Bench((1, 2))
    try:
        with ServoBus(small.port, ax_servo.BAUD_RATE, Clock()) as bus:
            mapper = Mapper(bus=bus, clock=Clock(), ask=lambda _: "", wait=lambda _: None)
            with pytest.raises(InputError, match=r"18 servos on the bus, got 2 \(1, 2\)"):
                mapper.map([1, 2], ax_servo.BAUD_RATE)
    finally:
        small.close()
    assert main.main(["servos", "map", "--servos", str(tmp_path / "none")]) == 2
    assert "check cable and name" in capsys.readouterr().err
