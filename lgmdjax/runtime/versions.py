"""Versions of the packages that results depend on; every file meant to be kept records them."""

import sys
from importlib.metadata import PackageNotFoundError, version

from lgmdjax import __version__

PACKAGES = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "numpy", "pyarrow")


def installed() -> dict[str, str]:
    """Return the installed versions by package, with Python's own; "missing" for a package that is not installed.

    >>> from lgmdjax.runtime import versions
    >>> sorted(versions.installed())[:4]
    ['flax', 'jax', 'jaxlib', 'lgmdjax']
    """
    found = {"python": sys.version.split()[0], "lgmdjax": __version__}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "missing"
    return found
