"""Robots spread over the devices of this machine.

Robots are independent of each other, so they can run in parallel. A CPU core is a device if `JAX_NUM_CPU_DEVICES` says
so before JAX starts, as the command line does. The cores cannot share one robot, whose physics is a long sequence of
small sums.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

ResultT = TypeVar("ResultT")


def shard_robots(work: Callable[..., ResultT], *batches: PyTree) -> ResultT:
    """Shard `work` over devices along the robot axis, padding with the last robot.

    Args:
        work: a function of batches of robots.
        batches: its arguments; the first axis of every leaf is that of the robots, and so it is in the result.
    """
    robots = jax.tree.leaves(batches)[0].shape[0]
    devices = device_count(robots)
    mesh = Mesh(np.asarray(jax.local_devices()[:devices]), ("robots",))
    spec = PartitionSpec("robots")
    # check_vma is off: robots exchange nothing, and MJX starts its loops with constants, which the check refuses.
    sharded = jax.shard_map(work, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    padding = -robots % devices
    if not padding:
        return sharded(*batches)
    rows = np.minimum(np.arange(robots + padding, dtype=np.int32), robots - 1)
    results = sharded(*jax.tree.map(lambda leaf: leaf[rows], batches))
    return jax.tree.map(lambda leaf: leaf[:robots], results)


def device_count(robots: int) -> int:
    """Return the number of devices for a batch: all of them, if each gets at least two robots.

    A batch of one would be compiled differently, with other rounding.
    """
    return max(min(jax.local_device_count(), robots // 2), 1)
