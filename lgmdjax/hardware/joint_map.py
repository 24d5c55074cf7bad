"""The joint map, a TOML file: which servo moves which joint, and the limits of angle, speed, torque and others.

```toml
baud = 1000000        # bit/s

[limits]
speed = 5.0           # rad/s
torque = 0.8          # of the stall torque
voltage = 9.6         # V, below which the robot sits down
temperature = 70.0    # degrees Celsius, at which it sits down

[joints.left_front_coxa]
id = 1
direction = 1         # -1 if higher positions turn right, or lower the leg
zero = 512            # position at which the joint's angle is zero
lowest = -75.0        # deg
highest = 75.0        # deg
```

and so on for all eighteen joints, named <leg>_<joint> as in `hexapod.LEGS` and `hexapod.JOINTS`. At zero a leg
points straight out along its mount, with the femur level and the tibia vertical. A positive coxa angle turns to the
left; positive femur and tibia angles lift. The limits of an angle may be narrower than those of the robot's model, but
not wider.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError, one_line
from lgmdjax.hardware import ax_servo, postures
from lgmdjax.runtime import partial_files, schema

JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in hexapod.LEGS for joint in hexapod.JOINTS)
MAX_SPEED = 12.0  # rad/s, above what the servos reach
LIMITS = schema.Object(
    {
        "speed": schema.Number(0.1, MAX_SPEED),
        "torque": schema.Number(0.05, 1.0),
        "voltage": schema.Number(6.0, 12.6),
        "temperature": schema.Number(30.0, 70.0),
    }
)
JOINT = schema.Object(
    {
        "id": schema.Integer(0, ax_servo.HIGHEST_ID),
        "direction": schema.Integer(-1, 1),
        "zero": schema.Integer(0, ax_servo.HIGHEST),
        "lowest": schema.Number(-150.0, 150.0),
        "highest": schema.Number(-150.0, 150.0),
    }
)
FILE = schema.Object(
    {
        "baud": schema.Integer(9600, 4_000_000),
        "limits": LIMITS,
        "joints": schema.Object({name: JOINT for name in JOINT_NAMES}),
    }
)
REMEDY = "correct it, or make it with `lgmdjax servos map`"


@dataclass(frozen=True, kw_only=True)
class JointMap:
    """Servos and limits of the joints, in the order of `JOINT_NAMES`."""

    ids: tuple[int, ...]
    directions: Int[np.ndarray, "18"]  # 1 or -1
    zeros: Int[np.ndarray, "18"]  # positions
    lowest: Float[np.ndarray, "18"]  # rad
    highest: Float[np.ndarray, "18"]  # rad
    speed: float = 5.0  # rad/s
    torque: float = 0.8  # of the stall torque
    voltage: float = 9.6  # V
    temperature: float = 70.0  # degrees Celsius
    baud: int = ax_servo.BAUD_RATE  # bit/s

    def limits(self) -> postures.Limits:
        """Return the limits of set points."""
        lowest, highest = (values.reshape(6, 3) for values in (self.lowest, self.highest))
        return postures.Limits(lowest=lowest, highest=highest, speed=self.speed)


def default() -> JointMap:
    """Return the map of a robot whose servo ids 1 to 18 follow the order of its joints, all mounted the same way."""
    lowest, highest = hexapod.target_limits().reshape(2, 18)
    return JointMap(
        ids=tuple(range(1, 19)),
        directions=np.ones(18, int),
        zeros=np.full(18, ax_servo.CENTRE),
        lowest=lowest,
        highest=highest,
    )


def to_positions(servos: JointMap, angles: Float[np.ndarray, "6 3"]) -> list[int]:
    """Return the servos' positions for joint angles [rad], limited to the servos' range.

    >>> to_positions(default(), np.full((6, 3), 0.1))[0]
    532
    """
    wanted = servos.zeros + servos.directions * angles.reshape(18) / ax_servo.POSITION_UNIT
    return np.clip(np.rint(wanted), 0, ax_servo.HIGHEST).astype(int).tolist()


def to_angle(servos: JointMap, joint: int, position: int) -> float:
    """Return the angle of a joint [rad] for the position of its servo."""
    return float(servos.directions[joint] * (position - servos.zeros[joint]) * ax_servo.POSITION_UNIT)


def to_angles(servos: JointMap, positions: Int[np.ndarray, "18"]) -> Float[np.ndarray, "6 3"]:
    """Return the joint angles [rad] for the positions of their servos."""
    return (servos.directions * (positions - servos.zeros) * ax_servo.POSITION_UNIT).reshape(6, 3)


def read(path: Path) -> JointMap:
    """Return the map in a file; raise `InputError` if it is missing or wrong, or if two joints have one servo."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"expected a joint map, found no file at {path}; {REMEDY.partition(', or ')[2]}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"expected a joint map in TOML, got {path}: {one_line(error)}; {REMEDY}") from error
    schema.check(FILE, content, str(path), REMEDY)
    joints = [content["joints"][name] for name in JOINT_NAMES]
    if unknown := sorted(content["joints"].keys() - set(JOINT_NAMES)):
        raise InputError(f"{path}: expected joints named <leg>_<joint>, got {one_line(unknown[0])}; {REMEDY}")
    limits = {name: float(content["limits"][name]) for name in LIMITS.fields}
    servos = JointMap(
        ids=tuple(joint["id"] for joint in joints),
        directions=np.array([joint["direction"] for joint in joints]),
        zeros=np.array([joint["zero"] for joint in joints]),
        lowest=np.deg2rad([float(joint["lowest"]) for joint in joints]),
        highest=np.deg2rad([float(joint["highest"]) for joint in joints]),
        baud=content["baud"],
        **limits,
    )
    _check(servos, path)
    return servos


def write(path: Path, servos: JointMap) -> None:
    """Write a map as a TOML file, whole or not at all."""
    with partial_files.replacing(path) as partial:
        partial.write_text(to_toml(servos), encoding="utf-8")


def to_toml(servos: JointMap) -> str:
    """Return the text of a map's file."""
    head = [
        f"baud = {servos.baud}  # bit/s",
        "",
        "[limits]",
        f"speed = {servos.speed}  # rad/s",
        f"torque = {servos.torque}  # of the stall torque",
        f"voltage = {servos.voltage}  # V, below which the robot sits down",
        f"temperature = {servos.temperature}  # degrees Celsius, at which it sits down",
    ]
    lowest, highest = (np.rad2deg(values).round(3).tolist() for values in (servos.lowest, servos.highest))
    for joint, name in enumerate(JOINT_NAMES):
        head += [
            "",
            f"[joints.{name}]",
            f"id = {servos.ids[joint]}",
            f"direction = {servos.directions[joint]}",
            f"zero = {servos.zeros[joint]}  # position at which the angle is zero",
            f"lowest = {lowest[joint]}  # deg",
            f"highest = {highest[joint]}  # deg",
        ]
    return "\n".join(head) + "\n"


def _check(servos: JointMap, path: Path) -> None:
    """Raise `InputError` for errors that a schema cannot express."""
    for joint, name in enumerate(JOINT_NAMES):
        place = f"{path}: joints.{name}"
        if servos.ids[joint] in servos.ids[:joint]:
            other = JOINT_NAMES[servos.ids.index(servos.ids[joint])]
            raise InputError(
                f"{place}.id: expected an id that {other} does not have, got {servos.ids[joint]}; {REMEDY}"
            )
        if servos.directions[joint] == 0:
            raise InputError(f"{place}.direction: expected 1 or -1, got 0; {REMEDY}")
        low, high = hexapod.target_limits().reshape(2, 18)[:, joint]
        if not low - 1e-6 <= servos.lowest[joint] < servos.highest[joint] <= high + 1e-6:
            found = f"{np.rad2deg(servos.lowest[joint]):g} to {np.rad2deg(servos.highest[joint]):g}"
            raise InputError(
                f"{place}: expected limits in {np.rad2deg(low):g} to {np.rad2deg(high):g} deg, got {found}; {REMEDY}"
            )
        stance = hexapod.stance().reshape(18)[joint]
        if not servos.lowest[joint] <= stance <= servos.highest[joint]:
            raise InputError(
                f"{place}: expected limits around the stance, {np.rad2deg(stance):.0f} deg, got others; {REMEDY}"
            )
