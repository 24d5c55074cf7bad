"""`lgmdjax doctor`: does this machine compute what it should? One line a check, OK, WARN or FAIL."""

import io
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import NamedTuple

import numpy as np
from packaging.requirements import Requirement

OK, WARN, FAIL = "OK", "WARN", "FAIL"
CANARY_ROWS = 32_769  # the smallest batch that shows jax#39103, one above a multiple of the tile
STEP_TOLERANCE = 1e-4  # of MJX against C MuJoCo, float64, in any coordinate after one step
FRAMES = 12
ENOUGH_GB, LEAST_GB = 5.0, 0.5


class Finding(NamedTuple):
    """What a check found."""

    level: str
    text: str


def examine(out: Path) -> int:
    """Print one line a check; give the exit code, 1 if anything failed."""
    checks: dict[str, Callable[[], Finding]] = {
        "python": python,
        "packages": packages,
        "devices": devices,
        "arithmetic": arithmetic,
        "physics": physics,
        "video": video_codec,
        "disk": lambda: disk(out),
        "folder": lambda: folder(out),
    }
    worst = 0
    for name, check in checks.items():
        try:
            found = check()
        except Exception as error:  # a machine may fail in ways that nobody foresaw: say which, and go on
            found = Finding(FAIL, f"{type(error).__name__}: {' '.join(str(error).split())[:300]}")
        print(f"{found.level:4}  {name:10}  {found.text}", flush=True)
        worst = max(worst, found.level == FAIL)
    return int(worst)


def python() -> Finding:
    """Look at Python's version against the one range that pyproject.toml states."""
    found = sys.version.split()[0]
    good = (3, 11) <= sys.version_info[:2] <= (3, 13)
    return Finding(OK if good else FAIL, f"{found}" if good else f"expected 3.11 to 3.13, found {found}")


def packages() -> Finding:
    """Look at every installed version against the ranges that this package was built with."""
    try:
        wanted = [Requirement(line) for line in requires("lgmdjax") or ()]
    except PackageNotFoundError:
        return Finding(WARN, "lgmdjax is not installed, so its ranges are not known; pip install -e .")
    found, wrong = [], []
    for requirement in wanted:
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            have = version(requirement.name)
        except PackageNotFoundError:
            have = "none"
        fits = have != "none" and requirement.specifier.contains(have, prereleases=True)
        (found if fits else wrong).append(
            f"{requirement.name} {have}" + ("" if fits else f" (expected {requirement.specifier})")
        )
    if version("mujoco").split(".")[:2] != version("mujoco-mjx").split(".")[:2]:
        wrong.append("mujoco and mujoco-mjx differ in their minor versions")
    if wrong:
        return Finding(FAIL, f"{', '.join(wrong)}; install from requirements.lock")
    return Finding(OK, ", ".join(found))


def devices() -> Finding:
    """Name what JAX computes on, and whether a GPU lies idle."""
    import jax  # here and below: what cannot be imported is a finding

    found = jax.devices()
    text = ", ".join(str(device.device_kind) for device in found) + f"; {os.cpu_count()} cores"
    if found[0].platform == "cpu" and shutil.which("nvidia-smi"):
        return Finding(WARN, f"{text}; there is a GPU that JAX does not use: pip install 'lgmdjax[cuda13]'")
    return Finding(OK, text)


def arithmetic() -> Finding:
    """Run the smallest program that some releases of JAX compile to wrong numbers (jax#39103)."""
    import jax
    import jax.numpy as jnp

    with jax.enable_x64(True):
        rows = np.random.default_rng(0).normal(size=(CANARY_ROWS, 3))
        squares = jax.jit(jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2)))(rows)
    wrong = int(np.sum(~np.isclose(np.asarray(squares), np.sum(rows**2, axis=1), rtol=1e-9)))
    if wrong:
        return Finding(
            FAIL,
            f"{wrong} of {CANARY_ROWS} results wrong under jit: install another jax (see pyproject.toml)",
        )
    return Finding(OK, f"{CANARY_ROWS} results right under jit in float64")


def physics() -> Finding:
    """Take one step with the kicked hexapod in MJX and in C MuJoCo."""
    import jax
    import jax.numpy as jnp
    import mujoco

    from lgmdjax.runtime.jax_setup import import_physics

    import_physics()
    from mujoco import mjx

    from lgmdjax.body import hexapod

    model = hexapod.load()
    there = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, there, 0)
    there.qvel[:] = np.random.default_rng(0).normal(size=model.nv) * 0.3
    with jax.enable_x64(True):
        built = mjx.put_model(model, impl="jax")
        # Copies: asarray may share MuJoCo's buffers, which mj_step writes to while JAX still reads them.
        here = mjx.make_data(built).replace(
            qpos=jnp.array(there.qpos), qvel=jnp.array(there.qvel), ctrl=jnp.array(there.ctrl)
        )
        here = jax.jit(mjx.step)(built, here)
    mujoco.mj_step(model, there)
    gaps = [np.asarray(here.qpos) - there.qpos, np.asarray(here.qvel) - there.qvel]
    off = float(np.max(np.abs(np.concatenate(gaps))))
    level = OK if off < STEP_TOLERANCE else FAIL
    return Finding(level, f"one step of the hexapod, MJX and C MuJoCo {off:.1e} apart")


def video_codec() -> Finding:
    """Encode a few frames with H.264 in memory, and count them again."""
    import av

    from lgmdjax.reporting import video_io

    file = io.BytesIO()
    with video_io.writing(file, 64, 48, 30) as write:
        for shade in range(FRAMES):
            write(np.full((48, 64, 3), 20 * shade, np.uint8))
    file.seek(0)
    with av.open(file, "r") as container:
        stream = container.streams.video[0]
        codec, found = stream.codec_context.name, sum(1 for _ in container.decode(stream))
    return Finding(OK if found == FRAMES else FAIL, f"{codec}: {found} of {FRAMES} frames came back from H.264")


def disk(out: Path) -> Finding:
    """Look for room for a run."""
    free = shutil.disk_usage(_nearest(out)).free / 1e9
    level = OK if free >= ENOUGH_GB else WARN if free >= LEAST_GB else FAIL
    return Finding(level, f"{free:.1f} GB free for {out}" + ("" if level == OK else f"; {ENOUGH_GB:g} GB are enough"))


def folder(out: Path) -> Finding:
    """Try to write where runs go."""
    place = _nearest(out)
    try:
        with tempfile.TemporaryFile(dir=place):
            return Finding(OK, f"{place.resolve()} can be written")
    except OSError as error:
        return Finding(FAIL, f"expected a folder that can be written, got {place} ({error.strerror}); choose --out")


def _nearest(path: Path) -> Path:
    """Find the folder itself, or the one that it would be made in."""
    path = path.absolute()
    return next(place for place in (path, *path.parents) if place.exists())
