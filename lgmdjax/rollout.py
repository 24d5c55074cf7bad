"""Many frames, many robots: the one place that scans and maps.

`walk` scans `simulation.step` over frames for one robot, `advance` scans and maps it for a batch of rooms, and `chunks`
does that for a few seconds of robot time at once, so that a host can show progress, write what came, and be
interrupted between two. `march` scans and maps any step of one robot, for those who look at recorded walks again.

The robots of a batch are dealt out to the devices (`deal`). A core of a CPU is one if `JAX_NUM_CPU_DEVICES` says so
before JAX starts, as the command line does: a body is many small sums in a row, which cores cannot share, but robots
are apart.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from lgmdjax import scenes, simulation
from lgmdjax.arena import Arena, free_poses
from lgmdjax.drivers import Driver
from lgmdjax.simulation import Params, Record, Room, State


def walk(
    params: Params,
    model: mjx.Model,
    room: Room,
    state: State,
    driver: Driver,
    frames: int,
    draw: Bool[Array, ""] | bool = True,
) -> tuple[State, Record]:
    """Walk one robot for a static number of frames; the record has a leading axis of frames."""

    def frame(state: State, _: None) -> tuple[State, Record]:
        return simulation.step(params, model, room, state, driver, draw)

    return jax.lax.scan(frame, state, length=frames)


@partial(jax.jit, static_argnames="driver")
def start(params: Params, model: mjx.Model, rooms: Room, *, driver: Driver) -> State:
    """Put one robot into each room of a batch."""
    return deal(jax.vmap(lambda room: simulation.init(params, model, room, driver)), rooms)


@partial(jax.jit, static_argnames=("driver", "frames"), donate_argnames="states")
def advance(
    params: Params,
    model: mjx.Model,
    rooms: Room,
    states: State,
    *,
    driver: Driver,
    frames: int,
    draw: Bool[Array, ""] | bool,
) -> tuple[State, Record]:
    """Walk a batch of robots, each in its own room; the record's axes are (robot, frame)."""

    def step(room: Room, state: State, _: None) -> tuple[State, Record]:
        return simulation.step(params, model, room, state, driver, draw)

    return deal(lambda rooms, states: march(step, rooms, states, length=frames), rooms, states)


def march(
    step: Callable[[Any, Any, Any], tuple[Any, Any]],
    rooms: Any,
    states: Any,
    series: Any = None,
    *,
    length: int | None = None,
) -> tuple[Any, Any]:
    """Scan `step(room, state, row)` of one robot over frames, mapped over robots; gives the last states and what came.

    `series` and what comes out have axes (robot, frame). A `vmap` of a `lax.scan` gives the same, but JAX traces the
    body of the loop some more times then, to find out what differs between robots: for a walk a third longer in all.
    """

    def frame(states: Any, rows: Any) -> tuple[Any, Any]:
        return jax.vmap(step)(rooms, states, rows)

    states, out = jax.lax.scan(frame, states, _swapped(series), length=length)
    return states, _swapped(out)


def _swapped(series: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), series)


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


def chunks(
    params: Params,
    model: mjx.Model,
    rooms: Room,
    driver: Driver,
    seconds: float,
    *,
    draw: bool = True,
    chunk_seconds: float = 5.0,
) -> Iterator[Record]:
    """Walk a batch of robots for `seconds`, yielding host records of `chunk_seconds` as they come.

    One program is compiled for all chunks: the last one may walk on past the end, and is cut.
    """
    frames = max(1, round(chunk_seconds * simulation.FRAME_RATE))
    total = round(seconds * simulation.FRAME_RATE)
    states = start(params, model, rooms, driver=driver)
    for done in range(0, total, frames):
        states, record = advance(params, model, rooms, states, driver=driver, frames=frames, draw=draw)
        yield jax.tree.map(lambda leaf, left=total - done: np.asarray(leaf)[:, :left], record)


def together(records: list[Record]) -> Record:
    """Join the chunks of one walk along their frames."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *records)


STARTS = 32  # places where a room's robot is put down, one after the other


@partial(jax.jit, static_argnames="count")
def random_rooms(key: Array, count: int, density: Float[Array, ""] | float = 0.15) -> Room:
    """Draw rooms that a key alone decides, each with its starts; the same key and index give the same room."""

    def room(key: Array) -> Room:
        arena_key, starts_key, luck = jax.random.split(key, 3)
        arena = scenes.random_room(arena_key, density)
        return Room(arena=arena, starts=free_poses(starts_key, arena, STARTS), key=luck)

    return jax.vmap(lambda index: room(jax.random.fold_in(key, index)))(jnp.arange(count))


@partial(jax.jit, static_argnames="count")
def copies(key: Array, arena: Arena, count: int, spread: Float[Array, ""] | float = jnp.pi) -> Room:
    """Give every robot of a crowd the same room: first its own start, turned by up to `spread`, then free ones."""

    def room(key: Array) -> Room:
        turn_key, starts_key, luck = jax.random.split(key, 3)
        turn = jnp.asarray([0, 0, 1]) * jax.random.uniform(turn_key, minval=-spread, maxval=spread)
        later = free_poses(starts_key, arena, STARTS - 1)
        return Room(arena=arena, starts=jnp.concatenate([(arena.start + turn)[None], later]), key=luck)

    return jax.vmap(lambda index: room(jax.random.fold_in(key, index)))(jnp.arange(count))


def stack(rooms: list[Room]) -> Room:
    """Batch rooms of one padding, so that every robot has its own."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)


def join(first: Room, second: Room) -> Room:
    """Put two batches of rooms together."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)
