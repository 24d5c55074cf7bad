"""What the stages share: one robot put together from the files of a run, and walks of a crowd with a progress bar."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.control import braitenberg, navigator, policies
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.locomotion import shaping
from lgmdjax.paths import PRETRAINED
from lgmdjax.runtime.storage import read_arrays, read_json
from lgmdjax.sensors import camera
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import closed_loop


def eyes(settings: CameraSettings) -> camera.Params:
    """Set up the stereo camera of a run."""
    return camera.Params(width=settings.width, height=settings.height, overlap=settings.overlap)


def robot(gait: Path, settings: CameraSettings, detector: lgmd.Params, crew: policies.Anyone) -> closed_loop.Params:
    """Put a robot together: the gait that was fitted, the eyes of the run, and anyone at the wheel."""
    networks = shaping.load(gait / "shaping.safetensors")
    params = closed_loop.assemble(crew, detector=detector, networks=networks, eyes=eyes(settings))
    return with_eyes(params, settings)


def trained(gait: Path = PRETRAINED, train: Path = PRETRAINED) -> closed_loop.Params:
    """Put a robot together from two folders, all five drivers aboard, with the eyes that its navigator learned from.

    Args:
        gait: the folder of stage fit-gait. train: that of stage train. Left out, it is the robot that comes along.

    Raises InputError if a folder has not what the stage writes.
    """
    learned, header = navigator.load(train / "controller.safetensors")
    baselines = read_arrays(train / "baselines.npz")
    try:
        crew = everyone(learned, float(baselines["gain"]), baselines["replayed"])
        return robot(gait, CameraSettings(**header["eyes"]), lgmd.Params(**header["lgmd"]), crew)
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{train}: expected a navigator and baselines as `lgmdjax train` leaves them, got {error}; train again"
        ) from error


def with_eyes(params: closed_loop.Params, settings: CameraSettings) -> closed_loop.Params:
    """Give a robot other eyes; whose cells look at as much of the world say nearly the same."""
    detector = replace(params.controller.lgmd, pooling=settings.pooling)
    return replace(params, camera=eyes(settings), controller=replace(params.controller, lgmd=detector))


def everyone(
    learned: navigator.Params | None = None, gain: float = 0.0, replayed: np.ndarray | None = None
) -> policies.Anyone:
    """Seat all five drivers, the teacher at the wheel; those that nothing is known of yet are stand-ins.

    Args:
        learned: the trained navigator. gain: of the direct driver [1/m].
        replayed: `REPLAY` commands of the teacher for the random driver.
    """
    teacher = braitenberg.Params()
    straight = jnp.full(2, teacher.base, dtype=float)
    commands = jnp.broadcast_to(straight, (REPLAY, 2)) if replayed is None else jnp.asarray(replayed, dtype=float)
    return policies.Anyone(
        seat=jnp.asarray(0),
        drivers=(
            teacher,
            navigator.create(jax.random.key(0), symmetric=True) if learned is None else learned,
            policies.Blind(velocity=straight),
            policies.Direct(rule=teacher, gain=jnp.asarray(gain, dtype=float)),
            policies.Replay(velocities=commands),
        ),
    )


REPLAY = 4096  # commands of the random driver; a static number, so that one compiled program serves all stages


def manned(params: closed_loop.Params, driver: Any) -> closed_loop.Params:
    """Exchange one of a robot's five drivers, the one whose parameters are of the same type."""
    crew = params.controller.driver
    five = tuple(driver if isinstance(one, type(driver)) else one for one in crew.drivers)
    return replace(params, controller=replace(params.controller, driver=replace(crew, drivers=five)))


def seat(params: closed_loop.Params, driver: policies.Driver) -> closed_loop.Params:
    """Put one of the drivers at the wheel."""
    crew = replace(params.controller.driver, seat=jnp.asarray(policies.ALL.index(driver)))
    return replace(params, controller=replace(params.controller, driver=crew))


def digest(params: closed_loop.Params) -> str:
    """Tell a robot from any other."""
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params)]
    structure = repr((params.camera, jax.tree.structure(params))).encode()
    return hashlib.sha256(b"".join(leaves) + structure).hexdigest()[:16]


CHOSEN = ("threshold", "suppression", "inhibition")  # T_s, T_f, W_I


def load_detector(folder: Path) -> lgmd.Params:
    """Read the detector that `collect` calibrated."""
    chosen = read_json(folder / "calibration.json")
    return lgmd.Params(**{name: chosen[name] for name in CHOSEN})
