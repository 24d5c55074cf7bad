"""The versions that a result depends on, as they stand in every file that is meant to be kept."""

import sys
from importlib.metadata import PackageNotFoundError, version

from lgmdjax import __version__

PACKAGES = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "numpy", "pyarrow")


def installed() -> dict[str, str]:
    """Name what is installed; 'missing' where a package is not."""
    found = {"python": sys.version.split()[0], "lgmdjax": __version__}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "missing"
    return found
