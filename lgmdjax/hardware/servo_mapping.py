"""Find out which servo moves which joint: one servo at a time moves a little, and a person says which joint moved.

A servo moves by `NUDGE` and back, slowly and with little torque, and its torque is then turned off, so that it does no
harm whichever joint it moves. The person also says in which direction the joint moved. The zeros are read while the
person holds the legs in the zero posture.
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.hardware import ax_servo, joint_map
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.joint_map import JOINT_NAMES, JointMap
from lgmdjax.hardware.servo_bus import ServoBus

NUDGE = 24  # positions, 7 degrees
NUDGE_SPEED, NUDGE_TORQUE = 0.5, 0.3  # rad/s, fraction of the stall torque
PAUSE = 0.7  # s for a nudge
READS = 5
MEANINGS = {"coxa": "to the left", "femur": "up", "tibia": "outward and up"}
ZERO = "hold every leg straight out along its mount, femur level, tibia vertical"

Ask = Callable[[str], str]
"""Shows a question and returns the answer."""


@dataclass(frozen=True, kw_only=True)
class Mapper:
    """An open bus, and a person who answers questions."""

    bus: ServoBus
    clock: Clock
    ask: Ask
    wait: Callable[[float], None]  # sleeps for some seconds of wall-clock time

    def map(self, ids: Sequence[int], baud: int) -> JointMap:
        """Return the map of eighteen servos; raise `InputError` for any other number."""
        if len(ids) != len(JOINT_NAMES):
            listed = ", ".join(map(str, ids)) or "none"
            raise InputError(
                f"expected {len(JOINT_NAMES)} servos on the bus, got {len(ids)} ({listed}); check power, cables "
                "and --baud, and that no two servos have one id"
            )
        self.bus.release(ids)
        found: dict[int, tuple[int, int]] = {}  # servo and direction by joint
        for servo in ids:
            joint, direction = self._identify(servo, [joint for joint in range(18) if joint not in found])
            found[joint] = servo, direction
        self.ask(f"{ZERO}, and press Enter")
        zeros = [self._position(found[joint][0]) for joint in range(18)]
        lowest, highest = hexapod.target_limits().reshape(2, 18)
        return JointMap(
            ids=tuple(found[joint][0] for joint in range(18)),
            directions=np.array([found[joint][1] for joint in range(18)]),
            zeros=np.array(zeros),
            lowest=lowest,
            highest=highest,
            baud=baud,
        )

    def _identify(self, servo: int, left: Sequence[int]) -> tuple[int, int]:
        """Move a servo until the person recognises its joint; return the joint, and 1 or -1 for its direction."""
        choices = "\n".join(f"  {joint + 1:2} {JOINT_NAMES[joint]}" for joint in left)
        while True:
            sign = self._nudge(servo)
            answer = self.ask(
                f"{choices}\nservo {servo} moved and came back; which joint is it? (Enter: move again)"
            ).strip()
            if not answer.isdecimal() or int(answer) - 1 not in left:
                continue
            joint = int(answer) - 1
            meaning = MEANINGS[JOINT_NAMES[joint].rpartition("_")[2]]
            seen = self.ask(f"did {JOINT_NAMES[joint]} first move {meaning}? (y, n; Enter: move again)").strip().lower()
            if seen in ("y", "n"):
                return joint, sign if seen == "y" else -sign

    def _nudge(self, servo: int) -> int:
        """Move a servo by `NUDGE` and back; return 1 if it moved to higher positions, -1 if to lower ones."""
        start = self._position(servo)
        self.bus.write_goals({servo: start})
        self.bus.configure([servo], speed=NUDGE_SPEED, torque=NUDGE_TORQUE)
        sign = 1 if start + NUDGE <= ax_servo.HIGHEST else -1
        for goal in (start + sign * NUDGE, start):
            self.bus.write_goals({servo: goal})
            self.wait(self.clock.to_wall(PAUSE))
        self.bus.release_one(servo)
        return sign

    def _position(self, servo: int) -> int:
        """Return the median of some readings; raise `InputError` for a servo that does not answer."""
        readings = [status.position for _ in range(READS) if (status := self.bus.read_status(servo)) is not None]
        if not readings:
            raise InputError(f"expected servo {servo} to report its position, got no answer; check its cable")
        return round(statistics.median(readings))


def describe(servos: JointMap) -> str:
    """Return a line for each joint."""
    rows = zip(joint_map.JOINT_NAMES, servos.ids, servos.directions, servos.zeros, strict=True)
    return "\n".join(
        f"{name:20} servo {number:3}, direction {turn:+d}, zero {zero}" for name, number, turn, zero in rows
    )
