"""What the stages share: one robot put together from the files of a run, and walks of a crowd with a progress bar."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx
from tqdm import tqdm

from lgmdjax import (
    braitenberg,
    camera,
    drivers,
    episodes,
    hexapod,
    lgmd,
    navigator,
    rollout,
    scales,
    scenes,
    shaping,
    simulation,
)
from lgmdjax.errors import InputError
from lgmdjax.files import read_arrays
from lgmdjax.paths import PRETRAINED


def eyes(settings: scales.Eyes) -> camera.Params:
    """Set up the stereo camera of a run."""
    return camera.Params(width=settings.width, height=settings.height, overlap=settings.overlap)


def robot(gait: Path, settings: scales.Eyes, detector: lgmd.Params, crew: drivers.Anyone) -> simulation.Params:
    """Put a robot together: the gait that was fitted, the eyes of the run, and anyone at the wheel."""
    networks = shaping.load(gait / "shaping.safetensors")
    params = simulation.assemble(crew, detector=detector, networks=networks, eyes=eyes(settings))
    return with_eyes(params, settings)


def trained(gait: Path = PRETRAINED, train: Path = PRETRAINED) -> simulation.Params:
    """Put a robot together from two folders, all five drivers aboard, with the eyes that its navigator learned from.

    Args:
        gait: the folder of stage fit-gait. train: that of stage train. Left out, it is the robot that comes along.

    Raises InputError if a folder has not what the stage writes.
    """
    learned, header = navigator.load(train / "controller.safetensors")
    baselines = read_arrays(train / "baselines.npz")
    try:
        crew = everyone(learned, float(baselines["gain"]), baselines["replayed"])
        return robot(gait, scales.Eyes(**header["eyes"]), lgmd.Params(**header["lgmd"]), crew)
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{train}: expected a navigator and baselines as `lgmdjax train` leaves them, got {error}; train again"
        ) from error


def with_eyes(params: simulation.Params, settings: scales.Eyes) -> simulation.Params:
    """Give a robot other eyes; whose cells look at as much of the world say nearly the same."""
    detector = replace(params.controller.lgmd, pooling=settings.pooling)
    return replace(params, camera=eyes(settings), controller=replace(params.controller, lgmd=detector))


def everyone(
    learned: navigator.Params | None = None, gain: float = 0.0, replayed: np.ndarray | None = None
) -> drivers.Anyone:
    """Seat all five drivers, the teacher at the wheel; those that nothing is known of yet are stand-ins.

    Args:
        learned: the trained navigator. gain: of the direct driver [1/m].
        replayed: `REPLAY` commands of the teacher for the random driver.
    """
    teacher = braitenberg.Params()
    straight = jnp.full(2, teacher.base, dtype=float)
    commands = jnp.broadcast_to(straight, (REPLAY, 2)) if replayed is None else jnp.asarray(replayed, dtype=float)
    return drivers.Anyone(
        seat=jnp.asarray(0),
        drivers=(
            teacher,
            navigator.create(jax.random.key(0), symmetric=True) if learned is None else learned,
            drivers.Blind(velocity=straight),
            drivers.Direct(rule=teacher, gain=jnp.asarray(gain, dtype=float)),
            drivers.Replay(velocities=commands),
        ),
    )


REPLAY = 4096  # commands of the random driver; a static number, so that one compiled program serves all stages


def manned(params: simulation.Params, driver: Any) -> simulation.Params:
    """Exchange one of a robot's five drivers, the one whose parameters are of the same type."""
    crew = params.controller.driver
    five = tuple(driver if isinstance(one, type(driver)) else one for one in crew.drivers)
    return replace(params, controller=replace(params.controller, driver=replace(crew, drivers=five)))


def rooms_of(seed: int, episode: int, robots: int) -> simulation.Room:
    """Draw the rooms of an episode to learn in, the same for the same seed and number, of every contrast.

    A robot that has learned in busy rooms only hardly turns from the one thing that moves before a plain wall. Where
    little moves, little is much; it has to be met to be learned.
    """
    key = jax.random.fold_in(jax.random.key(seed), episode)
    rooms = rollout.random_rooms(key, robots)
    contrast = jax.random.uniform(jax.random.fold_in(key, robots), (robots,), jnp.float32, *CONTRAST)
    return replace(rooms, arena=jax.vmap(scenes.faded)(rooms.arena, contrast))


def seat(params: simulation.Params, driver: drivers.Driver) -> simulation.Params:
    """Put one of the drivers at the wheel."""
    crew = replace(params.controller.driver, seat=jnp.asarray(drivers.ALL.index(driver)))
    return replace(params, controller=replace(params.controller, driver=crew))


def walks(
    params: simulation.Params,
    model: mjx.Model,
    rooms: simulation.Room,
    seconds: float,
    label: str,
    *,
    draw: bool = True,
) -> Iterator[simulation.Record]:
    """Walk a crowd and yield its chunks, with a bar of robot-seconds; the first chunk waits for the compiler."""
    robots = rooms.starts.shape[0]
    print(f"{label}: compiling the simulation, then {robots} robots for {seconds:g} s each", flush=True)
    chunks = rollout.chunks(params, model, rooms, drivers.ANYONE, seconds, draw=draw, chunk_seconds=CHUNK)
    # Frames are counted, which are whole: sums of seconds come out beyond the total.
    frames, second = robots * round(seconds * simulation.FRAME_RATE), 1 / simulation.FRAME_RATE
    with tqdm(total=frames, desc=label, unit="robot-s", unit_scale=second, bar_format=BAR) as bar:
        for chunk in chunks:
            bar.update(chunk.time.size)
            yield chunk


def crowds(
    params: simulation.Params,
    model: mjx.Model,
    rooms: simulation.Room,
    seconds: float,
    label: str,
    *,
    draw: bool = True,
    done: int = 0,
) -> Iterator[tuple[list[int], simulation.Record]]:
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
    params: simulation.Params,
    rooms: simulation.Room,
    seconds: float,
    driver: drivers.Driver,
    *,
    seed: int,
    facts: Mapping[str, Any],
    label: str,
    draw: bool | None = None,
) -> simulation.Record:
    """Walk a driver through rooms and keep the walks in a folder, a file a crowd; after those that are there already.

    Args:
        facts: JSON values that tell this walk from others; a folder of other walks is refused.
        seed: that the rooms were drawn with. label: for the progress bar.
        draw: what the eyes see; for drivers that look if None.
    """
    writer = episodes.Writer(folder, facts)
    looks = driver in (drivers.LEARNED, drivers.DIRECT) if draw is None else draw
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
    params: simulation.Params,
    bench: scales.Bench,
    driver: drivers.Driver,
    seed: int,
    *,
    label: str,
    draw: bool | None = None,
    contrast: float = 1.0,
) -> simulation.Record:
    """Walk a driver through the rooms in which robots of a study are compared, the same for the same seed.

    Args:
        folder: as in `walked`, and so are `label` and `draw`. bench: how many rooms, and how long.
        contrast: of all textures, by which theirs is multiplied.
    """
    rooms = bench_rooms(bench, seed, contrast)
    facts = {"bench": asdict(bench), "driver": driver.name, "contrast": contrast, "robot": digest(params)}
    return walked(folder, params, rooms, bench.seconds, driver, seed=seed, facts=facts, label=label, draw=draw)


def bench_rooms(bench: scales.Bench, seed: int, contrast: float = 1.0) -> simulation.Room:
    """Draw the rooms of `benched`."""
    rooms = rollout.random_rooms(jax.random.fold_in(jax.random.key(seed), BENCH), bench.robots)
    return replace(rooms, arena=jax.vmap(scenes.faded, in_axes=(0, None))(rooms.arena, contrast))


def digest(params: simulation.Params) -> str:
    """Tell a robot from any other."""
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params)]
    structure = repr((params.camera, jax.tree.structure(params))).encode()
    return hashlib.sha256(b"".join(leaves) + structure).hexdigest()[:16]


BENCH = 2**23  # number of an episode far from any other: its rooms are met nowhere else
CONTRAST = (0.3, 1.0)  # of a room to learn in, times what it is drawn with
CROWD = 16
CHUNK = 5.0  # s of robot time between two signs of life
BAR = "{desc}: {percentage:3.0f} % |{bar}| {n:.0f}/{total:.0f} robot-s [{elapsed}<{remaining}, {rate_fmt}]"
