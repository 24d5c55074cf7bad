"""Several processes of one run, on one machine or many: who does what, and waiting for each other (`jax.distributed`).

| function                | what it does                                                                     |
| ----------------------- | -------------------------------------------------------------------------------- |
| `start`, `leave`        | join the other processes of the run, and end                                     |
| `number`, `count`       | which process this is, and of how many                                           |
| `deal`                  | returns this process's share of some items                                       |
| `wait`                  | waits until all processes have come to the same place                            |
| `share`, `share_arrays` | give all processes a value of process 0                                          |
| `only_first`            | does work in process 0 while the others wait                                     |
| `alone`                 | makes this process the only one, for code that the others do not run             |
| `await_files`           | waits until files that others have written are visible here                      |

In a process that `start` has not joined to others, there is one process, number 0, and nothing waits.

All processes must come to the same waits in the same order. A process that ends or fails is noticed at the next wait:
all others then raise `OtherProcessError`, and so end too. The chunks of walks that they have finished by then are on
the disk, and a restart carries on from there. The engine is that of `jax.live_devices`, whose answer is a barrier over
the processes that are alive; a process that was killed counts as alive for `HEARTBEAT` more seconds.

JAX keeps its coordinator in process 0. If process 0 is killed, JAX ends all others at once, with its own message
("Terminating process because the JAX distributed service detected fatal errors").
"""

import contextlib
import io
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import clusters  # JAX has no public way to ask for a value of the cluster,
from jax._src import distributed as jax_distributed  # nor for the client of its coordinator

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import rendezvous

ItemT = TypeVar("ItemT")
TreeT = TypeVar("TreeT")

HEARTBEAT = 60  # s without a sign of life after which a process counts as ended
LONGEST_WAIT = 12 * 3600.0  # s that a process waits for others that are alive
LAST_WAIT = 300.0  # s that process 0 waits for the others to end, before JAX's coordinator ends with it
VISIBLE_SECONDS = 120.0  # within which a network disk shows what another machine has written
PREFIX = "lgmdjax"  # of the keys in the coordinator's store


class OtherProcessError(InputError):
    """Another process of the run has failed, ended, or not come."""


@dataclass
class _Group:
    """The processes of a run, as seen by one of them."""

    number: int
    count: int
    client: Any  # of JAX's coordinator
    waits: int = 0  # so far


_group: _Group | None = None
_is_alone: ContextVar[bool] = ContextVar("is_alone", default=False)


def start(
    coordinator: str = "",
    processes: int | None = None,
    process: int | None = None,
    *,
    seconds: float = 300.0,
    task: str = "",
) -> None:
    """Join the other processes of a run; call it before JAX computes anything.

    Args:
        coordinator: HOST:PORT of process 0; if empty, SLURM or Open MPI say it, and the two numbers.
        processes: how many there are.
        process: number of this process.
        seconds: how long to wait for all processes.
        task: what they do; a process that does something else is refused.

    Raises `InputError` if the processes do not find each other, or if two have the same number.
    """
    global _group
    address, count, own, devices = _place(coordinator, processes, process)
    if count == 1:
        return
    rendezvous.meet(address, rendezvous.Member(process=own, processes=count, task=task), seconds)
    jax.config.update("jax_enable_recoverability", True)  # a process that dies does not end the others
    jax.config.update("jax_enable_preemption_service", False)
    if "JAX_CPU_COLLECTIVES_IMPLEMENTATION" not in os.environ:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(
        address,
        count,
        own,
        local_device_ids=devices,
        initialization_timeout=max(round(seconds), 1),
        heartbeat_timeout_seconds=HEARTBEAT,
        coordinator_bind_address=rendezvous.bind_address(address),
        cluster_detection_method="deactivate",
    )
    jax.local_devices()  # at its first use JAX waits for all processes' lists of devices: here, where all are
    _group = _Group(number=own, count=count, client=jax_distributed.global_state.client)


def leave(fault: str = "") -> None:
    """End the membership of this process; with a fault of its own, all others end at their next wait.

    Process 0 waits for the others to leave, since JAX would end them with it.
    """
    global _group
    group, _group = _group, None
    if group is None:
        return
    with contextlib.suppress(jax.errors.JaxRuntimeError):
        if fault:
            group.client.key_value_set(f"{PREFIX}/failed/{group.number}", fault)
        deadline = time.monotonic() + LAST_WAIT
        while group.number == 0 and _find_live(group, deadline - time.monotonic()) not in ({0}, None):
            pass
        jax.distributed.shutdown()


def number() -> int:
    """Return the number of this process; 0 if it is the only one."""
    return 0 if _group is None or _is_alone.get() else _group.number


def count() -> int:
    """Return the number of processes."""
    return 1 if _group is None or _is_alone.get() else _group.count


def is_first() -> bool:
    """Tell whether this is process 0, which writes what is written once."""
    return number() == 0


def deal(items: Sequence[ItemT]) -> list[ItemT]:
    """Return this process's share of some items: each is one process's.

    >>> deal([0, 2, 5])  # a single process
    [0, 2, 5]
    """
    return list(items[number() :: count()])


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Inside the block this process is the only one: number 0 of 1."""
    token = _is_alone.set(True)
    try:
        yield
    finally:
        _is_alone.reset(token)


def wait(place: str) -> None:
    """Wait until all processes have come to a place, which messages name.

    Raises `OtherProcessError` if one has failed or ended, or does not come within `LONGEST_WAIT`.
    """
    if count() > 1:
        assert _group is not None
        _wait(_group, place)


def share(place: str, compute: Callable[[], Any]) -> Any:
    """Return in all processes what `compute` returns in process 0, a JSON value."""
    return json.loads(_share_bytes(place, lambda: json.dumps(compute()).encode())) if count() > 1 else compute()


def share_arrays(place: str, tree: TreeT) -> TreeT:
    """Return in all processes process 0's tree of arrays, with the same bits; all pass one of the same structure."""
    if count() == 1:
        return tree
    leaves, structure = jax.tree.flatten(tree)

    def pack() -> bytes:
        file = io.BytesIO()
        np.savez(file, allow_pickle=False, **{str(k): np.asarray(leaf) for k, leaf in enumerate(leaves)})
        return file.getvalue()

    with np.load(io.BytesIO(_share_bytes(place, pack)), allow_pickle=False) as arrays:
        return jax.tree.unflatten(structure, [jnp.asarray(arrays[str(k)]) for k in range(len(leaves))])


def only_first(place: str, work: Callable[[], object]) -> None:
    """Do some work in process 0, while the others wait."""
    if is_first():
        with alone():
            work()
    wait(place)


def await_files(paths: Iterable[Path], seconds: float | None = None) -> None:
    """Wait until files that other processes have written are visible here; raise `InputError` if they do not appear."""
    if count() == 1:
        return
    limit = VISIBLE_SECONDS if seconds is None else seconds
    deadline = time.monotonic() + limit
    for path in paths:
        while not path.exists():
            if time.monotonic() > deadline:
                raise InputError(
                    f"expected {path} from another process within {limit:g} s, got none; "
                    "put --out on a disk that all machines share"
                )
            time.sleep(0.2)


def _place(coordinator: str, processes: int | None, process: int | None) -> tuple[str, int, int, Sequence[int] | None]:
    """Return address, number of processes, number of this process, and its GPUs (None for all)."""
    given = [bool(coordinator), processes is not None, process is not None]
    if any(given) and not all(given):
        raise InputError(
            "expected all of --coordinator, --processes and --process, got some; or none under SLURM and Open MPI"
        )
    devices = None
    if not any(given):
        try:
            found = clusters.ClusterEnv.auto_detect_unset_distributed_params(None, None, None, None, None, None)
        except (KeyError, ValueError, RuntimeError) as error:
            reason = one_line(f"{type(error).__name__}: {error}")[:200]
            raise InputError(
                f"expected SLURM or Open MPI to say which process this is, got {reason}; "
                "give --coordinator, --processes and --process"
            ) from error
        coordinator, processes, process, devices = found[0] or "", *found[1:]
    if not coordinator or processes is None or process is None:
        raise InputError(
            "expected SLURM or Open MPI, or --coordinator HOST:PORT --processes N --process K, got none of them; "
            "start it with srun or mpirun, or give the flags"
        )
    if not 0 <= process < processes:
        raise InputError(f"expected a --process of 0 to {processes - 1}, got {process}; number the processes from 0")
    rendezvous.split_address(coordinator)
    return coordinator, processes, process, devices


def _share_bytes(place: str, compute: Callable[[], bytes]) -> bytes:
    assert _group is not None
    key = f"{PREFIX}/shared/{_group.waits}"
    if _group.number == 0:
        with alone():
            content = compute()
        _group.client.key_value_set_bytes(key, content)
    _wait(_group, place)
    return _group.client.blocking_key_value_get_bytes(key, 1000 * HEARTBEAT)


def _wait(group: _Group, place: str) -> None:
    arrived = f"{PREFIX}/arrived/{group.waits}"
    group.waits += 1
    group.client.key_value_set(f"{arrived}/{group.number}", "")
    live = _find_live(group, LONGEST_WAIT)
    faults = _read_numbered(group, f"{PREFIX}/failed/")
    everybody = set(range(group.count))
    for process, fault in sorted(faults.items()):
        raise OtherProcessError(f"process {process}: {fault}")
    if live is None:
        late = _name(everybody - _read_numbered(group, f"{arrived}/").keys())
        raise OtherProcessError(
            f"{place}: expected all processes within {LONGEST_WAIT:g} s, got none with number {late}; "
            "end all processes and start them again: they carry on"
        )
    if live < everybody:
        raise OtherProcessError(
            f"{place}: expected all {group.count} processes, got an end of number {_name(everybody - live)}; "
            "look at its output, and start all processes again: they carry on"
        )


def _read_numbered(group: _Group, folder: str) -> dict[int, str]:
    """Return what processes have put into a folder of the coordinator's store, by their numbers."""
    return {int(key.rpartition("/")[2]): value for key, value in group.client.key_value_dir_get(folder)}


def _find_live(group: _Group, seconds: float) -> set[int] | None:
    """Return the processes that are alive, when all of those have asked; None after some seconds."""
    answers: queue.Queue[Any] = queue.Queue()

    def ask() -> None:
        try:
            answers.put(group.client.get_live_nodes(list(range(group.count))))
        except Exception as error:
            answers.put(error)

    threading.Thread(target=ask, daemon=True).start()  # in the main thread it could not be interrupted
    try:
        answer = answers.get(timeout=max(seconds, 0.0))
    except queue.Empty:
        return None
    if isinstance(answer, Exception):
        raise answer
    return set(answer)


def _name(numbers: set[int]) -> str:
    return ", ".join(map(str, sorted(numbers)[:8])) + " and others" * (len(numbers) > 8)
