"""Rollouts: many frames, many robots. The only place that scans and maps the closed loop.

| function         | what it runs                                                                              |
| ---------------- | ----------------------------------------------------------------------------------------- |
| `rollout`        | `closed_loop.step` scanned over frames, for one robot                                     |
| `rollout_batch`  | the same for a batch of robots, sharded over devices (`lgmdjax.simulation.sharding`)      |
| `rollout_chunks` | that in chunks of a few seconds, so that the host can show progress, write, or stop       |
| `scan_batch`     | any step of one robot, scanned and mapped, such as one that renders recorded walks again  |

On the command line and in notebooks use `lgmdjax.simulation.recording.rollout`.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from lgmdjax.control.policies import Policy
from lgmdjax.runtime.export_cache import cached_jit
from lgmdjax.runtime.mjx import mjx
from lgmdjax.simulation import closed_loop, finite
from lgmdjax.simulation.closed_loop import Params, Record, Room, State
from lgmdjax.simulation.sharding import shard_robots

RoomT = TypeVar("RoomT")
StateT = TypeVar("StateT")
InputT = TypeVar("InputT")
OutputT = TypeVar("OutputT")


def rollout(
    params: Params,
    model: mjx.Model,
    room: Room,
    state: State,
    policy: Policy,
    *,
    frames: int,
    render: Bool[Array, ""] | bool = True,
) -> tuple[State, Record]:
    """Roll out one robot for a static number of frames; the record has a leading axis of frames."""

    def frame(state: State, _: None) -> tuple[State, Record]:
        return closed_loop.step(params, model, room, state, policy, render=render)

    return jax.lax.scan(frame, state, length=frames)


@partial(jax.jit, static_argnames="policy")
def reset_batch(params: Params, model: mjx.Model, rooms: Room, *, policy: Policy) -> State:
    """Return the initial states of a batch of robots, one in each room."""
    return shard_robots(jax.vmap(lambda room: closed_loop.init(params, model, room, policy)), rooms)


@partial(cached_jit, donate_argnames=("states",))
def rollout_batch(
    params: Params,
    model: mjx.Model,
    rooms: Room,
    states: State,
    render: Bool[Array, ""] | bool,
    *,
    policy: Policy,
    frames: int,
) -> tuple[State, Record]:
    """Roll out a batch of robots, each in its own room; the record's axes are (robot, frame).

    One program serves rollouts with and without pictures, and is cached on disk.
    """

    def step(room: Room, state: State, _: None) -> tuple[State, Record]:
        return closed_loop.step(params, model, room, state, policy, render=render)

    return shard_robots(lambda rooms, states: scan_batch(step, rooms, states, length=frames), rooms, states)


def scan_batch(
    step: Callable[[RoomT, StateT, InputT], tuple[StateT, OutputT]],
    rooms: RoomT,
    states: StateT,
    inputs: InputT = None,
    *,
    length: int | None = None,
) -> tuple[StateT, OutputT]:
    """Scan `step(room, state, input)` of one robot over frames, mapped over robots; return last states and outputs.

    Inputs and outputs have axes (robot, frame). A `vmap` of a `lax.scan` gives the same results, but then JAX traces
    the loop body several more times to find out what differs between robots; tracing a rollout takes a third longer.
    """

    def frame(states: StateT, inputs: InputT) -> tuple[StateT, OutputT]:
        return jax.vmap(step)(rooms, states, inputs)

    states, outputs = jax.lax.scan(frame, states, _swap_axes(inputs), length=length)
    return states, _swap_axes(outputs)


def _swap_axes(series: OutputT) -> OutputT:
    """Exchange the axes of robots and frames."""
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), series)


def rollout_chunks(
    params: Params,
    model: mjx.Model,
    rooms: Room,
    policy: Policy,
    seconds: float,
    *,
    render: bool = True,
    chunk_seconds: float = 5.0,
) -> Iterator[Record]:
    """Roll out a batch of robots for `seconds`, yielding NumPy records of `chunk_seconds` one after the other.

    One program is compiled for all chunks; the last one may run past the end and is cut. In a frame that is
    not finite in every field, `ok` is false and such numbers are zero (`lgmdjax.simulation.finite`).
    """
    frames = max(1, round(chunk_seconds * closed_loop.FRAME_RATE))
    total = round(seconds * closed_loop.FRAME_RATE)
    states = reset_batch(params, model, rooms, policy=policy)
    for done in range(0, total, frames):
        states, record = rollout_batch(params, model, rooms, states, render, policy=policy, frames=frames)
        chunk = jax.tree.map(lambda leaf, left=total - done: np.asarray(leaf)[:, :left], record)
        yield finite.flag_nonfinite(chunk)


def concatenate_time(records: list[Record]) -> Record:
    """Concatenate the chunks of one rollout along the axis of frames."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *records)
