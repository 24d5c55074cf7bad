"""Where the package's own files are: the one module that knows, so that all others can be moved."""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
"""The root of the package; its bytes are what kept programs are known by."""

SHAPING = PACKAGE / "data" / "shaping.safetensors"
"""The default shaping networks (`experiments/fit_default_gait.py`)."""

PRETRAINED = PACKAGE / "data" / "trained"
"""Gait and controller of the pretrained robot, from one run: each was learned with the other."""

MJCF = (PACKAGE / "mjcf", PACKAGE.parent / "mjcf")
"""Folders that may hold the robot's XML: in an installed wheel, and in a checkout."""
