"""Faults of the simulated robot, which its user switches on and off by name.

| name           | what happens                                                                     |
| -------------- | -------------------------------------------------------------------------------- |
| bus-cut        | the data wire is cut: no servo receives or answers, each holds its last goal     |
| unplugged      | the adapter is unplugged: the port is gone                                       |
| frames-stopped | no more pictures are sent; the connection stays open                             |
| corrupt        | one byte in 300 is replaced, in both directions                                  |
| garbled        | one byte in 20 is replaced, in both directions                                   |
| dead-servo     | the servo of a femur has no torque and does not answer                           |
| hot-servo      | the servo of a femur gets warmer by 4 degrees a second                           |
| low-voltage    | the battery gives 9 V                                                            |
| fall           | the robot lies on its back                                                       |
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from lgmdjax.errors import one_line
from lgmdjax.hardware.ax_servo import Address
from lgmdjax.hardware.simulated_body import Body
from lgmdjax.hardware.simulated_servos import ServoBank

SimulatedFault = Literal[
    "bus-cut",
    "unplugged",
    "frames-stopped",
    "corrupt",
    "garbled",
    "dead-servo",
    "hot-servo",
    "low-voltage",
    "fall",
]
FAULTS: tuple[SimulatedFault, ...] = get_args(SimulatedFault)
VICTIM = 4  # index of the joint whose servo dies or gets hot: the left middle femur
COLD, HEATING, WARM = 36.0, 4.0, 60.0  # degrees Celsius, degrees Celsius/s, and degrees Celsius at the start of heating
CHARGED, EMPTY = 111, 90  # 0.1 V
SHARES = {"corrupt": 1 / 300, "garbled": 1 / 20}  # of bytes


@dataclass
class ActiveFaults:
    """The active faults, and since when each is active."""

    active: dict[str, float] = field(default_factory=dict)  # s
    _time: float = 0.0
    _fallen: bool = False
    _random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    @property
    def bus_cut(self) -> bool:
        """Whether all bytes of the bus are lost."""
        return "bus-cut" in self.active

    @property
    def plugged(self) -> bool:
        """Whether the port is there."""
        return "unplugged" not in self.active

    @property
    def frames_stopped(self) -> bool:
        """Whether no pictures are sent."""
        return "frames-stopped" in self.active

    def switch(self, line: str) -> str:
        """Switch on the fault that a line names, or switch all off for "clear"; return a line for the user."""
        word = line.strip()
        if word == "clear":
            self.active.clear()
            return "no fault"
        if word not in FAULTS:
            return f"expected one of {', '.join(FAULTS)} or clear, got {one_line(word)[:40]!r}"
        self.active[word] = self._time
        return f"fault: {word}"

    def act(self, body: Body, bank: ServoBank, time: float) -> None:
        """Apply the active faults to body and servos."""
        self._time = time
        servo = list(bank.servos.values())[VICTIM]
        servo.dead = "dead-servo" in self.active
        if servo.dead:
            servo.write_entry(Address.TORQUE_ENABLE, 0)
        heating = HEATING * (time - self.active["hot-servo"]) + WARM if "hot-servo" in self.active else COLD
        servo.write_entry(Address.PRESENT_TEMPERATURE, round(min(heating, 100.0)))
        voltage = EMPTY if "low-voltage" in self.active else CHARGED
        bank.write_entries(Address.PRESENT_VOLTAGE, np.full(len(bank.servos), voltage))
        if "fall" in self.active and not self._fallen:
            body.push_over()
        self._fallen = "fall" in self.active

    def garble(self, content: bytes) -> bytes:
        """Return bytes of the bus as they arrive, some of them replaced."""
        share = max((SHARES.get(name, 0.0) for name in self.active), default=0.0)
        if not share:
            return content
        found = np.frombuffer(content, np.uint8).copy()
        hit = self._random.random(len(found)) < share
        found[hit] = self._random.integers(0, 256, int(hit.sum()), dtype=np.uint8)
        return found.tobytes()
