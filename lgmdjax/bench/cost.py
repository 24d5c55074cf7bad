"""Time that a detector takes for one stereo frame, in one thread of execution, without rendering or physics."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.control import controller
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop

FRAMES = 300
REPEATS = 5


def measure(robot: closed_loop.Params) -> float:
    """Return the fewest microseconds of `REPEATS` runs over `FRAMES` stereo frames of noise, for both eyes together."""
    generator = np.random.default_rng(0)
    frames = jnp.asarray(generator.uniform(60, 190, (FRAMES, *camera.image_shape(robot.camera))), float)
    params = robot.controller

    @jax.jit
    def run(frames: jax.Array) -> jax.Array:
        start = controller.init_detectors(params, frames[0])
        return jax.lax.scan(lambda states, pair: controller.step_detectors(params, states, pair), start, frames)[1].u

    jax.block_until_ready(run(frames))
    seconds = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(run(frames))
        seconds.append(time.perf_counter() - begin)
    return 1e6 * min(seconds) / FRAMES
