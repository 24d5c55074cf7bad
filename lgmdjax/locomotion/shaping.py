"""Shaping networks: one per leg, from the rhythm of its CPG unit and the velocity of its side to three joint angles.

Each network has six rectified units and a linear output, as in the paper, but one more input: the unit's adaptation
difference. A static map of the output u_e - u_f alone can only trace an open curve back and forth, and a robot with
networks fitted to this input (`printed_input`) hardly walks. Output and adaptation difference together trace a closed
loop, by which stance and swing can differ.

| symbol         | name          | unit             | equation  |
| -------------- | ------------- | ---------------- | --------- |
| CPG_i          | rhythm[i, 0]  | 1                | 6         |
| v^e - v^f      | rhythm[i, 1]  | 1                | 2, 4      |
| v^left, right  | velocity      | nominal velocity | sec. 3.2  |
| -              | targets       | rad              | sec. 3.2  |

Source: Cizek & Faigl, sec. 3.2. `lgmdjax.locomotion.gait_fit.fit` fits the networks.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.html import NotebookTable
from lgmdjax.paths import SHAPING_FILE
from lgmdjax.runtime import schema, storage
from lgmdjax.runtime.storage import JsonObject

LEGS, INPUTS, UNITS, JOINTS = 6, 3, 6, 3
MIN_VELOCITY, MAX_VELOCITY = -1.0, 2.0  # nominal velocities; the range for which the networks are fitted
FILE = storage.TensorFile(
    format="lgmdjax.shaping", version="1", name="shaping networks", remedy="`lgmdjax fit-gait` makes one"
)
HEADER = schema.Object(optional={"literal": schema.Flag()})  # `printed_input`
SHAPES = {
    "w1": (LEGS, INPUTS, UNITS),
    "b1": (LEGS, UNITS),
    "w2": (LEGS, UNITS, JOINTS),
    "b2": (LEGS, JOINTS),
}
MIRROR_SIGNS = np.array([-1.0, 1.0, 1.0])  # of mirrored joint angles; mirroring also reverses the leg order


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Weights of the six networks.

    The inputs are CPG output, adaptation difference and velocity; the outputs are joint angles in radians.
    """

    w1: Float[Array, "6 3 6"]
    b1: Float[Array, "6 6"]
    w2: Float[Array, "6 6 3"]
    b2: Float[Array, "6 3"]
    printed_input: bool = struct.field(pytree_node=False, default=False)  # as in the paper: no adaptation difference


def init(key: Array, *, printed_input: bool = False) -> Params:
    """Return randomly initialised networks, with weights scaled to inputs and angles of order one, and zero biases."""
    first, second = jax.random.split(key)
    return Params(
        w1=jax.random.normal(first, SHAPES["w1"], dtype=float) / np.sqrt(INPUTS),
        b1=jnp.zeros(SHAPES["b1"]),
        w2=jax.random.normal(second, SHAPES["w2"], dtype=float) / np.sqrt(UNITS),
        b2=jnp.zeros(SHAPES["b2"]),
        printed_input=printed_input,
    )


def apply(params: Params, rhythm: Float[Array, "6 2"], velocity: Float[Array, "2"]) -> Float[Array, "6 3"]:
    """Return the joint targets [rad], one row per leg.

    The velocity acts without delay. The networks extrapolate linearly beyond the range of the fit, [-1, 2], so limit
    the velocity to it.

    Gradient: exact almost everywhere; zero through a unit whose activation is zero, and with `printed_input` through
    the adaptation difference and its weights.

    >>> targets = apply(load_pretrained(), jnp.zeros((6, 2)), velocity=jnp.ones(2))
    >>> targets.shape
    (6, 3)

    Args:
        params: of the networks.
        rhythm: of the CPG, output and adaptation difference of each unit.
        velocity: of the left and the right side, 1 being nominal.
    """
    output, adaptation = rhythm[:, 0], rhythm[:, 1]
    if params.printed_input:
        adaptation = jnp.zeros_like(adaptation)
    inputs = jnp.stack([output, adaptation, jnp.repeat(velocity, LEGS // 2)], axis=1)
    units = jax.nn.relu(jnp.einsum("li,liu->lu", inputs, params.w1) + params.b1)
    return jnp.einsum("lu,luj->lj", units, params.w2) + params.b2


def mirror(params: Params) -> Params:
    """Return the networks of the mirrored robot: those of left and right exchanged, with the coxa angle reversed."""
    joint_signs = jnp.asarray(MIRROR_SIGNS, dtype=params.w2.dtype)  # so that the weights keep their precision
    signs = {"w1": 1.0, "b1": 1.0, "w2": joint_signs, "b2": joint_signs}
    return replace(params, **{name: getattr(params, name)[::-1] * sign for name, sign in signs.items()})


def symmetrise(params: Params) -> Params:
    """Return networks whose right legs mirror the left ones.

    A mirrored rhythm and command then give mirrored targets.
    """
    left = LEGS // 2
    return jax.tree.map(lambda own, image: jnp.concatenate([own[:left], image[left:]]), params, mirror(params))


def save(path: Path | str, params: Params, metadata: Mapping[str, object] | None = None) -> None:
    """Write the networks to a safetensors file in single precision, with `metadata` (JSON values) in its header."""
    weights = {name: np.asarray(getattr(params, name), np.float32) for name in SHAPES}
    storage.save_tensors(path, weights, FILE, {"literal": params.printed_input, **(metadata or {})})


def load(path: Path | str) -> Params:
    """Return the networks that `save` wrote; raise `InputError` for another, damaged or outdated file."""
    weights, metadata = storage.load_tensors(path, FILE)
    storage.check_weights(path, weights, FILE, SHAPES)
    schema.check(HEADER, metadata, f"{path}: header", FILE.remedy)
    arrays = {name: jnp.asarray(weight, dtype=float) for name, weight in weights.items()}
    return Params(**arrays, printed_input=metadata.get("literal") is True)


def read_metadata(path: Path | str) -> JsonObject:
    """Return the metadata in the header of a file that `save` wrote, with its format and version."""
    _, metadata = storage.load_tensors(path, FILE)
    return {"format": FILE.format, "version": FILE.version, **metadata}


def load_pretrained() -> Params:
    """Load the networks of the package, which `experiments/fit_default_gait.py` fitted."""
    return load(SHAPING_FILE)
