"""What must be set before JAX and other libraries are imported: environment variables, and how Python frees memory.

This module imports none of these libraries, so that a program can call `prepare_jax` first.
"""

import ctypes.util
import gc
import os
import sys
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None

from lgmdjax.errors import InputError, one_line

PREFIXES = ("JAX_", "XLA_", "CUDA_", "TF_CPP_", "MUJOCO_", "MPL", "PYOPENGL_")
"""Prefixes of the environment variables that affect how libraries start."""
MIN_MEMORY = 2e9  # bytes of address space; with less, XLA ends the process when it starts its threads
COUNT = "JAX_NUM_CPU_DEVICES"
GARBAGE_THRESHOLDS = 100_000, 20, 50  # new objects, and collections of younger ones, before each kind of collection


def prepare_jax() -> None:
    """Set the environment variables of JAX that the user has not set.

    Compiled programs, including the many small ones, are cached in ~/.cache/lgmdjax/jax; without a home folder they are
    not cached. Each CPU core becomes a device, over which robots are sharded, and XLA logs less.
    """
    if home := _cache_home():
        _set_default("JAX_COMPILATION_CACHE_DIR", str(home / "lgmdjax" / "jax"))
    _set_default("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    _set_default(COUNT, str(cores))
    # XLA logs its own tuning flags as errors whenever it reads a compiled program; real errors raise an exception.
    _set_default("TF_CPP_MIN_LOG_LEVEL", "3")


def collect_garbage_rarely() -> None:
    """Let Python look for unreachable objects less often.

    Tracing a rollout makes a million objects, most of which stay. With Python's own threshold of 700, looking through
    them takes a fifth of the time.
    """
    gc.set_threshold(*GARBAGE_THRESHOLDS)


def prepare_opengl() -> None:
    """Set the variables with which MuJoCo renders without a window; call this before MuJoCo is imported.

    On Linux without a screen MuJoCo uses EGL, or OSMesa if there is no EGL. Mesa's software renderer gets no threads,
    which for pictures of a hundred pixels cost five times the time that they save.
    """
    _set_default("LP_NUM_THREADS", "0")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        _set_default("MUJOCO_GL", "egl" if ctypes.util.find_library("EGL") else "osmesa")


def check_variables() -> None:
    """Raise `InputError` for a variable or a memory limit with which JAX would fail without naming it."""
    count = os.environ.get(COUNT, "1")
    if not (count.isascii() and count.isdigit() and 0 < int(count) <= 1024):
        raise InputError(f"expected {COUNT} of 1 to 1024, got {count!r}; unset it for one device on each core")
    flags = os.environ.get("XLA_FLAGS", "").split()
    if flags and not (all(flag.startswith("--xla_") for flag in flags) or Path(flags[0]).is_file()):
        raise InputError(
            f"expected XLA_FLAGS of the form --xla_name=value, or a file of them, got {' '.join(flags)!r}; change or "
            "unset it"
        )  # XLA itself would end the process; so it does for names that it does not know
    limit = resource.getrlimit(resource.RLIMIT_AS)[0] if resource is not None else -1
    if 0 <= limit < MIN_MEMORY:
        gigabytes = f"expected {MIN_MEMORY / 1e9:g} GB of memory or more, got a limit of {limit / 1e9:.2g} GB"
        raise InputError(f"{gigabytes}; raise it (ulimit -v)")


def user_variables() -> str:
    """Return the variables that the user has set and that affect how libraries start, in one line; it may be empty."""
    names = sorted(name for name in os.environ if name.startswith(PREFIXES) and os.environ[name] != _DEFAULTS.get(name))
    return one_line(", ".join(f"{name}={os.environ[name]!r}" for name in names))


_DEFAULTS: dict[str, str] = {}  # variables that `prepare_jax` set


def _set_default(name: str, value: str) -> None:
    if name not in os.environ:
        os.environ[name] = _DEFAULTS[name] = value


def _cache_home() -> Path | None:
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # neither HOME nor an entry in the user database
        return None
