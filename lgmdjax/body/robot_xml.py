"""The robot's XML for C MuJoCo. Imports no JAX, which drawing recorded walks doesn't need."""

from pathlib import Path

import mujoco

from lgmdjax.errors import InputError, one_line
from lgmdjax.paths import MJCF_DIRS

LEGS = ("left_front", "left_middle", "left_rear", "right_rear", "right_middle", "right_front")
JOINTS = ("coxa", "femur", "tibia")


def xml_path() -> Path:
    """Return the path of the robot's XML: in the installed package, or next to it in a checkout."""
    for folder in MJCF_DIRS:
        if (folder / "hexapod.xml").is_file():
            return folder / "hexapod.xml"
    raise InputError(f"expected hexapod.xml in {' or '.join(map(str, MJCF_DIRS))}, got none; reinstall lgmdjax")


def load(path: Path | str | None = None) -> mujoco.MjModel:
    """Load the robot for C MuJoCo: the package's, or a variant with the same names from the file `path`.

    >>> load().nu  # servos
    18
    """
    path = xml_path() if path is None else Path(path)
    if not path.is_file():
        raise InputError(
            f"expected a robot's XML file, got {path}, which does not exist; give the path of a hexapod.xml"
        )
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(
            f"expected a MuJoCo model in {path}, got one that does not compile ({one_line(error)}); correct it"
        ) from None
    servos = [model.actuator(i).name for i in range(model.nu)]
    expected = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]
    if servos != expected:
        raise InputError(
            f"expected {len(expected)} servos {expected[0]} ... {expected[-1]} in {path}, got {len(servos)}"
            f" ({', '.join(servos[:3])} ...); start from the hexapod.xml of this package"
        )
    return model
