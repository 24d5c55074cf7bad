"""The robot's body as MJCF, and its model for C MuJoCo. Imports no JAX, which drawing recorded walks doesn't need.

A body is that of the package, `mjcf/hexapod.xml`, or the user's own in the same form: a `Body`, which
`lgmdjax.body.custom_robot` makes from any MJCF. In the signatures of this package `None` means the package's body. A
run folder whose robot is the user's own has it in the folder of stage fit-gait, as `FILE`.
"""

import copy
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from lgmdjax.errors import InputError, one_line
from lgmdjax.paths import MJCF_DIRS
from lgmdjax.runtime import checksums, storage

LEGS = ("left_front", "left_middle", "left_rear", "right_rear", "right_middle", "right_front")
JOINTS = ("coxa", "femur", "tibia")
CAPSULES = ("bumper", *(f"{leg}_{part}" for leg in LEGS for part in JOINTS[1:]))  # geoms that collide with obstacles
EYES = ("eye_left", "eye_right")
FILE = "robot.xml"
Offset = tuple[float, float, float]


@dataclass(frozen=True, repr=False)
class Body:
    """A body of one's own: the text of an MJCF with the names of `mjcf/hexapod.xml`."""

    xml: str
    digest: str = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "digest", checksums.digest(self.xml.encode())[:16])

    def __repr__(self) -> str:
        return f"Body({self.digest})"


class SensorMounts(NamedTuple):
    """Where the sensors sit, in the trunk's frame."""

    eyes: tuple[Offset, Offset]  # m, left first
    laser: Offset  # m


def xml_path() -> Path:
    """Return the path of the robot's XML: in the installed package, or next to it in a checkout."""
    for folder in MJCF_DIRS:
        if (folder / "hexapod.xml").is_file():
            return folder / "hexapod.xml"
    raise InputError(f"expected hexapod.xml in {' or '.join(map(str, MJCF_DIRS))}, got none; reinstall lgmdjax")


def load(source: Path | str | Body | None = None) -> mujoco.MjModel:
    """Load a robot for C MuJoCo: the package's, a body of one's own, or the file of a body in the same form.

    >>> load().nu  # servos
    18
    """
    if source is None or isinstance(source, Body):
        return copy.deepcopy(compiled(source))
    path = Path(source)
    if not path.is_file():
        raise InputError(
            f"expected a robot's XML file, got {path}, which does not exist; give the path of a hexapod.xml"
        )
    return _compile(read_spec(path), str(path))


@lru_cache(maxsize=8)
def compiled(body: Body | None = None) -> mujoco.MjModel:
    """Return the model of a body, which all callers share: do not change it (`load` returns one to change)."""
    return _compile(read_spec(body), "the robot's XML" if body else str(xml_path()))


def read_spec(source: Path | Body | None = None) -> mujoco.MjSpec:
    """Return the MJCF of a body, to change it before it is compiled."""
    if isinstance(source, Body):
        return mujoco.MjSpec.from_string(source.xml)
    path = xml_path() if source is None else source
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise _broken(str(path), error) from None


def _compile(spec: mujoco.MjSpec, place: str) -> mujoco.MjModel:
    """Compile an MJCF; raise `InputError` unless it has the servos of this package in their order."""
    try:
        model = spec.compile()
    except ValueError as error:
        raise _broken(place, error) from None
    servos = [model.actuator(i).name for i in range(model.nu)]
    expected = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]
    if servos != expected:
        raise InputError(
            f"expected {len(expected)} servos {expected[0]} ... {expected[-1]} in {place}, got {len(servos)}"
            f" ({', '.join(servos[:3])} ...); for other names, describe the robot in a TOML file (docs/howto/robot.md)"
        )
    return model


def _broken(place: str, error: Exception) -> InputError:
    reason = one_line(error)
    return InputError(f"expected a MuJoCo model in {place}, got one that does not compile ({reason}); correct it")


def stance(body: Body | None = None) -> Float[np.ndarray, "6 3"]:
    """Return the joint angles [rad] of the default stance (the key frame of the XML).

    >>> stance().shape
    (6, 3)
    """
    return compiled(body).key("stance").qpos[7:].reshape(6, 3).copy()


def target_limits(body: Body | None = None) -> Float[np.ndarray, "2 6 3"]:
    """Return the lowest and the highest set points of the servos [rad], to which `hexapod.substep` clips them.

    >>> np.rad2deg(target_limits()[:, 0]).round().tolist()  # coxa, femur, tibia
    [[-75.0, -100.0, -102.0], [75.0, 100.0, 67.0]]
    """
    return compiled(body).actuator_ctrlrange.T.reshape(2, 6, 3).copy()


def sensor_mounts(body: Body | None = None) -> SensorMounts:
    """Return where eyes and laser scanner sit.

    >>> sensor_mounts().laser
    (0.0, 0.0, 0.03)
    """
    left, right, laser = (_offset(compiled(body), name) for name in (*EYES, "laser"))
    return SensorMounts(eyes=(left, right), laser=laser)


def _offset(model: mujoco.MjModel, site: str) -> Offset:
    x, y, z = model.site(site).pos.tolist()
    return x, y, z


def read_body(gait_folder: Path) -> Body | None:
    """Return the body in the folder of a run's stage fit-gait; None if the run's robot has the package's body."""
    path = gait_folder / FILE
    return Body(storage.read_file(path).decode()) if path.is_file() or _is_listed(gait_folder) else None


def _is_listed(gait_folder: Path) -> bool:
    """Return whether the stage wrote a body, even if its file is gone."""
    try:
        return FILE in (checksums.read_stamp(gait_folder).files or {})
    except (OSError, ValueError):  # no stamp, or a damaged one, which the next file that is read names
        return False


def find_body(folder: Path) -> Body | None:
    """Return the body of the run that a folder belongs to; None for the package's, and if it belongs to no run."""
    runs = (run for run in (folder.resolve(), *folder.resolve().parents) if (run / "fit-gait").is_dir())
    run = next(runs, None)
    return None if run is None else read_body(run / "fit-gait")
