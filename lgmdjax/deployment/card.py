"""The card of an exported nervous system: all that one needs to build a robot around it, as JSON.

| key      | contents                                                                                        |
| -------- | ----------------------------------------------------------------------------------------------- |
| robot    | its name, and the fingerprint of its parameters                                                 |
| eyes     | size, rate and layout of the pictures, and where the cameras sit                                |
| lgmd     | thresholds and cells of the detectors                                                           |
| velocity | unit, range and order of v                                                                      |
| servos   | order, zero, limits and rate of the set points                                                  |
| memory   | of the C program: state, constants [bytes]                                                      |
| inputs, outputs, state | name, shape and type of every array; of the state also its value before the first picture |
| training | header of the navigator: teacher, rooms, settings, seed, versions                               |
| scores   | of the learned policy, by trial, as stage evaluate measured them; null if it did not run         |
| files    | size and SHA-256 of the other files                                                             |
| versions | of the packages that exported it                                                                |
"""

import math
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.deployment import c_source, nervous_system, onnx_graph
from lgmdjax.deployment.nervous_system import Params
from lgmdjax.detectors import lgmd
from lgmdjax.locomotion import tripod_gait
from lgmdjax.runtime import checksums, versions
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS

FILE = "card.json"
FORMAT, VERSION = "lgmdjax nervous system", 1
ZERO = "leg straight out along its mount, femur level, tibia vertical; positive coxa turns left, femur and tibia lift"


def describe(params: Params) -> JsonObject:
    """Return what follows from the parameters: all keys but robot, training, scores and files."""
    pictures, first = nervous_system.argument_types(params)[0], nervous_system.to_arrays(nervous_system.init(params))
    function, types = nervous_system.by_name(params), nervous_system.argument_types(params)
    output, _ = jax.eval_shape(function, *types)
    return {
        "format": FORMAT,
        "version": VERSION,
        "eyes": _eyes(params),
        "lgmd": _lgmd(params),
        "velocity": {
            "unit": f"{tripod_gait.Gait().nominal_velocity} m/s",
            "order": list(hemifield.SIDES),
            "range": [policies.GAIT_RANGE.min_velocity, policies.GAIT_RANGE.max_velocity],
        },
        "servos": _servos(params),
        "memory": c_source.memory(params),
        "inputs": {"pictures": _describe_array(pictures)},
        "outputs": {name: _describe_array(value) for name, value in output.items()},
        "state": {name: _describe_array(value) | {"first": _compact(value)} for name, value in first.items()},
        "versions": versions.installed() | _exporters(),
    }


def describe_files(folder: Path) -> JsonObject:
    """Return size and hash of each file in a folder."""
    return {
        path.name: {"bytes": path.stat().st_size, "sha256": checksums.digest(path.read_bytes())}
        for path in sorted(folder.iterdir())
    }


def _eyes(params: Params) -> JsonObject:
    camera = params.camera
    level = hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.array([1.0, 0.0, 0.0, 0.0]))
    return {
        "order": list(hemifield.SIDES),
        "width": camera.width,
        "height": camera.height,
        "pixels": "uint8, 0 black to 255 white, top row first",
        "rate": f"{FRAME_RATE:g} Hz",
        "lens": f"equidistant, {math.degrees(camera.fov):g} degrees over the whole width",
        "rows_seen": hemifield.row_count(camera.height, camera.ground),
        "columns_seen": hemifield.column_count(camera.width, camera.overlap),
        "seen": "the first rows; the first columns of the left picture, the last of the right one",
        "positions": _rounded(hexapod.eye_poses(level, camera.mounts)[0]),  # m, in the trunk's frame
        "frame": "m, trunk: x forward, y left, z up; eyes look forward",
    }


def _lgmd(params: Params) -> JsonObject:
    detector, (rows, columns) = params.controller.detector, nervous_system.cell_shape(params)
    return {
        "threshold": float(f"{detector.threshold:.7g}"),  # digits of single precision
        "suppression": float(f"{detector.suppression:.7g}"),
        "inhibition": float(f"{detector.inhibition:.7g}"),
        "unit": "grey levels of threshold and suppression",
        "rows": rows,
        "columns": columns,
        "weights": _rounded(lgmd.column_weights(detector, columns)),  # of columns, the outermost first
    }


def _servos(params: Params) -> JsonObject:
    lowest, highest = params.limits
    return {
        "legs": list(hexapod.LEGS),
        "joints": list(hexapod.JOINTS),
        "unit": "rad",
        "zero": ZERO,
        "lowest": _rounded(lowest),
        "highest": _rounded(highest),
        "substeps": SUBSTEPS,
        "rate": f"{FRAME_RATE * SUBSTEPS:g} Hz",
    }


def _describe_array(value: jax.ShapeDtypeStruct | Array) -> JsonObject:
    return {"shape": list(value.shape), "type": str(value.dtype)}


def _compact(value: Array) -> object:
    """Return a number for an array that has only one value, else nested lists."""
    array = np.asarray(value)
    return array.flat[0].item() if np.all(array == array.flat[0]) else array.tolist()


def _rounded(value: Array | np.ndarray) -> list:
    return np.round(np.asarray(value, float), 6).tolist()


def _exporters() -> dict[str, str]:
    return {name: version(name) for name in ("jax2onnx", "onnx") if onnx_graph.HAS_JAX2ONNX}
