"""TODO docstring."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np
from mujoco import mjx
from tqdm import tqdm

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.simulation import closed_loop, episodes, rollout
from lgmdjax.simulation.assembly import digest, seat
from lgmdjax.simulation.room_batches import bench_rooms
from lgmdjax.simulation.settings import BenchmarkRooms


def walks(
    params: closed_loop.Params,
    model: mjx.Model,
    rooms: closed_loop.Room,
    seconds: float,
    label: str,
    *,
    draw: bool = True,
) -> Iterator[closed_loop.Record]:
    """Walk a crowd and yield its chunks, with a bar of robot-seconds; the first chunk waits for the compiler."""
    robots = rooms.starts.shape[0]
    print(f"{label}: compiling the simulation, then {robots} robots for {seconds:g} s each", flush=True)
    chunks = rollout.chunks(params, model, rooms, policies.ANYONE, seconds, draw=draw, chunk_seconds=CHUNK)
    # Frames are counted, which are whole: sums of seconds come out beyond the total.
    frames, second = robots * round(seconds * closed_loop.FRAME_RATE), 1 / closed_loop.FRAME_RATE
    with tqdm(total=frames, desc=label, unit="robot-s", unit_scale=second, bar_format=BAR) as bar:
        for chunk in chunks:
            bar.update(chunk.time.size)
            yield chunk


def crowds(
    params: closed_loop.Params,
    model: mjx.Model,
    rooms: closed_loop.Room,
    seconds: float,
    label: str,
    *,
    draw: bool = True,
    done: int = 0,
) -> Iterator[tuple[list[int], closed_loop.Record]]:
    """Walk any number of robots, `CROWD` at once, so that one program serves all; yield their numbers and their walks.

    The last crowd is filled up with its last robot, which is left out again. `done` crowds are skipped.
    """
    robots = rooms.starts.shape[0]
    size = min(CROWD, robots)
    for first in range(done * size, robots, size):
        present = list(range(first, min(first + size, robots)))
        filled = np.minimum(np.arange(first, first + size, dtype=np.int32), robots - 1)
        some = jax.tree.map(lambda leaf, filled=filled: leaf[filled], rooms)
        part = f"{label}, {first + 1} to {present[-1] + 1} of {robots}"
        record = rollout.together(list(walks(params, model, some, seconds, part, draw=draw)))
        yield present, jax.tree.map(lambda leaf, present=present: leaf[: len(present)], record)


def walked(
    folder: Path,
    params: closed_loop.Params,
    rooms: closed_loop.Room,
    seconds: float,
    driver: policies.Driver,
    *,
    seed: int,
    facts: Mapping[str, Any],
    label: str,
    draw: bool | None = None,
) -> closed_loop.Record:
    """Walk a driver through rooms and keep the walks in a folder, a file a crowd; after those that are there already.

    Args:
        facts: JSON values that tell this walk from others; a folder of other walks is refused.
        seed: that the rooms were drawn with. label: for the progress bar.
        draw: what the eyes see; for drivers that look if None.
    """
    writer = episodes.Writer(folder, facts)
    looks = driver in (policies.LEARNED, policies.DIRECT) if draw is None else draw
    walks = crowds(
        seat(params, driver), hexapod.build(), rooms, seconds, f"{label}: {driver.name}", draw=looks, done=writer.chunks
    )
    for numbers, record in walks:
        writer.write(record, episode=writer.chunks, rooms=numbers, seed=seed)
    return episodes.batched(episodes.read(folder))


def has_walked(folder: Path, robots: int) -> bool:
    """Tell whether all crowds of so many robots are in a folder of `walked`."""
    return len(list(folder.glob("chunk-*.parquet"))) * min(CROWD, robots) >= robots


def benched(
    folder: Path,
    params: closed_loop.Params,
    bench: BenchmarkRooms,
    driver: policies.Driver,
    seed: int,
    *,
    label: str,
    draw: bool | None = None,
    contrast: float = 1.0,
) -> closed_loop.Record:
    """Walk a driver through the rooms in which robots of a study are compared, the same for the same seed.

    Args:
        folder: as in `walked`, and so are `label` and `draw`. bench: how many rooms, and how long.
        contrast: of all textures, by which theirs is multiplied.
    """
    rooms = bench_rooms(bench, seed, contrast)
    facts = {"bench": asdict(bench), "driver": driver.name, "contrast": contrast, "robot": digest(params)}
    return walked(folder, params, rooms, bench.seconds, driver, seed=seed, facts=facts, label=label, draw=draw)


CROWD = 16


CHUNK = 5.0  # s of robot time between two signs of life


BAR = "{desc}: {percentage:3.0f} % |{bar}| {n:.0f}/{total:.0f} robot-s [{elapsed}<{remaining}, {rate_fmt}]"
