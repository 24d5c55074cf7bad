"""Sharding of robots over the devices of this process, and of the streams of a fit over those of all processes.

Robots are independent of each other, so they can run in parallel. CPU cores become devices if `JAX_NUM_CPU_DEVICES` is
set before JAX starts, as the command line does. One robot cannot be divided among cores, since its physics is a long
sequence of small operations. Streams of recorded walks are independent too, except that all share the weights, whose
gradient is summed over the devices.

Of several processes (`lgmdjax.runtime.distributed`) each rolls out robots of its own, so that a rollout exchanges
nothing with other processes. The streams of a fit are divided among all of them, if each device then has
`MIN_STREAMS`; if not, every process computes the whole fit.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from lgmdjax.runtime import distributed

ResultT = TypeVar("ResultT")
TreeT = TypeVar("TreeT")
Device = Any  # `jax.Device`, which type checkers do not take for a type

MIN_STREAMS = 8  # on one device; fewer take as long as these


def shard_robots(work: Callable[..., ResultT], *batches: PyTree) -> ResultT:
    """Shard `work` over devices along the robot axis, padding with the last robot.

    Args:
        work: a function of batches of robots.
        batches: its arguments; the first axis of every leaf is that of the robots, and so it is in the result.
    """
    robots = jax.tree.leaves(batches)[0].shape[0]
    devices = device_count(robots)
    mesh = _mesh(jax.local_devices()[:devices], "robots")
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


def shard_streams(work: Callable[..., ResultT], batches: PyTree, shared: tuple[PyTree, ...], *, axis: int) -> ResultT:
    """Shard `work(batches, *shared)` over devices along the axis of streams; its result is the same on all of them.

    Args:
        work: a function that sums over devices, with `sum_over_devices`, whatever depends only on its own streams.
        batches: leaves with an axis of streams.
        shared: further arguments, replicated on every device.
        axis: of the streams in every leaf of `batches`.
    """
    streams = jax.tree.leaves(batches)[0].shape[axis]
    mesh, spec = _mesh(stream_devices(streams), "streams"), _stream_spec(axis)
    specs = (spec, *(PartitionSpec(),) * len(shared))
    # check_vma is off: it would sum gradients over the devices by itself, leaf by leaf, which takes longer.
    return jax.shard_map(work, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(), check_vma=False)(batches, *shared)


def sum_over_devices(tree: TreeT) -> TreeT:
    """Return the sum of a tree over the devices of `shard_streams`, in one exchange for all leaves."""
    flat, unravel = ravel_pytree(tree)
    return unravel(jax.lax.psum(flat, "streams"))


def stream_device_count(streams: int) -> int:
    """Return the largest number of devices that gives each equally many streams, if possible `MIN_STREAMS` or more."""
    most = max(min(jax.local_device_count(), streams // MIN_STREAMS), 1)
    return max(count for count in range(1, most + 1) if streams % count == 0)


def stream_devices(streams: int) -> list[Device]:
    """Return the devices of a fit: equally many of each process; those of this process if there are few streams."""
    processes = distributed.count()
    if processes > 1:
        by_process = [jax.local_devices(process_index=process) for process in range(processes)]
        for each in range(min(map(len, by_process)), 0, -1):
            if streams % (each * processes) == 0 and streams // (each * processes) >= MIN_STREAMS:
                return [device for devices in by_process for device in devices[:each]]
    return jax.local_devices()[: stream_device_count(streams)]


def divide_streams(batches: TreeT, streams: int, *, axis: int) -> TreeT:
    """Return the batches of `shard_streams` on the devices of all processes, if these compute it together.

    Every process passes the same values, whole; one that computes alone gets them back as they are.
    """
    return _place(batches, streams, _stream_spec(axis))


def replicate(shared: TreeT, streams: int) -> TreeT:
    """Return the further arguments of `shard_streams` as `divide_streams` does its batches, whole on every device."""
    return _place(shared, streams, PartitionSpec())


def _place(tree: TreeT, streams: int, spec: PartitionSpec) -> TreeT:
    devices = stream_devices(streams)
    if all(device.process_index == jax.process_index() for device in devices):
        return tree
    sharding = NamedSharding(_mesh(devices, "streams"), spec)

    def place(leaf: PyTree) -> jax.Array:
        value = np.asarray(leaf)
        return jax.make_array_from_callback(value.shape, sharding, lambda index: value[index])

    return jax.tree.map(place, tree)


def _stream_spec(axis: int) -> PartitionSpec:
    return PartitionSpec(*(None,) * axis, "streams")


def _mesh(devices: list[Device], axis: str) -> Mesh:
    return Mesh(np.asarray(devices), (axis,))
