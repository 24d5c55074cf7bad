"""Paths of the package's own files; no other module derives a path from its own location."""

from pathlib import Path

PACKAGE_DIR = Path(__file__).resolve().parent
"""The root of the package. The hash of its files identifies cached programs."""

DATA_DIR = PACKAGE_DIR / "data"
"""Weights of the package, and done.json with their checksums."""

SHAPING_FILE = DATA_DIR / "shaping.safetensors"
"""Weights of the default shaping networks (`experiments/fit_default_gait.py`)."""

PRETRAINED_DIR = DATA_DIR / "trained"
"""Gait and controller of the pretrained robot. Both come from one run, in which the controller was trained with this
gait."""

MJCF_DIRS = (PACKAGE_DIR / "mjcf", PACKAGE_DIR.parent / "mjcf")
"""Folders that may contain the robot's XML: the first in an installed wheel, the second in a checkout."""
