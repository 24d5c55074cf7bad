"""The description of a robot of one's own: a TOML file that says which parts of an MJCF are which parts of a hexapod.

```toml
mjcf = "walker.xml"               # relative to this file
trunk = "base"                    # the body with the free joint
shape = ["hull", "head"]          # geoms of the trunk that must not touch obstacles
eyes = ["cam_left", "cam_right"]  # sites, left first
scanner = "lidar"                 # site

[legs.left_front]
joints = ["L1_yaw", "L1_lift", "L1_knee"]
foot = "L1_toe"                   # a geom or a site, a sphere
```

and so on for the six legs of `LEGS`. These may be left out:

| key            | meaning                                                             | default                       |
| -------------- | ------------------------------------------------------------------- | ----------------------------- |
| stance         | key frame in which the robot stands                                 | the package's angles          |
| forward        | axis of the trunk that points forward: x, -x, y or -y               | x                             |
| locked         | table of further joints of the legs, and the angles they keep [deg] | none                          |

Lengths, masses, limits, gains and friction are in the MJCF, and are read from there (`lgmdjax.body.custom_robot`).
"""

import math
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from lgmdjax.body.robot_xml import JOINTS, LEGS
from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import schema

PAGE = "docs/howto/robot.md"
FORWARD = {"x": 0.0, "y": 90.0, "-x": 180.0, "-y": -90.0}  # deg, of the forward axis from the trunk's x axis
LEG = schema.Object({"joints": schema.Texts(len(JOINTS)), "foot": schema.Text()})
FILE = schema.Object(
    {
        "mjcf": schema.Text(),
        "trunk": schema.Text(),
        "shape": schema.Texts(),
        "eyes": schema.Texts(2),
        "scanner": schema.Text(),
        "legs": schema.Object(dict.fromkeys(LEGS, LEG)),
    },
    {"stance": schema.Text(), "forward": schema.Text(tuple(FORWARD)), "locked": schema.Object()},
)


@dataclass(frozen=True, kw_only=True)
class Leg:
    """Names of the parts of a leg in the MJCF."""

    joints: tuple[str, ...]  # coxa, femur, tibia
    foot: str


@dataclass(frozen=True, kw_only=True)
class Description:
    """Contents of the TOML file."""

    path: Path  # of the file, for messages
    mjcf: Path
    trunk: str
    shape: tuple[str, ...]
    eyes: tuple[str, ...]
    scanner: str
    legs: Mapping[str, Leg]  # by `LEGS`
    stance: str | None
    forward: float  # rad, of the forward axis from the trunk's x axis
    locked: Mapping[str, float]  # rad

    def error(self, key: str, expected: str, got: str, remedy: str) -> InputError:
        """Return the error for the value of a key."""
        return InputError(f"{self.path}: {key}: expected {expected}, got {one_line(got)}; {remedy}")


def read(path: Path) -> Description:
    """Read a description; raise `InputError` for a file that is missing or wrong, with the first fault in it."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"expected the TOML file of a robot, found none at {path}; {PAGE} shows one") from error
    except (OSError, ValueError) as error:
        raise InputError(
            f"expected the description of a robot in TOML, got {path}: {one_line(error)}; correct it ({PAGE} shows one)"
        ) from error
    remedy = f"correct it ({PAGE} shows one)"
    schema.check(FILE, content, str(path), remedy)
    _refuse_unknown(path, content, (*FILE.fields, *FILE.optional))
    _refuse_unknown(path, content["legs"], LEGS, "legs.")
    for leg, table in content["legs"].items():
        _refuse_unknown(path, table, LEG.fields, f"legs.{leg}.")
    locked = content.get("locked", {})
    for joint, angle in locked.items():
        schema.check(schema.Number(-360, 360), angle, f"{path}: locked.{joint}", "give an angle in degrees")
    mjcf = path.parent / content["mjcf"]
    if not mjcf.is_file():
        raise InputError(f"{path}: mjcf: expected the path of an MJCF, relative to this file, got {mjcf}; correct it")
    return Description(
        path=path,
        mjcf=mjcf,
        trunk=content["trunk"],
        shape=tuple(content["shape"]),
        eyes=tuple(content["eyes"]),
        scanner=content["scanner"],
        legs={leg: Leg(joints=tuple(table["joints"]), foot=table["foot"]) for leg, table in content["legs"].items()},
        stance=content.get("stance"),
        forward=math.radians(FORWARD[content.get("forward", "x")]),
        locked={joint: math.radians(angle) for joint, angle in locked.items()},
    )


def suggest(name: str, names: Collection[str]) -> str:
    """Return a hint at the name that was probably meant.

    >>> suggest("L1_coxae", ["L1_coxa", "L1_femur"])
    'did you mean L1_coxa?'
    """
    close = get_close_matches(name, names, n=1)
    if close:
        return f"did you mean {close[0]}?"
    return f"choose one of {', '.join(sorted(names))[:300]}" if names else "name it in the MJCF"


def _refuse_unknown(path: Path, table: Mapping[str, Any], known: Collection[str], prefix: str = "") -> None:
    for name in table:
        if name not in known:
            raise InputError(f"{path}: expected no key {prefix}{one_line(name)}, got one; {suggest(name, known)}")
