"""Rollouts of any number of robots on the host, with a progress bar, returned or recorded in a folder."""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np
from tqdm.auto import tqdm

from lgmdjax.control import policies
from lgmdjax.control.names import PolicyName
from lgmdjax.runtime import distributed, interruption
from lgmdjax.runtime.mjx import mjx
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import closed_loop, episodes
from lgmdjax.simulation.assembly import fingerprint, select_policy
from lgmdjax.simulation.rollout import concatenate_time, rollout_chunks
from lgmdjax.simulation.room_batches import benchmark_rooms
from lgmdjax.simulation.settings import BenchmarkRooms

BATCH_SIZES = (4, 16)  # robots that are rolled out at once: two compiled programs serve any number
CHUNK_SECONDS = 5.0  # s of robot time between two updates of the progress bar
PROGRESS_FORMAT = "{desc}: {percentage:3.0f} % |{bar}| {n:.0f}/{total:.0f} robot-s [{elapsed}<{remaining}, {rate_fmt}]"


def rollout(
    robot: closed_loop.Params,
    rooms: closed_loop.Room,
    *,
    seconds: float,
    policy: PolicyName = "learned",
    render: bool | None = None,
) -> closed_loop.Record:
    """Roll out a robot in each of some rooms, and return a NumPy record with axes (robot, frame).

    The first call compiles the simulation, which takes minutes.

    ```python
    import jax
    import lgmdjax as lj

    rooms = lj.random_rooms(jax.random.key(0), 4)
    record = lj.rollout(lj.load_robot(), rooms, seconds=30)
    record.position.shape  # (4, 900, 3)
    ```

    Args:
        robot: parameters of the robot, as `assembly.load_robot` returns them.
        rooms: a batch of rooms, as `room_batches.random_rooms` returns it.
        seconds: of robot time.
        policy: name of the policy.
        render: whether to render the cameras; if None, only for policies that use them. Without pictures u is 0.5.
    """
    chosen = policies.get_policy(policy)
    batches = rollout_in_batches(
        select_policy(robot, chosen),
        closed_loop.build_model(robot),
        rooms,
        seconds,
        chosen.name,
        render=chosen.uses_camera if render is None else render,
    )
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *(record for _, record in batches))


def rollout_with_progress(
    params: closed_loop.Params,
    model: mjx.Model,
    rooms: closed_loop.Room,
    seconds: float,
    label: str,
    *,
    render: bool = True,
) -> Iterator[closed_loop.Record]:
    """Roll out a batch of robots, yielding records of `CHUNK_SECONDS`, with a progress bar in robot-seconds.

    The first chunk waits for the compiler.
    """
    robots = rooms.starts.shape[0]
    print(f"{label}: compiling the simulation, then {robots} robots for {seconds:g} s each", flush=True)
    chunks = rollout_chunks(params, model, rooms, policies.SWITCH, seconds, render=render, chunk_seconds=CHUNK_SECONDS)
    # The bar counts frames, which are integers: rounded sums of seconds could exceed the total.
    frames, second = robots * round(seconds * closed_loop.FRAME_RATE), 1 / closed_loop.FRAME_RATE
    with tqdm(total=frames, desc=label, unit="robot-s", unit_scale=second, bar_format=PROGRESS_FORMAT) as bar:
        for chunk in chunks:
            interruption.check()
            bar.update(chunk.time.size)
            yield chunk


def rollout_in_batches(
    params: closed_loop.Params,
    model: mjx.Model,
    rooms: closed_loop.Room,
    seconds: float,
    label: str,
    *,
    render: bool = True,
    batches: Iterable[int] | None = None,
) -> Iterator[tuple[list[int], closed_loop.Record]]:
    """Roll out any number of robots in batches of one of `BATCH_SIZES`, yielding indices of robots and their record.

    All batches have one size and share one compiled program: the last batch is padded with copies of its last robot,
    which are cut from the record. `batches` has the numbers of those that are rolled out; None means all.
    """
    robots = rooms.starts.shape[0]
    size = _batch_size(robots)
    for number in range(count_batches(robots)) if batches is None else batches:
        first = number * size
        present = list(range(first, min(first + size, robots)))
        padded = np.minimum(np.arange(first, first + size, dtype=np.int32), robots - 1)
        batch = jax.tree.map(lambda leaf, padded=padded: leaf[padded], rooms)
        part = f"{label}, {first + 1} to {present[-1] + 1} of {robots}"
        record = concatenate_time(list(rollout_with_progress(params, model, batch, seconds, part, render=render)))
        yield present, jax.tree.map(lambda leaf, present=present: leaf[: len(present)], record)


def record_rollouts(
    folder: Path,
    params: closed_loop.Params,
    rooms: closed_loop.Room,
    seconds: float,
    policy: policies.Policy,
    *,
    seed: int,
    parameters: JsonObject,
    label: str,
    render: bool | None = None,
) -> closed_loop.Record:
    """Roll out a policy and record it in a folder, one file for each batch; return the whole record.

    Batches that the folder already has are not repeated. The others are dealt over all processes of the run, if there
    are several; each of them returns the whole record.

    Args:
        folder: where to write.
        params: the robot.
        rooms: a batch of rooms, one for each robot.
        seconds: of robot time.
        policy: the policy to roll out.
        seed: the seed of the rooms.
        parameters: JSON values that identify this rollout; a folder of other rollouts is refused.
        label: of the progress bar.
        render: whether to render the cameras; if None, only for policies that use them.
    """
    writer = episodes.Writer(folder, parameters)
    robots = rooms.starts.shape[0]
    with dealt_chunks(writer, count_batches(robots)) as own:
        batches = rollout_in_batches(
            select_policy(params, policy),
            closed_loop.build_model(params),
            rooms,
            seconds,
            f"{label}: {policy.name}",
            render=policy.uses_camera if render is None else render,
            batches=own,
        )
        for indices, record in batches:
            number = indices[0] // _batch_size(robots)
            writer.write(record, episode=number, rooms=indices, seed=seed, number=number)
    return episodes.stack_walks(episodes.read(folder))


@contextlib.contextmanager
def dealt_chunks(writer: episodes.Writer, total: int) -> Iterator[list[int]]:
    """Yield the numbers of the chunks that this process has to record, of `total`; then wait for all other processes.

    Chunks that the folder has are left out. Of those that are missing, process k of N records each N-th, from the k-th
    on. Their content depends on their number only, never on the process.
    """
    missing = distributed.share(f"{writer.folder}: start", lambda: writer.missing(total))
    yield distributed.deal(missing)
    distributed.wait(f"{writer.folder}: end")
    distributed.await_files(episodes.chunk_paths(writer.folder, missing))


def is_recorded(folder: Path, robots: int) -> bool:
    """Return whether a folder of `record_rollouts` has all batches of this number of robots."""
    return episodes.count_chunks(folder) >= count_batches(robots)


def count_batches(robots: int) -> int:
    """Return the number of batches in which some robots are rolled out.

    >>> count_batches(4), count_batches(16), count_batches(40)
    (1, 1, 3)
    """
    return -(-robots // _batch_size(robots))


def _batch_size(robots: int) -> int:
    """Return the smallest of `BATCH_SIZES` that holds all robots, or the largest."""
    return next((size for size in BATCH_SIZES if robots <= size), BATCH_SIZES[-1])


def record_benchmark(
    folder: Path,
    params: closed_loop.Params,
    benchmark: BenchmarkRooms,
    policy: policies.Policy,
    seed: int,
    *,
    label: str,
    render: bool | None = None,
    contrast: float = 1.0,
) -> closed_loop.Record:
    """Record a policy in the benchmark rooms of a study, which are the same for the same seed.

    Args:
        folder: where to write.
        params: the robot.
        benchmark: how many rooms, and for how long.
        policy: the policy to roll out.
        seed: the seed of the rooms.
        label: of the progress bar.
        render: whether to render the cameras; if None, only for policies that use them.
        contrast: factor for the contrast of all textures.
    """
    rooms = benchmark_rooms(benchmark, seed, contrast)
    parameters = {
        "benchmark": asdict(benchmark),
        "policy": policy.name,
        "contrast": contrast,
        "robot": fingerprint(params),
    }
    return record_rollouts(
        folder, params, rooms, benchmark.seconds, policy, seed=seed, parameters=parameters, label=label, render=render
    )
