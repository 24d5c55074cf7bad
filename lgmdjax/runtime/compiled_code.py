"""Compiled programs, of which a process can hold only so many.

The code of a walk is mapped in thousands of pieces, and Linux allows a process 65530 of them: about ten walks' worth.
The eleventh does not compile ("Unable to allocate section memory").
"""

from pathlib import Path

import jax

MAPPED, ALLOWED = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
SHARE = 0.2  # room for as much again, four times


def let_go(share: float = SHARE) -> None:
    """Let go of all compiled programs if they fill more than a share of what is allowed; where there is a bound.

    They are compiled anew, or read back from JAX's cache on disk, when they are called again: call this between parts
    of a long work that have programs of their own.
    """
    if not (MAPPED.exists() and ALLOWED.exists()):
        return
    with MAPPED.open("rb") as lines:
        mapped = sum(1 for _ in lines)
    if mapped > share * int(ALLOWED.read_text()):
        jax.clear_caches()
