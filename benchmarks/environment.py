"""Steps a second of the environment beside Gymnasium's Ant and a task of MuJoCo Playground, on the same machine.

    python benchmarks/environment.py [--robots 1 16] [--seconds 5]

Every environment takes random actions of its own space for `--seconds` after it was compiled and warmed up.

| environment        | a step                                                                                   |
| ------------------ | ---------------------------------------------------------------------------------------- |
| Hexapod, lgmd      | 1/30 s: 6 physics steps of 18 joints (MJX), contacts, a stereo picture, laser, two LGMDs  |
| Hexapod, laser     | the same without the picture                                                             |
| Ant-v5             | 1/20 s: 5 physics steps of 8 joints (C MuJoCo), no sensor that sees                        |
| CheetahRun         | 1/100 s: one physics step of 6 joints (MJX); left out where Playground is not installed    |

So steps differ, and the table gives simulated seconds a second too.
"""

import argparse
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp

from lgmdjax.environments import gym_env

if HAS_PLAYGROUND := find_spec("mujoco_playground") is not None:
    from mujoco_playground import registry  # pyright: ignore[reportMissingImports]

HEXAPOD = "lgmdjax/Hexapod-v0"
WARM_UP = 5  # steps that are not measured; the first one compiles


def measure(step: Callable[[], object], robots: int, seconds: float) -> float:
    """Return steps a second of all robots together."""
    for _ in range(WARM_UP):
        jax.block_until_ready(step())
    count, began = 0, time.perf_counter()
    while (passed := time.perf_counter() - began) < seconds:
        jax.block_until_ready(step())
        count += 1
    return robots * count / passed


def measure_gymnasium(name: str, robots: int, seconds: float, **settings: Any) -> float:
    """Return steps a second of an environment of Gymnasium; it is reset where an episode ends."""
    if robots > 1:
        many = gymnasium.make_vec(name, num_envs=robots, **settings)
        many.reset(seed=0)
        return measure(lambda: many.step(many.action_space.sample())[0], robots, seconds)
    one = gymnasium.make(name, **settings)
    one.reset(seed=0)

    def step() -> object:
        observation, _, terminated, truncated, _ = one.step(one.action_space.sample())
        return one.reset() if terminated or truncated else observation

    return measure(step, 1, seconds)


def measure_playground(name: str, robots: int, seconds: float) -> float:
    """Return steps a second of a task of Playground, mapped over robots and compiled as a whole."""
    task: Any = registry.load(name)  # pyright: ignore[reportPossiblyUnboundVariable]
    state = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.key(0), robots))
    advance = jax.jit(jax.vmap(task.step))
    actions = jax.random.uniform(jax.random.key(1), (robots, task.action_size), jnp.float32, -1, 1)

    def step() -> object:
        nonlocal state
        state = advance(state, actions)
        return state.obs

    return measure(step, robots, seconds)


def main() -> None:
    """Print a line for each environment and number of robots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # batches use all cores, as in the command line
    versions = ", ".join(f"{name} {version(name)}" for name in ("gymnasium", "jax", "mujoco"))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {versions}")
    print("environment       robots  steps/s  simulated s/s")
    frame = 1 / gym_env.FRAME_RATE
    rows: list[tuple[str, float, Callable[[int], float]]] = [
        ("Hexapod, lgmd", frame, lambda n: measure_gymnasium(HEXAPOD, n, arguments.seconds, observation="lgmd")),
        ("Hexapod, laser", frame, lambda n: measure_gymnasium(HEXAPOD, n, arguments.seconds, observation="laser")),
        ("Ant-v5", 1 / 20, lambda n: measure_gymnasium("Ant-v5", n, arguments.seconds)),
    ]
    if HAS_PLAYGROUND:
        rows.append(("CheetahRun", 1 / 100, lambda n: measure_playground("CheetahRun", n, arguments.seconds)))
    for name, duration, rate in rows:
        for robots in arguments.robots:
            found = rate(robots)
            print(f"{name:16s}  {robots:6d}  {found:7.0f}  {found * duration:13.1f}", flush=True)


if __name__ == "__main__":
    main()
