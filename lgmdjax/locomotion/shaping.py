"""Shaping networks: one a leg, from the CPG unit's rhythm and the side's velocity to three joint angles.

Six rectified units and a linear output, as the paper has it, but for one more input: the unit's adaptation
difference. From the output u_e - u_f alone a static map can only trace an open curve back and forth; fitted
so (`literal`), the robot hardly walks. With the adaptation difference the two make a closed loop, from which
stance and swing differ.

| symbol         | name          | unit             | equation  |
| -------------- | ------------- | ---------------- | --------- |
| CPG_i          | rhythm[i, 0]  | 1                | 6         |
| v^e - v^f      | rhythm[i, 1]  | 1                | 2, 4      |
| v^left, right  | velocity      | nominal velocity | sec. 3.2  |
| -              | targets       | rad              | sec. 3.2  |

Source: Cizek & Faigl, sec. 3.2. The networks are taught by `lgmdjax.locomotion.gait_fit.teach`.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialise

from lgmdjax.errors import InputError
from lgmdjax.paths import SHAPING

LEGS, INPUTS, UNITS, JOINTS = 6, 3, 6, 3
SLOWEST, FASTEST = -1.0, 2.0  # the range of velocities that the networks are taught, and so what the legs can do
FORMAT, VERSION = "lgmdjax.shaping", "1"
SHAPES = {
    "w1": (LEGS, INPUTS, UNITS),
    "b1": (LEGS, UNITS),
    "w2": (LEGS, UNITS, JOINTS),
    "b2": (LEGS, JOINTS),
}
COXA_REVERSED = np.array([-1.0, 1.0, 1.0])  # joint angles seen in a mirror; legs go round the body, so their order too


@struct.dataclass(kw_only=True)
class Params:
    """Weights of the six networks; inputs are output, adaptation difference and velocity, outputs radians."""

    w1: Float[Array, "6 3 6"]
    b1: Float[Array, "6 6"]
    w2: Float[Array, "6 6 3"]
    b2: Float[Array, "6 3"]
    literal: bool = struct.field(pytree_node=False, default=False)  # the paper's input: no adaptation difference


def init(key: Array, *, literal: bool = False) -> Params:
    """Draw untaught networks: weights of the size that suits inputs and angles of order one, no biases."""
    first, second = jax.random.split(key)
    return Params(
        w1=jax.random.normal(first, SHAPES["w1"], dtype=float) / np.sqrt(INPUTS),
        b1=jnp.zeros(SHAPES["b1"]),
        w2=jax.random.normal(second, SHAPES["w2"], dtype=float) / np.sqrt(UNITS),
        b2=jnp.zeros(SHAPES["b2"]),
        literal=literal,
    )


def shape(params: Params, rhythm: Float[Array, "6 2"], velocity: Float[Array, "2"]) -> Float[Array, "6 3"]:
    """Map the rhythm and the velocities (left, right) to joint targets [rad], a leg a row.

    The velocity acts at once. Beyond the taught range, [-1, 2], the networks go on linearly: limit it before.

    Gradient: exact almost everywhere; zero through a unit that is silent, and in `literal` networks through
    the adaptation difference and its weights.
    """
    output, adaptation = rhythm[:, 0], rhythm[:, 1]
    if params.literal:
        adaptation = jnp.zeros_like(adaptation)
    inputs = jnp.stack([output, adaptation, jnp.repeat(velocity, LEGS // 2)], axis=1)
    units = jax.nn.relu(jnp.einsum("li,liu->lu", inputs, params.w1) + params.b1)
    return jnp.einsum("lu,luj->lj", units, params.w2) + params.b2


def mirror(params: Params) -> Params:
    """Exchange the networks of left and right: what they give is the mirror image."""
    reversed_coxa = jnp.asarray(COXA_REVERSED, dtype=params.w2.dtype)  # the networks keep their precision
    signs = {"w1": 1.0, "b1": 1.0, "w2": reversed_coxa, "b2": reversed_coxa}
    return replace(params, **{name: getattr(params, name)[::-1] * sign for name, sign in signs.items()})


def symmetric(params: Params) -> Params:
    """Give the right legs the left ones' networks, mirrored: a mirrored rhythm and command give mirrored targets."""
    left = LEGS // 2
    return jax.tree.map(lambda own, image: jnp.concatenate([own[:left], image[left:]]), params, mirror(params))


def save(path: Path | str, params: Params, metadata: Mapping[str, object] | None = None) -> None:
    """Write the networks as one safetensors file in single precision, `metadata` (JSON values) in its header.

    The file is written beside its place and moved there, so that no reader finds half of one.
    """
    path = Path(path)
    header = {"format": FORMAT, "version": VERSION, "literal": json.dumps(params.literal)}
    header |= {name: json.dumps(value) for name, value in (metadata or {}).items()}
    partial = path.with_name(path.name + ".part")
    weights = {name: np.asarray(getattr(params, name), np.float32) for name in SHAPES}
    try:
        partial.write_bytes(serialise(weights, header))
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: expected a place to write to, got {error.strerror}; choose another") from error


def load(path: Path | str) -> Params:
    """Read networks that `save` wrote; raise `InputError` for another, damaged or outdated file."""
    again = "`lgmdjax fit-gait` makes one"
    try:
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise InputError(f"{path}: expected shaping networks, got another kind of file; {again}")
            if header.get("version") != VERSION:
                raise InputError(f"{path}: expected version {VERSION}, got {header.get('version')}; {again}")
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: expected safetensors with shaping networks, got {error}; {again}") from error
    found = {name: weight.shape for name, weight in weights.items()}
    if found != SHAPES:
        raise InputError(f"{path}: expected weights {SHAPES}, got {found}; {again}")
    if not all(np.isfinite(weight).all() for weight in weights.values()):
        raise InputError(f"{path}: expected finite weights, got some that are not; {again}")
    arrays = {name: jnp.asarray(weight, dtype=float) for name, weight in weights.items()}
    return Params(**arrays, literal=header.get("literal") == "true")


def metadata(path: Path | str) -> dict[str, object]:
    """Read what a file of networks says about itself."""
    load(path)
    with safe_open(path, framework="numpy") as file:
        header = dict(file.metadata())
    return {name: value if name in ("format", "version") else json.loads(value) for name, value in header.items()}


def taught() -> Params:
    """Load the networks that come with the package, as `experiments/teach_gait.py` made them."""
    return load(SHAPING)
