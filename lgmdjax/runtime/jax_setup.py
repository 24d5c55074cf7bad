"""Environment variables that JAX reads when it is imported.

This module does not import JAX, so that a program can call `prepare_jax` first.
"""

import os
from pathlib import Path


def prepare_jax() -> None:
    """Set the environment variables of JAX that the user has not set.

    Compiled programs are cached in ~/.cache/lgmdjax/jax, each CPU core becomes a device, over which robots are sharded,
    and XLA logs less.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(home / "lgmdjax" / "jax"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(cores))
    # XLA logs its own tuning flags as errors whenever it reads a compiled program; real errors raise an exception.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
