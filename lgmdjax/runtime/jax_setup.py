"""What must be set before JAX is imported, and how MJX is imported without a word."""

import contextlib
import io
import os
from pathlib import Path


def prepare_jax() -> None:
    """Set what JAX reads on import, where the user has not: programs are kept, robots go to all cores, less noise."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(home / "lgmdjax" / "jax"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(cores))
    # XLA reports its own tuning flags as errors whenever it reads a compiled program back; real ones raise.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def import_physics() -> None:
    """Import MJX without the lines that it prints about an optional back end."""
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx  # noqa: F401
