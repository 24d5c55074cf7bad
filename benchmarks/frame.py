"""The whole frame: sense, decide, six physics substeps, for a crowd of robots in rooms of their own.

Robot-frames a second of the compiled walk at two resolutions, its memory a robot, and how both grow with the crowd;
beside it, in the same run, what one would write without this library: a loop over robots of C MuJoCo steps, C
`mj_multiRay` for the distances behind every pixel of both eyes (no texture, no area), and no detector at all.

    python benchmarks/frame.py [--robots 1 16]
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
from lgmdjax.simulation import closed_loop, rollout, room_batches, sharding

RESOLUTIONS = ((320, 240, 60.0), (160, 120, 240.0))  # pixels, and the robot-frames a second asked for
FRAMES = 10  # of a measured chunk
REPEATS = 5


def robot(width: int, height: int) -> closed_loop.Params:
    """Put a robot together that its teacher drives and whose eyes draw the whole picture."""
    return closed_loop.assemble(braitenberg.Params(), eyes=camera.Params(width=width, height=height))


def measure(params: closed_loop.Params, robots: int) -> tuple[float, float]:
    """Return robot-frames a second (median) and megabytes of temporaries a robot."""
    model, rooms = hexapod.build(), room_batches.random_rooms(jax.random.key(0), robots, 0.25)
    states = rollout.start(params, model, rooms, driver=policies.TEACHER)
    fixed = {"driver": policies.TEACHER, "frames": FRAMES}
    compiled = rollout.advance.lower(params, model, rooms, states, draw=jnp.asarray(True), **fixed).compile()
    analysis = compiled.memory_analysis()
    share = robots / sharding.shares(robots)
    memory = analysis.temp_size_in_bytes / 1e6 / share if analysis else math.nan  # not every device tells
    seconds = []
    for _ in range(REPEATS + 1):  # the first is thrown away
        began = time.perf_counter()
        states, _ = jax.block_until_ready(compiled(params, model, rooms, states, draw=jnp.asarray(True)))
        seconds.append(time.perf_counter() - began)
    return robots * FRAMES / statistics.median(seconds[1:]), memory


def by_hand(width: int, height: int) -> float:
    """Return frames a second of one robot in a plain loop: C MuJoCo steps, and rays without shading."""
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
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 16])
    robots = parser.parse_args().robots
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # crowds on all cores, as from the command line
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco"))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {versions}")
    print("pixels      robots  robot-frames/s  asked  MB a robot  by hand, 1 robot  ratio")
    for width, height, asked in RESOLUTIONS:
        reference = by_hand(width, height)
        for count in robots:
            rate, memory = measure(robot(width, height), count)
            print(
                f"{width} x {height}  {count:6d}  {rate:14.1f}  {asked:5.0f}  {memory:10.1f}  "
                f"{reference:16.1f}  {rate / reference:5.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
