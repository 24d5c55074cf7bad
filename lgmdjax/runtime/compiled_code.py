"""Release compiled programs before a process holds too many of them.

XLA maps the code of one rollout program in thousands of pieces, and Linux allows a process 65530 mappings, which about
ten such programs exhaust. The next one fails to compile ("Unable to allocate section memory").
"""

from pathlib import Path

import jax

MAPS_FILE, LIMIT_FILE = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
MAX_MAPPINGS_FRACTION = 0.2  # leaves room for four times as much before the next call


def clear_caches_if_near_limit(fraction: float = MAX_MAPPINGS_FRACTION) -> None:
    """Clear JAX's caches in memory if this process uses more than a fraction of the mappings that Linux allows it.

    Do nothing on systems without such a limit. Cleared programs are compiled again, or read from JAX's cache on disk,
    when they are called next. Call this between parts of a long computation that compile programs of their own.
    """
    if not (MAPS_FILE.exists() and LIMIT_FILE.exists()):
        return
    with MAPS_FILE.open("rb") as lines:
        mappings = sum(1 for _ in lines)
    if mappings > fraction * int(LIMIT_FILE.read_text()):
        jax.clear_caches()
