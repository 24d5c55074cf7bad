"""Time and memory of a stereo pair, compared with what one would use instead.

    python benchmarks/camera.py

The scene is a textured room with walls and 24 obstacles.

| candidate         | what it computes                                                                           |
| ----------------- | ------------------------------------------------------------------------------------------ |
| `camera.render`   | both pictures in float32, each pixel integrated over its area                              |
| C `mj_multiRay`   | the distance along one ray for each pixel, without texture or area, on one thread          |
| `mujoco.Renderer` | a pinhole picture of the same size for each eye, since it has no fisheye; only with OpenGL |

Candidates take turns within one run. Wall time is what a user waits; processor time is the sum over all cores, and
depends less on other programs.
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


def build_room(obstacles: int = 24) -> arena.Arena:
    """Return a room with boxes and cylinders on two rings around the eyes."""
    angles = np.arange(obstacles // 2) * 4 * math.pi / obstacles
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    rotated_ring = np.stack([np.cos(angles + 0.2), np.sin(angles + 0.2)], axis=-1)
    boxes = arena.make_prisms(1.8 * ring, 0.15, 0.7, bottom=0.0)
    cylinders = arena.make_prisms(2.6 * rotated_ring, 0.15, 1.0, bottom=0.0)
    room = arena.empty_room((8.0, 8.0), boxes=boxes, cylinders=cylinders)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), room)


def build_mujoco_model(room: arena.Arena) -> mujoco.MjModel:
    """Return a MuJoCo model with the same obstacles as geoms, and a camera for each eye."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = EYES.width, EYES.height
    world = spec.worldbody
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[8, 8, 0.1])
    x_low, x_high, y_low, y_high = (float(bound) for bound in room.bounds)
    height = float(room.wall_height)
    for x in (x_low - 0.05, x_high + 0.05):
        size = [0.05, (y_high - y_low) / 2, height / 2]
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[x, 0, height / 2])
    for y in (y_low - 0.05, y_high + 0.05):
        size = [(x_high - x_low) / 2, 0.05, height / 2]
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[0, y, height / 2])
    for prisms, kind in ((room.boxes, mujoco.mjtGeom.mjGEOM_BOX), (room.cylinders, mujoco.mjtGeom.mjGEOM_CYLINDER)):
        for centre, half, top, yaw in zip(prisms.centre, prisms.half_size, prisms.top, prisms.yaw, strict=True):
            half_height, turn = float(top) / 2, [math.cos(float(yaw) / 2), 0, 0, math.sin(float(yaw) / 2)]
            is_box = kind == mujoco.mjtGeom.mjGEOM_BOX
            size = [float(half[0]), float(half[1]), half_height] if is_box else [float(half[0]), half_height, 0]
            world.add_geom(type=kind, size=size, pos=[float(centre[0]), float(centre[1]), half_height], quat=turn)
    for name, position in zip(("left", "right"), POSITIONS, strict=True):
        world.add_camera(name=name, pos=position.astype(float), xyaxes=[0, -1, 0, 0, 0, 1], fovy=90)
    return spec.compile()


def ray_directions() -> np.ndarray:
    """Return the directions of all pixels of an eye that looks along x."""
    down, right = np.mgrid[: EYES.height, : EYES.width] + 0.5
    right, down = right - EYES.width / 2, down - EYES.height / 2
    rho = np.hypot(right, down)
    theta = rho * EYES.fov / EYES.width
    return np.stack([np.cos(theta), -np.sin(theta) * right / rho, -np.sin(theta) * down / rho], axis=-1).reshape(-1, 3)


def mujoco_rays(model: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], object]:
    """Return a function that casts the rays of both eyes with C MuJoCo."""
    directions = ray_directions()
    count = len(directions)
    geoms, distances = np.zeros(count, np.int32), np.zeros(count)

    def cast() -> None:
        for eye in POSITIONS.astype(float):
            mujoco.mj_multiRay(model, data, eye, directions.ravel(), None, 1, -1, geoms, distances, None, count, 20.0)

    return cast


def mujoco_renderer(model: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], object]:
    """Return a function that renders both eyes with OpenGL; without OpenGL this raises one of many exceptions."""
    renderer = mujoco.Renderer(model, EYES.height, EYES.width)

    def render() -> None:
        for eye in ("left", "right"):
            renderer.update_scene(data, camera=eye)
            renderer.render()

    render()
    return render


def medians(candidates: dict[str, Callable[[], object]]) -> dict[str, tuple[float, float]]:
    """Time candidates in turns; return the median wall and processor times of each [ms]."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in candidates}
    for run in candidates.values():
        run()
    for _ in range(ROUNDS):
        for name, run in candidates.items():
            began = time.perf_counter(), time.process_time()
            run()
            times[name].append(((time.perf_counter() - began[0]) * 1e3, (time.process_time() - began[1]) * 1e3))
    return {name: (statistics.median(w for w, _ in t), statistics.median(c for _, c in t)) for name, t in times.items()}


def compile_render(eyes: camera.Params, room: arena.Arena, robots: int = 1) -> tuple[Callable[[], object], float]:
    """Return a function that renders a stereo pair for each robot, and the memory of a pair [MB]."""
    positions = jnp.broadcast_to(jnp.asarray(POSITIONS), (robots, 2, 3))
    render = jax.vmap(partial(camera.render, eyes), in_axes=(None, 0, None))
    program = jax.jit(render).lower(room, positions, ROTATION).compile()
    analysis = program.memory_analysis()
    memory = (analysis.temp_size_in_bytes + analysis.output_size_in_bytes) / 1e6 / robots if analysis else math.nan
    return lambda: jax.block_until_ready(program(room, positions, ROTATION)), memory


def main() -> None:
    """Print the comparison of candidates, and the growth of time and memory."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco"))
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {load}; {versions}\n")
    room = build_room()
    model = build_mujoco_model(room)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    render, memory = compile_render(EYES, room)
    candidates = {"lgmdjax": render, "mj_multiRay": mujoco_rays(model, data)}
    try:
        candidates["mujoco.Renderer"] = mujoco_renderer(model, data)
    except Exception as error:
        print(f"mujoco.Renderer: skipped, no OpenGL here ({type(error).__name__})\n")
    occupancy = int(camera.max_tile_occupancy(EYES, room, POSITIONS, ROTATION))
    print(f"A pair of {EYES.width} x {EYES.height}: {memory:.1f} MB, at most {occupancy} obstacles in a tile")
    print("| a stereo pair   | wall [ms] | processor [ms] | wall, ratio |")
    print("| --------------- | --------- | -------------- | ----------- |")
    times = medians(candidates)
    for name, (wall, processor) in times.items():
        print(f"| {name:15s} | {wall:9.2f} | {processor:14.2f} | {wall / times['lgmdjax'][0]:11.2f} |")
    print_growth()


def print_growth() -> None:
    """Print time and memory against the size of a picture and the number of robots and obstacles."""
    print("\n| pixels    | robots | obstacles | tile capacity | wall [ms a pair] | memory [MB a pair] |")
    print("| --------- | ------ | --------- | ------------- | ---------------- | ------------------ |")
    small = replace(EYES, width=80, height=60)
    for eyes, robots, obstacles in (
        (small, 1, 24),
        (small, 16, 24),
        (small, 64, 24),
        (small, 16, 8),
        (replace(small, tile_capacity=3), 16, 24),
        (replace(EYES, width=160, height=120), 1, 24),
        (EYES, 1, 24),
        (EYES, 4, 24),
    ):
        render, memory = compile_render(eyes, build_room(obstacles), robots)
        wall = medians({"lgmdjax": render})["lgmdjax"][0] / robots
        size = f"{eyes.width} x {eyes.height}"
        print(
            f"| {size:9s} | {robots:6d} | {obstacles:9d} | {eyes.tile_capacity:13d} | {wall:16.3f} | {memory:18.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
