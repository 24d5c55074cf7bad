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
from jaxtyping import Array, Bool
from mujoco import mjx

from lgmdjax.control.policies import Driver
from lgmdjax.simulation import closed_loop
from lgmdjax.simulation.closed_loop import Params, Record, Room, State
from lgmdjax.simulation.sharding import deal


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
        return closed_loop.step(params, model, room, state, driver, draw)

    return jax.lax.scan(frame, state, length=frames)


@partial(jax.jit, static_argnames="driver")
def start(params: Params, model: mjx.Model, rooms: Room, *, driver: Driver) -> State:
    """Put one robot into each room of a batch."""
    return deal(jax.vmap(lambda room: closed_loop.init(params, model, room, driver)), rooms)


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
        return closed_loop.step(params, model, room, state, driver, draw)

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
    frames = max(1, round(chunk_seconds * closed_loop.FRAME_RATE))
    total = round(seconds * closed_loop.FRAME_RATE)
    states = start(params, model, rooms, driver=driver)
    for done in range(0, total, frames):
        states, record = advance(params, model, rooms, states, driver=driver, frames=frames, draw=draw)
        yield jax.tree.map(lambda leaf, left=total - done: np.asarray(leaf)[:, :left], record)


def together(records: list[Record]) -> Record:
    """Join the chunks of one walk along their frames."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *records)
