"""TODO docstring."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec


def deal(work: Callable[..., Any], *batches: Any) -> Any:
    """Call a function of some robots on each of `shares` devices with its share, which the last robot fills up."""
    robots = jax.tree.leaves(batches)[0].shape[0]
    devices = shares(robots)
    mesh = Mesh(np.asarray(jax.local_devices()[:devices]), ("robots",))
    each = PartitionSpec("robots")
    # Unchecked: nothing passes between robots, and MJX starts its loops with constants, which the check refuses.
    dealt = jax.shard_map(work, mesh=mesh, in_specs=each, out_specs=each, check_vma=False)
    filler = -robots % devices
    if not filler:
        return dealt(*batches)
    rows = np.minimum(np.arange(robots + filler, dtype=np.int32), robots - 1)
    results = dealt(*jax.tree.map(lambda leaf: leaf[rows], batches))
    return jax.tree.map(lambda leaf: leaf[:robots], results)


def shares(robots: int) -> int:
    """Count the devices that a crowd is dealt out to: all, if two robots or more come to each.

    A batch of one would be compiled differently, and come to other last bits.
    """
    return max(min(jax.local_device_count(), robots // 2), 1)
