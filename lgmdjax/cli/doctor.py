"""`lgmdjax doctor`: check that this machine computes correctly; one line for each check: OK, WARN or FAIL."""

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

from lgmdjax.cli import environment
from lgmdjax.errors import one_line
from lgmdjax.runtime import jax_setup

OK, WARN, FAIL = "OK", "WARN", "FAIL"
CANARY_ROWS = 32_769  # smallest batch that shows jax#39103: one more than a multiple of the tile
STEP_TOLERANCE = 1e-4  # largest difference of MJX and C MuJoCo in any coordinate after one step in float64
FRAMES = 12  # of the test video
ENOUGH_GB, MIN_GB = 5.0, 0.5  # free disk space: less than the first is a WARN, than the second a FAIL


class Finding(NamedTuple):
    """The result of a check."""

    level: str
    text: str


def run_checks(out: Path) -> int:
    """Print one line for each check; return the exit code, 1 if any failed.

    Args:
        out: folder that run folders would be written to.
    """
    checks: dict[str, Callable[[], Finding]] = {
        "python": check_python,
        "packages": check_packages,
        "environment": check_variables,
        "devices": check_devices,
        "arithmetic": check_arithmetic,
        "physics": check_physics,
        "video": check_video_codec,
        "disk": lambda: check_disk(out),
        "folder": lambda: check_folder(out),
    }
    failed = False
    for name, check in checks.items():
        try:
            finding = check()
        except Exception as error:  # whatever else goes wrong on this machine is a finding too
            finding = Finding(FAIL, _describe(error))
        print(f"{finding.level:4}  {name:11}  {one_line(finding.text)}", flush=True)
        failed |= finding.level == FAIL
    return int(failed)


def check_python() -> Finding:
    """Check the version of Python against the range in pyproject.toml."""
    installed = sys.version.split()[0]
    if (3, 11) <= sys.version_info[:2] <= (3, 13):
        return Finding(OK, installed)
    return Finding(FAIL, f"expected 3.11 to 3.13, found {installed}; make a new environment with one of those")


def check_packages() -> Finding:
    """Check the version of every dependency against the range in this package's metadata."""
    try:
        wanted = [Requirement(line) for line in requires("lgmdjax") or ()]
    except PackageNotFoundError:
        return Finding(
            WARN,
            "expected lgmdjax to be installed, found only its folder, so versions are not checked; pip install -e .",
        )
    accepted, wrong = [], []
    for requirement in wanted:
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            installed = version(requirement.name)
        except PackageNotFoundError:
            wrong.append(f"{requirement.name} none (expected {requirement.specifier})")
            continue
        if requirement.specifier.contains(installed, prereleases=True):
            accepted.append(f"{requirement.name} {installed}")
        else:
            wrong.append(f"{requirement.name} {installed} (expected {requirement.specifier})")
    if version("mujoco").split(".")[:2] != version("mujoco-mjx").split(".")[:2]:
        wrong.append("mujoco and mujoco-mjx of different minor versions")
    if wrong:
        return Finding(FAIL, f"{', '.join(wrong)}; install from requirements.lock")
    return Finding(OK, ", ".join(accepted))


def check_variables() -> Finding:
    """Start the libraries that read environment variables, and name those that are set."""
    environment.check()
    return Finding(OK, jax_setup.user_variables() or "no variable of JAX, MuJoCo or Matplotlib is set")


def check_devices() -> Finding:
    """Name the devices that JAX computes on; warn about a GPU that it does not use."""
    import jax  # inside each check, so that a package that cannot be imported is a finding

    available = jax.devices()
    text = ", ".join(str(device.device_kind) for device in available) + f"; {os.cpu_count()} cores"
    if available[0].platform == "cpu" and shutil.which("nvidia-smi"):
        return Finding(WARN, f"{text}; JAX does not use the GPU of this machine; pip install 'lgmdjax[cuda13]'")
    return Finding(OK, text)


def check_arithmetic() -> Finding:
    """Run a small program that some releases of JAX compile to wrong numbers (jax#39103)."""
    import jax
    import jax.numpy as jnp

    with jax.enable_x64(True):
        rows = np.random.default_rng(0).normal(size=(CANARY_ROWS, 3))
        squares = jax.jit(jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2)))(rows)
    wrong = int(np.sum(~np.isclose(np.asarray(squares), np.sum(rows**2, axis=1), rtol=1e-9)))
    if wrong:
        return Finding(
            FAIL,
            f"{wrong} of {CANARY_ROWS} results wrong under jit; install another release of jax (see pyproject.toml)",
        )
    return Finding(OK, f"{CANARY_ROWS} results right under jit in float64")


def check_physics() -> Finding:
    """Compare one physics step of the hexapod, from random velocities, in MJX and in C MuJoCo."""
    import jax
    import jax.numpy as jnp
    import mujoco

    from lgmdjax.body import hexapod
    from lgmdjax.runtime.mjx import mjx

    model = hexapod.load()
    reference = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, reference, 0)
    reference.qvel[:] = np.random.default_rng(0).normal(size=model.nv) * 0.3
    with jax.enable_x64(True):
        mjx_model = mjx.put_model(model, impl="jax")
        # Copies: asarray may share MuJoCo's buffers, which mj_step writes to while JAX still reads them.
        data = mjx.make_data(mjx_model).replace(
            qpos=jnp.array(reference.qpos), qvel=jnp.array(reference.qvel), ctrl=jnp.array(reference.ctrl)
        )
        data = jax.jit(mjx.step)(mjx_model, data)
    mujoco.mj_step(model, reference)
    differences = [np.asarray(data.qpos) - reference.qpos, np.asarray(data.qvel) - reference.qvel]
    largest = float(np.max(np.abs(np.concatenate(differences))))
    text = f"after one step of the hexapod MJX and C MuJoCo differ by {largest:.1e}"
    if largest < STEP_TOLERANCE:
        return Finding(OK, text)
    return Finding(FAIL, f"{text}, expected less than {STEP_TOLERANCE:g}; install mujoco from requirements.lock")


def check_video_codec() -> Finding:
    """Encode a few frames with H.264 in memory, decode them, and count them."""
    import av

    from lgmdjax.reporting import video_io

    file = io.BytesIO()
    with video_io.open_writer(file, 64, 48, 30) as write:
        for shade in range(FRAMES):
            write(np.full((48, 64, 3), 20 * shade, np.uint8))
    file.seek(0)
    with av.open(file, "r") as container:
        stream = container.streams.video[0]
        codec, decoded = stream.codec_context.name, sum(1 for _ in container.decode(stream))
    return Finding(OK if decoded == FRAMES else FAIL, f"{codec}: {decoded} of {FRAMES} frames encoded and decoded")


def check_disk(out: Path) -> Finding:
    """Check that the disk has space for a run."""
    free = shutil.disk_usage(_existing_parent(out)).free / 1e9
    level = OK if free >= ENOUGH_GB else WARN if free >= MIN_GB else FAIL
    advice = "" if level == OK else f"; {ENOUGH_GB:g} GB are enough: free some, or choose another --out"
    return Finding(level, f"{free:.1f} GB free for {out}{advice}")


def check_folder(out: Path) -> Finding:
    """Check that files can be written to the folder, or to its nearest existing parent."""
    parent = _existing_parent(out)
    try:
        with tempfile.TemporaryFile(dir=parent):
            return Finding(OK, f"{parent.resolve()} can be written")
    except OSError as error:
        return Finding(
            FAIL, f"expected a folder that can be written, got {parent} ({error.strerror}); choose another --out"
        )


def _describe(error: Exception) -> str:
    """Return what an error says, and the environment variables that may be its cause."""
    named = jax_setup.user_variables()
    text = f"{type(error).__name__}: {one_line(error)[:300]}"
    return f"{text} (set: {named})" if named and named not in text else text


def _existing_parent(path: Path) -> Path:
    """Return the path itself if it exists, otherwise its nearest parent that does."""
    path = path.absolute()
    return next(folder for folder in (path, *path.parents) if folder.exists())
