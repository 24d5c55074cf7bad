"""Time and memory of the gradient through the closed loop, compared with those of the rollout alone.

    python benchmarks/gradient.py [--robots 1 16 64] [--frames 1 30]

The pretrained robot walks in random rooms, with smooth thresholds and pictures of 80 x 60 pixels.

| program      | what it computes                                                                                |
| ------------ | ----------------------------------------------------------------------------------------------- |
| rollout      | a window of frames, and its loss                                                                |
| remat        | `rollout_gradient.gradient`, which computes each frame again in the backward pass               |
| stored       | the same, but what a frame computes outside the physics is stored for the backward pass         |
| forward mode | the derivative of the loss in one direction                                                     |

Every batch size is measured with the longest window of `--frames`, the middle one with the shorter windows too. Times
and memory are per robot and frame; memory is the temporary memory of the XLA program. Central differences for every
parameter are not run: each takes two rollouts, which are timed.

Every program is compiled and run in a process of its own with an empty cache. The gradient of the longest window is
compiled a second time by another process, which finds it in the cache.
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
from typing import Literal, Protocol

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import PyTree

from lgmdjax.body import hexapod
from lgmdjax.control import controller, policies
from lgmdjax.learning import finetuning, rollout_gradient
from lgmdjax.runtime.mjx import mjx
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches, sharding

Kind = Literal["rollout", "remat", "stored", "forward mode"]
CAMERA = CameraSettings(width=80, height=60, pooling=3, ground=0.5, falloff=2.0)
TARGET = 5.0  # rollouts that take as long as a gradient with remat
TARGET_COLD, TARGET_WARM = 180.0, 15.0  # s, compilation of the gradient
REPEATS = 3


@dataclass(frozen=True, kw_only=True)
class Case:
    """A program, the size of its batch and window, and whether the cameras render."""

    kind: Kind
    robots: int
    frames: int
    render: bool


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Time and memory of a program."""

    trace: float  # s, in Python
    compile: float  # s, in XLA
    memory: float  # MB for each robot and frame
    run: float  # ms for each robot and frame, median; NaN if it does not fit into half of the machine's memory
    parameters: int  # in the gradient


def measure(case: Case, cache: str) -> Cost:
    """Compile and run a program, with the compilation cache in a folder; the process must not have used JAX before."""
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # batches use all cores, as in the command line
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    robot, model, rooms, states, scales = make_inputs(case.robots)
    settings = rollout_gradient.Settings(frames=case.frames, render=case.render, remat=case.kind != "stored")
    began = time.perf_counter()
    lowered = choose_program(case.kind).lower(robot, model, rooms, states, scales, settings=settings)
    traced = time.perf_counter()
    compiled = lowered.compile()
    ready = time.perf_counter()
    analysis, robot_frames = compiled.memory_analysis(), case.robots * case.frames
    # Of one device; not every device reports it.
    memory = analysis.temp_size_in_bytes * sharding.device_count(case.robots) if analysis else math.nan
    fits = not memory > os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2
    seconds = time_windows(lambda states: compiled(robot, model, rooms, states, scales), states) if fits else math.nan
    leaves = zip(*map(jax.tree.leaves, (robot.controller, scales)), strict=True)
    return Cost(
        trace=traced - began,
        compile=ready - traced,
        memory=memory / robot_frames / 1e6,
        run=1e3 * seconds / robot_frames,
        parameters=sum(leaf.size for leaf, scale in leaves if jnp.any(scale > 0)),
    )


def make_inputs(
    robots: int,
) -> tuple[closed_loop.Params, mjx.Model, closed_loop.Room, closed_loop.State, controller.Params]:
    """Return the inputs of `rollout_gradient.gradient` for robots in random rooms and all controller parameters."""
    robot = rollout_gradient.smooth_thresholds(
        rollout_gradient.learned_only(assembly.with_camera(assembly.load_robot(), CAMERA))
    )
    model, rooms = hexapod.build(), room_batches.random_rooms(jax.random.key(0), robots)
    states = rollout.reset_batch(robot, model, rooms, policy=policies.LEARNED)
    return robot, model, rooms, states, finetuning.param_scales(robot.controller, tuple(vars(robot.controller)))


def time_windows(
    advance: Callable[[closed_loop.State], tuple[object, closed_loop.State, object]], states: closed_loop.State
) -> float:
    """Return the median time of consecutive windows, without the first [s]."""
    seconds = []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        _, states, _ = jax.block_until_ready(advance(states))
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds[1:])


class Program(Protocol):
    """A jitted function with the arguments and results of `rollout_gradient.gradient`."""

    def lower(
        self,
        params: closed_loop.Params,
        model: mjx.Model,
        rooms: closed_loop.Room,
        states: closed_loop.State,
        param_scales: controller.Params,
        *,
        settings: rollout_gradient.Settings,
    ) -> jax.stages.Lowered: ...


def choose_program(kind: Kind) -> Program:
    """Return the program of a kind."""
    if kind in ("remat", "stored"):
        return rollout_gradient.gradient

    @partial(jax.jit, static_argnames="settings", donate_argnames="states")
    def window(
        params: closed_loop.Params,
        model: mjx.Model,
        rooms: closed_loop.Room,
        states: closed_loop.State,
        scales: controller.Params,
        *,
        settings: rollout_gradient.Settings,
    ) -> PyTree:
        def work(rooms: closed_loop.Room, states: closed_loop.State) -> PyTree:
            robots = rooms.starts.shape[0]

            def losses(controller_params: controller.Params) -> PyTree:
                return rollout_gradient.losses(controller_params, params, model, rooms, states, settings=settings)

            def frame(room: closed_loop.Room, state: closed_loop.State, _: None) -> PyTree:
                return closed_loop.step(params, model, room, state, policies.LEARNED, render=settings.render)

            if kind == "rollout":  # with the same controller parameters for all robots
                after, record = rollout.scan_batch(frame, rooms, states, length=settings.frames)
                return jnp.mean((record.velocity - record.label) ** 2, axis=(1, 2)), (after, record)
            direction = jax.tree.map(
                lambda scale, leaf: jnp.broadcast_to(scale, jnp.shape(leaf)), scales, params.controller
            )
            primals, tangents = (
                rollout_gradient.broadcast_params(each, robots) for each in (params.controller, direction)
            )
            value, derivative, rest = jax.jvp(losses, (primals,), (tangents,), has_aux=True)
            return (value, derivative), rest

        result, (states, record) = sharding.shard_robots(work, rooms, states)
        return result, states, record

    return window


def measure_in_process(case: Case, cache: str | None = None) -> Cost:
    """Measure a program in a new process, with an empty cache if none is given."""
    with (
        tempfile.TemporaryDirectory() as empty,
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process,
    ):
        return process.submit(measure, case, cache or empty).result()


def measure_sizes(robots: tuple[int, ...], frames: tuple[int, ...], render: bool, cache: str) -> dict[Case, Cost]:
    """Print a line for each batch and window; return the costs of the middle batch with the longest window."""
    middle, longest = robots[len(robots) // 2], max(frames)
    sizes = [(middle, length) for length in frames if length != longest] + [(batch, longest) for batch in robots]
    central: dict[Case, Cost] = {}
    print(
        "robots  frames | rollout [ms]  remat  ratio  stored  ratio | rollout [MB]  remat  stored | trace + compile [s]"
    )
    for batch, length in sizes:
        kinds: tuple[Kind, ...] = ("rollout", "remat", "stored")
        cases = [Case(kind=kind, robots=batch, frames=length, render=render) for kind in kinds]
        is_central = (batch, length) == (middle, longest)
        baseline, remat = measure_in_process(cases[0]), measure_in_process(cases[1], cache if is_central else None)
        stored = measure_in_process(cases[2]) if batch == middle else replace(baseline, memory=math.nan, run=math.nan)
        if is_central:
            central = dict(zip(cases, (baseline, remat, stored), strict=True))
        print(
            f"{batch:6d}  {length:6d} | {baseline.run:12.2f}  {remat.run:5.2f}  {remat.run / baseline.run:5.2f}"
            f"  {stored.run:6.1f}  {stored.run / baseline.run:5.2f} | {baseline.memory:12.3f}  {remat.memory:5.3f}"
            f"  {stored.memory:6.2f} | {remat.trace:.0f} + {remat.compile:.0f}",
            flush=True,
        )
    return central


def main(robots: tuple[int, ...] = (1, 16, 64), frames: tuple[int, ...] = (1, 30), render: bool = True) -> None:
    """Print the cost against batch and window, the cost of other methods, and the time of compilation.

    Args:
        robots: sizes of the batches
        frames: lengths of the windows
        render: render the pictures; without them the gradient is through gait, body and network only
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # of the processes: XLA logs its own tuning flags as errors
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco-mjx"))
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {load}; {versions}")
    with tempfile.TemporaryDirectory() as cache:
        (_, baseline), (case, remat), _ = measure_sizes(robots, frames, render, cache).items()
        cached = measure_in_process(case, cache)
    forward = measure_in_process(replace(case, kind="forward mode"))
    differences = 2 * baseline.parameters * baseline.run
    print(f"target: a gradient in {TARGET:g} rollouts\n\n{case.robots} robots, {case.frames} frames, in rollouts:")
    for name, spent in (
        (f"gradient of {baseline.parameters} parameters", remat.run),
        ("forward mode, in one direction", forward.run),
        ("central differences", differences),
    ):
        print(f"  {name:30s}  {spent / baseline.run:9.2f}  {spent / remat.run:8.2f} gradients")
    print()
    for name, cost, target in (("without cache", remat, TARGET_COLD), ("from the cache", cached, TARGET_WARM)):
        seconds = f"{cost.trace + cost.compile:.0f} s ({cost.trace:.0f} s of it tracing)"
        print(f"gradient compiled {name}: {seconds}; target: {target:g} s")


if __name__ == "__main__":
    tyro.cli(main)
