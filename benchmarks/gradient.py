"""What a gradient through the whole loop costs: eyes, network, legs, body and back, beside the walk alone.

    python benchmarks/gradient.py [--robots 1 16 64] [--frames 1 30]

The robot that comes along walks in random rooms, its thresholds smooth, its pictures of 80 x 60. Timed, a robot and
frame, are the walk, its loss and nothing else; `imitation.gradient`, which walks each frame again on the way back
(remat); and the same with what a frame computes outside its physics steps kept instead. All windows are of the longest
of `--frames`, and the middle of the crowds takes the shorter ones too. Memory is what XLA sets aside for a program's
own use.

Beside it what one would do without reverse mode: a slope in one direction by forward mode, and differences to both
sides of every number that can be tuned, which are not run: each is two walks, and walks are timed.

Every program is compiled in a process of its own, with a cache that is empty before, and run there. The gradient of the
longest window is then compiled once more by another process, which finds it in the cache.
"""

import math
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from multiprocessing import get_context
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from mujoco import mjx

from lgmdjax.body import hexapod
from lgmdjax.control import controller, policies
from lgmdjax.learning import finetuning, rollout_gradient
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches, sharding

Kind = Literal["walk", "remat", "kept", "forward mode"]
EYES = CameraSettings(width=80, height=60, pooling=3)
ASKED = 5.0  # walks that a gradient with remat may cost
ASKED_COLD, ASKED_WARM = 180.0, 15.0  # s of its compilation
REPEATS = 3


@dataclass(frozen=True, kw_only=True)
class Case:
    """A program: what it does, for how many robots and frames, with open eyes or not."""

    kind: Kind
    robots: int
    frames: int
    draw: bool


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a program costs."""

    trace: float  # s, in Python
    compile: float  # s, in XLA
    memory: float  # MB a robot and frame
    run: float  # ms a robot and frame, median; NaN if it does not fit into half of the machine's memory
    tunable: int  # numbers that the gradient is taken of


def measure(case: Case, cache: str) -> Cost:
    """Compile a program with the cache in a folder, and run it; for a process in which JAX has done nothing yet."""
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # crowds on all cores, as from the command line
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    robot, model, rooms, states, sizes = crowd(case.robots)
    settings = rollout_gradient.Settings(frames=case.frames, draw=case.draw, remat=case.kind != "kept")
    began = time.perf_counter()
    lowered = program(case.kind).lower(robot, model, rooms, states, sizes, settings=settings)
    traced = time.perf_counter()
    compiled = lowered.compile()
    ready = time.perf_counter()
    analysis, work = compiled.memory_analysis(), case.robots * case.frames
    # Not every device tells; what it tells is its own share.
    memory = analysis.temp_size_in_bytes * sharding.shares(case.robots) if analysis else math.nan
    fits = not memory > os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2
    seconds = timed(lambda states: compiled(robot, model, rooms, states, sizes), states) if fits else math.nan
    leaves = zip(*map(jax.tree.leaves, (robot.controller, sizes)), strict=True)
    return Cost(
        trace=traced - began,
        compile=ready - traced,
        memory=memory / work / 1e6,
        run=1e3 * seconds / work,
        tunable=sum(leaf.size for leaf, size in leaves if jnp.any(size > 0)),
    )


def crowd(robots: int) -> tuple[closed_loop.Params, mjx.Model, closed_loop.Room, closed_loop.State, controller.Params]:
    """Put robots into rooms; give what `imitation.gradient` takes, everything that can be tuned being tuned."""
    robot = rollout_gradient.smooth(rollout_gradient.alone(assembly.with_eyes(assembly.trained(), EYES)))
    model, rooms = hexapod.build(), room_batches.random_rooms(jax.random.key(0), robots)
    states = rollout.start(robot, model, rooms, driver=policies.LEARNED)
    return robot, model, rooms, states, finetuning.sizes(robot.controller, tuple(vars(robot.controller)))


def timed(
    advance: Callable[[closed_loop.State], tuple[Any, closed_loop.State, Any]], states: closed_loop.State
) -> float:
    """Take the median seconds of a window, walking on from each to the next; the first is thrown away."""
    seconds = []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        _, states, _ = jax.block_until_ready(advance(states))
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds[1:])


def program(kind: Kind) -> Any:
    """Choose what is compiled: all take and give what `imitation.gradient` does."""
    if kind in ("remat", "kept"):
        return rollout_gradient.gradient

    @partial(jax.jit, static_argnames="settings", donate_argnames="states")
    def window(
        params: closed_loop.Params,
        model: mjx.Model,
        rooms: closed_loop.Room,
        states: closed_loop.State,
        sizes: controller.Params,
        *,
        settings: rollout_gradient.Settings,
    ) -> Any:
        def share(rooms: closed_loop.Room, states: closed_loop.State) -> Any:
            robots = rooms.starts.shape[0]

            def losses(nerves: controller.Params) -> Any:
                return rollout_gradient.losses(nerves, params, model, rooms, states, settings)

            def frame(room: closed_loop.Room, state: closed_loop.State, _: None) -> Any:
                return closed_loop.step(params, model, room, state, policies.LEARNED, settings.draw)

            if kind == "walk":  # by the same nerves for all
                after, record = rollout.march(frame, rooms, states, length=settings.frames)
                return jnp.mean((record.velocity - record.label) ** 2, axis=(1, 2)), (after, record)
            nerves = rollout_gradient.each_its_own(params.controller, robots)
            along = jax.tree.map(lambda size, leaf: jnp.broadcast_to(size, jnp.shape(leaf)), sizes, params.controller)
            value, slope, rest = jax.jvp(
                losses, (nerves,), (rollout_gradient.each_its_own(along, robots),), has_aux=True
            )
            return (value, slope), rest

        found, (states, record) = sharding.deal(share, rooms, states)
        return found, states, record

    return window


def apart(case: Case, cache: str | None = None) -> Cost:
    """Measure in a new process; with an empty cache if none is given."""
    with (
        tempfile.TemporaryDirectory() as empty,
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process,
    ):
        return process.submit(measure, case, cache or empty).result()


def grown(robots: tuple[int, ...], frames: tuple[int, ...], draw: bool, cache: str) -> dict[Case, Cost]:
    """Print a line for each crowd and window; give the costs in the longest window of the middle crowd."""
    middle, longest = robots[len(robots) // 2], max(frames)
    sizes = [(middle, some) for some in frames if some != longest] + [(crowd, longest) for crowd in robots]
    central: dict[Case, Cost] = {}
    print("robots  frames | walk [ms]  gradient  ratio  kept  ratio | walk [MB]  gradient   kept | trace + compile [s]")
    for crowd, length in sizes:
        cases = [Case(kind=kind, robots=crowd, frames=length, draw=draw) for kind in ("walk", "remat", "kept")]
        is_central = (crowd, length) == (middle, longest)
        walk, remat = apart(cases[0]), apart(cases[1], cache if is_central else None)
        kept = apart(cases[2]) if crowd == middle else replace(walk, memory=math.nan, run=math.nan)
        if is_central:
            central = dict(zip(cases, (walk, remat, kept), strict=True))
        print(
            f"{crowd:6d}  {length:6d} | {walk.run:9.2f}  {remat.run:8.2f}  {remat.run / walk.run:5.2f}"
            f"  {kept.run:4.1f}  {kept.run / walk.run:5.2f} | {walk.memory:9.3f}  {remat.memory:8.3f}"
            f"  {kept.memory:5.2f} | {remat.trace:.0f} + {remat.compile:.0f}",
            flush=True,
        )
    return central


def main(robots: tuple[int, ...] = (1, 16, 64), frames: tuple[int, ...] = (1, 30), draw: bool = True) -> None:
    """Print how cost grows, what else one could do, and how long one waits for the compiler.

    Args:
        robots: crowds
        frames: windows
        draw: what the eyes see; without, the gradient is through legs, body and network alone
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # for the processes: XLA calls its own tuning flags errors
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco-mjx"))
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {load}; {versions}")
    with tempfile.TemporaryDirectory() as cache:
        (_, walk), (case, remat), _ = grown(robots, frames, draw, cache).items()
        again = apart(case, cache)
    forward = apart(replace(case, kind="forward mode"))
    differences = 2 * walk.tunable * walk.run
    print(f"asked: a gradient for {ASKED:g} walks\n\n{case.robots} robots, {case.frames} frames, in walks:")
    for name, spent in (
        (f"gradient, of {walk.tunable} numbers", remat.run),
        ("forward mode, in one direction", forward.run),
        ("differences, for the gradient", differences),
    ):
        print(f"  {name:30s}  {spent / walk.run:9.2f}  {spent / remat.run:8.2f} gradients")
    print()
    for name, cost, asked in (("cold", remat, ASKED_COLD), ("from the cache", again, ASKED_WARM)):
        seconds = f"{cost.trace + cost.compile:.0f} s ({cost.trace:.0f} s of them tracing)"
        print(f"gradient compiled {name}: {seconds}; asked: {asked:g} s")


if __name__ == "__main__":
    tyro.cli(main)
