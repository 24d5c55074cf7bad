"""How long a stereo pair takes and how much memory, beside what one would use instead, in turns within one run.

    python benchmarks/camera.py

A room with 24 obstacles and walls, textured, every pixel integrated over its area, in float32. Beside it C
`mj_multiRay` on the same rays and the same things, which gives a distance a ray: hard, without texture, on one
thread. And `mujoco.Renderer`, where there is OpenGL: a pinhole picture of the same size for each eye, since it has no
fisheye. Wall time is what one waits; processor time is of all cores together, and hangs less on what else runs.
"""

import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.metadata import version

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from lgmdjax.sensors import camera
from lgmdjax.world import arena

ROUNDS = 30
EYES = camera.Params()
POSITIONS = np.array([[0.1, 0.0325, 0.17], [0.1, -0.0325, 0.17]], np.float32)
ROTATION = np.eye(3, dtype=np.float32)


def room(obstacles: int = 24) -> arena.Arena:
    """Stand boxes and cylinders on two rings about the eyes."""
    around = np.arange(obstacles // 2) * 4 * math.pi / obstacles
    ring = np.stack([np.cos(around), np.sin(around)], axis=-1)
    turned = np.stack([np.cos(around + 0.2), np.sin(around + 0.2)], axis=-1)
    boxes = arena.place(1.8 * ring, 0.15, 0.7, bottom=0.0)
    cylinders = arena.place(2.6 * turned, 0.15, 1.0, bottom=0.0)
    made = arena.empty_room((8.0, 8.0), boxes=boxes, cylinders=cylinders)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), made)


def in_mujoco(made: arena.Arena) -> mujoco.MjModel:
    """Build the same things of MuJoCo's geoms, and two eyes."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = EYES.width, EYES.height
    world = spec.worldbody
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[8, 8, 0.1])
    x_low, x_high, y_low, y_high = (float(bound) for bound in made.room)
    height = float(made.wall_height)
    for x in (x_low - 0.05, x_high + 0.05):
        size = [0.05, (y_high - y_low) / 2, height / 2]
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[x, 0, height / 2])
    for y in (y_low - 0.05, y_high + 0.05):
        size = [(x_high - x_low) / 2, 0.05, height / 2]
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[0, y, height / 2])
    for prisms, kind in ((made.boxes, mujoco.mjtGeom.mjGEOM_BOX), (made.cylinders, mujoco.mjtGeom.mjGEOM_CYLINDER)):
        for centre, half, top, yaw in zip(prisms.centre, prisms.half_size, prisms.top, prisms.yaw, strict=True):
            half_height, turn = float(top) / 2, [math.cos(float(yaw) / 2), 0, 0, math.sin(float(yaw) / 2)]
            is_box = kind == mujoco.mjtGeom.mjGEOM_BOX
            size = [float(half[0]), float(half[1]), half_height] if is_box else [float(half[0]), half_height, 0]
            world.add_geom(type=kind, size=size, pos=[float(centre[0]), float(centre[1]), half_height], quat=turn)
    for name, position in zip(("left", "right"), POSITIONS, strict=True):
        world.add_camera(name=name, pos=position.astype(float), xyaxes=[0, -1, 0, 0, 0, 1], fovy=90)
    return spec.compile()


def rays() -> np.ndarray:
    """Give the directions of all pixels of an eye that looks along x."""
    down, right = np.mgrid[: EYES.height, : EYES.width] + 0.5
    right, down = right - EYES.width / 2, down - EYES.height / 2
    rho = np.hypot(right, down)
    theta = rho * EYES.fov / EYES.width
    return np.stack([np.cos(theta), -np.sin(theta) * right / rho, -np.sin(theta) * down / rho], axis=-1).reshape(-1, 3)


def multi_ray(model: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], object]:
    directions = rays()
    count = len(directions)
    geoms, distances = np.zeros(count, np.int32), np.zeros(count)

    def cast() -> None:
        for eye in POSITIONS.astype(float):
            mujoco.mj_multiRay(model, data, eye, directions.ravel(), None, 1, -1, geoms, distances, None, count, 20.0)

    return cast


def opengl(model: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], object]:
    """Raise whatever a machine without OpenGL raises."""
    renderer = mujoco.Renderer(model, EYES.height, EYES.width)

    def draw() -> None:
        for eye in ("left", "right"):
            renderer.update_scene(data, camera=eye)
            renderer.render()

    draw()
    return draw


def medians(candidates: dict[str, Callable[[], object]]) -> dict[str, tuple[float, float]]:
    """Time candidates in turns; median milliseconds of wall and of processor time."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in candidates}
    for run in candidates.values():
        run()
    for _ in range(ROUNDS):
        for name, run in candidates.items():
            began = time.perf_counter(), time.process_time()
            run()
            times[name].append(((time.perf_counter() - began[0]) * 1e3, (time.process_time() - began[1]) * 1e3))
    return {name: (statistics.median(w for w, _ in t), statistics.median(c for _, c in t)) for name, t in times.items()}


def compiled(eyes: camera.Params, made: arena.Arena, robots: int = 1) -> tuple[Callable[[], object], float]:
    """Return the drawing of a pair by each robot, and megabytes a pair."""
    positions = jnp.broadcast_to(jnp.asarray(POSITIONS), (robots, 2, 3))
    draw = jax.vmap(partial(camera.render, eyes), in_axes=(None, 0, None))
    program = jax.jit(draw).lower(made, positions, ROTATION).compile()
    spent = program.memory_analysis()
    memory = (spent.temp_size_in_bytes + spent.output_size_in_bytes) / 1e6 / robots if spent else math.nan
    return lambda: jax.block_until_ready(program(made, positions, ROTATION)), memory


def main() -> None:
    """Print the comparison, and how time and memory grow."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco"))
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {load}; {versions}\n")
    made = room()
    model = in_mujoco(made)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ours, memory = compiled(EYES, made)
    candidates = {"lgmdjax": ours, "mj_multiRay": multi_ray(model, data)}
    try:
        candidates["mujoco.Renderer"] = opengl(model, data)
    except Exception as error:
        print(f"mujoco.Renderer: skipped, no OpenGL here ({type(error).__name__})\n")
    crowding = int(camera.crowding(EYES, made, POSITIONS, ROTATION))
    print(f"A pair of {EYES.width} x {EYES.height}: {memory:.1f} MB, {crowding} prisms in the fullest tile")
    print("| a stereo pair   | wall [ms] | processor [ms] | of ours, wall |")
    print("| --------------- | --------- | -------------- | ------------- |")
    times = medians(candidates)
    for name, (wall, processor) in times.items():
        print(f"| {name:15s} | {wall:9.2f} | {processor:14.2f} | {wall / times['lgmdjax'][0]:13.2f} |")
    print("\n| pixels    | robots | obstacles | slots | wall [ms a pair] | memory [MB a pair] |")
    print("| --------- | ------ | --------- | ----- | ---------------- | ------------------ |")
    small = replace(EYES, width=80, height=60)
    for eyes, robots, obstacles in (
        (small, 1, 24),
        (small, 16, 24),
        (small, 64, 24),
        (small, 16, 8),
        (replace(small, slots=3), 16, 24),
        (replace(EYES, width=160, height=120), 1, 24),
        (EYES, 1, 24),
        (EYES, 4, 24),
    ):
        draw, memory = compiled(eyes, room(obstacles), robots)
        wall = medians({"ours": draw})["ours"][0] / robots
        size = f"{eyes.width} x {eyes.height}"
        print(
            f"| {size:9s} | {robots:6d} | {obstacles:9d} | {eyes.slots:5d} | {wall:16.3f} | {memory:18.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
