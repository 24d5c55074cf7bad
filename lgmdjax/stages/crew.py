"""What the stages share: one robot put together from the files of a run, and walks of a crowd with a progress bar."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx
from tqdm import tqdm

from lgmdjax import (
    braitenberg,
    camera,
    drivers,
    lgmd,
    navigator,
    rollout,
    scales,
    shaping,
    simulation,
)
from lgmdjax.files import read_arrays

DATA = Path(__file__).parent.parent / "data"


def eyes(settings: scales.Eyes) -> camera.Params:
    """Set up the stereo camera of a run."""
    return camera.Params(width=settings.width, height=settings.height, overlap=settings.overlap)


def robot(gait: Path, settings: scales.Eyes, detector: lgmd.Params, crew: drivers.Anyone) -> simulation.Params:
    """Put a robot together: the gait that was fitted, the eyes of the run, and anyone at the wheel."""
    networks = shaping.load(gait / "shaping.safetensors")
    return simulation.assemble(crew, detector=detector, networks=networks, eyes=eyes(settings))


def trained(run: Path | None) -> simulation.Params:
    """Put the robot of a run together, all five drivers aboard, with the eyes that its navigator learned from.

    Raises InputError if the run has not been trained; None stands for the robot that comes with the package.
    """
    gait, train = (run / "fit-gait", run / "train") if run else (DATA, DATA)
    learned, header = navigator.load(train / "controller.safetensors")
    baselines = read_arrays(train / "baselines.npz")
    crew = everyone(learned, float(baselines["gain"]), baselines["replayed"])
    return robot(gait, scales.Eyes(**header["eyes"]), lgmd.Params(**header["lgmd"]), crew)


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
            navigator.create(jax.random.key(0)) if learned is None else learned,
            drivers.Blind(velocity=straight),
            drivers.Direct(rule=teacher, gain=jnp.asarray(gain, dtype=float)),
            drivers.Replay(velocities=commands),
        ),
    )


REPLAY = 4096  # commands of the random driver; a static number, so that one compiled program serves all stages


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
    with tqdm(total=robots * seconds, desc=label, unit="robot-s", bar_format=BAR) as bar:
        for chunk in chunks:
            bar.update(chunk.time.size / simulation.FRAME_RATE)
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


CROWD = 16
CHUNK = 5.0  # s of robot time between two signs of life
BAR = "{desc}: {percentage:3.0f} % |{bar}| {n:.0f}/{total:.0f} robot-s [{elapsed}<{remaining}, {rate_fmt}]"
