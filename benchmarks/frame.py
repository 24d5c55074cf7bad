"""Time and memory of a whole frame (observe, decide, six physics substeps) for a batch of robots in rooms of their own.

    python benchmarks/frame.py [--robots 1 16]

Printed for two resolutions and several batch sizes: robot-frames a second of the compiled rollout, and its memory for
each robot. In the same run they are compared with what one would write without this package: a loop of C MuJoCo steps
and C `mj_multiRay` for the distances behind every pixel of both eyes, without texture, area or detector.
"""

import argparse
import math
import os
import platform
import statistics
import time
from importlib.metadata import version

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, policies
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches, sharding

RESOLUTIONS = ((320, 240, 60.0), (160, 120, 240.0))  # width, height [px], target [robot-frames/s]
FRAMES = 10  # of a measured rollout
REPEATS = 5


def assemble_robot(width: int, height: int) -> closed_loop.Params:
    """Return a robot with the teacher as its policy, whose camera renders the whole picture."""
    return assembly.assemble(braitenberg.Params(), camera_params=camera.Params(width=width, height=height))


def measure(params: closed_loop.Params, robots: int) -> tuple[float, float]:
    """Return robot-frames a second (median), and temporary memory for each robot [MB]."""
    model, rooms = hexapod.build(), room_batches.random_rooms(jax.random.key(0), robots, 0.25)
    states = rollout.reset_batch(params, model, rooms, policy=policies.TEACHER)
    fixed = {"policy": policies.TEACHER, "frames": FRAMES}
    compiled = rollout.rollout_batch.lower(params, model, rooms, states, jnp.asarray(True), **fixed).compile()
    analysis = compiled.memory_analysis()
    robots_per_device = robots / sharding.device_count(robots)
    # Not every device reports its memory.
    memory = analysis.temp_size_in_bytes / 1e6 / robots_per_device if analysis else math.nan
    seconds = []
    for _ in range(REPEATS + 1):  # the first is left out
        began = time.perf_counter()
        states, _ = jax.block_until_ready(compiled(params, model, rooms, states, jnp.asarray(True)))
        seconds.append(time.perf_counter() - began)
    return robots * FRAMES / statistics.median(seconds[1:]), memory


def measure_mujoco_loop(width: int, height: int) -> float:
    """Return frames a second of one robot in a loop of C MuJoCo steps and rays without shading."""
    model = hexapod.load()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stance").id)
    mujoco.mj_forward(model, data)
    generator = np.random.default_rng(0)
    rays = generator.normal(size=(width * height, 3))
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).ravel()
    geoms, distances = np.zeros(width * height, np.int32), np.zeros(width * height)
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        for _ in range(closed_loop.SUBSTEPS):
            mujoco.mj_step(model, data)
        for site in hexapod.EYES:
            mujoco.mj_multiRay(
                model, data, data.site(site).xpos, rays, None, 1, -1, geoms, distances, None, width * height, 10.0
            )
        seconds.append(time.perf_counter() - began)
    return 1 / statistics.median(seconds)


def main() -> None:
    """Print a line for each resolution and batch size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 16])
    robots = parser.parse_args().robots
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # batches use all cores, as in the command line
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco"))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {versions}")
    print("pixels      robots  robot-frames/s  target  MB a robot  loop, 1 robot  ratio")
    for width, height, target in RESOLUTIONS:
        reference = measure_mujoco_loop(width, height)
        for count in robots:
            rate, memory = measure(assemble_robot(width, height), count)
            print(
                f"{width} x {height}  {count:6d}  {rate:14.1f}  {target:6.0f}  {memory:10.1f}  "
                f"{reference:13.1f}  {rate / reference:5.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
