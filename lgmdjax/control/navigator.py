"""The navigation controller: a small recurrent network from what two eyes say to a velocity for either side.

| symbol         | name                       | unit              | equation |
| -------------- | -------------------------- | ----------------- | -------- |
| u              | u, left and right          | 1, 0.5..1         | 17       |
| v              | velocity, left and right   | nominal, 0.05 m/s | 17       |
| s^chi          | state (hidden, cell)       | 1                 | 17       |
| chi            | weights                    | 1                 | 17       |

Source: Cizek & Faigl, sec. 3.4 (fig. 7); Hochreiter & Schmidhuber 1997, with the forget gate and the initial
weights of Keras. The network is a flax module, split once into its graph and a dictionary of weights, so that
`step` is a pure function. Inputs are standardised and outputs scaled by constants that come from the training
data and are not trained; they let the network work around zero, as the paper's must have learned to.

| variant           | what it is                                                                          |
| ----------------- | ----------------------------------------------------------------------------------- |
| `lstm`            | the paper's: two inputs, 32 LSTM units with sigmoid gates, two linear outputs       |
| `lstm-efference`  | the same with its own last velocity as two further inputs, as insects have it       |
| `feed-forward`    | 32 tanh units without memory                                                        |
| `mean`            | the mean of the training velocities, whatever the eyes say                          |

The outputs are linear, so they can leave the range of the gait; `braitenberg.limit` brings them back.

A `symmetric` navigator looks at the world and, with a memory of its own, at its mirror image, and does the mean of
what it would do in the one and, mirrored back, in the other:

    f_sym(u) = (f(u) + M f(M u)) / 2,  M (left, right) = (right, left),

so that mirrored u give the mirrored commands, exactly. A fitted network is symmetric only by chance: far off from
everything ours leant to one side; the mean of both has 5 to 9 % less squared error in rooms kept back.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct, traverse_util
from jaxtyping import Array, Float
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from lgmdjax.errors import InputError
from lgmdjax.runtime import versions

Variant = Literal["lstm", "lstm-efference", "feed-forward", "mean"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
UNITS = 32
FORMAT, VERSION = "lgmdjax navigator", "2"
SCALES = ("input_mean", "input_scale", "output_mean", "output_scale")


@struct.dataclass(kw_only=True)
class Params:
    """Weights by layer, and the constants that standardise u and v: means and deviations in the data."""

    weights: dict[str, Any]
    input_mean: Float[Array, "2"]
    input_scale: Float[Array, "2"]
    output_mean: Float[Array, "2"]
    output_scale: Float[Array, "2"]
    variant: Variant = struct.field(pytree_node=False, default="lstm")
    units: int = struct.field(pytree_node=False, default=UNITS)
    symmetric: bool = struct.field(pytree_node=False, default=False)  # shown the mirror image too


@struct.dataclass(kw_only=True)
class State:
    """What the network remembers (s of eq. 17) and the last velocity; variants without memory carry zeros."""

    hidden: Float[Array, "views units"]  # of the world, and of its mirror image if that is shown
    cell: Float[Array, "views units"]
    velocity: Float[Array, "2"]


class _Recurrent(nnx.Module):
    def __init__(self, inputs: int, units: int, rngs: nnx.Rngs):
        self.cell = nnx.OptimizedLSTMCell(inputs, units, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)
        self.head = nnx.Linear(units, 2, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)

    def __call__(self, carry: tuple[Array, Array], inputs: Array) -> tuple[tuple[Array, Array], Array]:
        carry, hidden = self.cell(carry, inputs)
        return carry, self.head(hidden)


class _FeedForward(nnx.Module):
    def __init__(self, units: int, rngs: nnx.Rngs):
        self.layer = nnx.Linear(2, units, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)
        self.head = nnx.Linear(units, 2, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)

    def __call__(self, carry: tuple[Array, Array], inputs: Array) -> tuple[tuple[Array, Array], Array]:
        return carry, self.head(jnp.tanh(self.layer(inputs)))


def create(key: Array, variant: Variant = "lstm", units: int = UNITS, *, symmetric: bool = False) -> Params:
    """Draw an untrained navigator as Keras does: Glorot inputs, orthogonal recurrence, forget bias 1."""
    if variant not in VARIANTS:
        raise InputError(f"navigator variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
    if not isinstance(units, int) or units < 1:
        raise InputError(f"navigator units: expected 1 or more, got {units}; the paper has 32")
    ones = jnp.ones(2)
    return Params(
        weights=_draw(key, variant, units),
        input_mean=0.5 * ones,
        input_scale=0.1 * ones,
        output_mean=1.2 * ones,
        output_scale=ones,
        variant=variant,
        units=units,
        symmetric=symmetric,
    )


def init(params: Params) -> State:
    """Start with nothing remembered, and the mean velocity as the last one."""
    nothing = jnp.zeros((2 if params.symmetric else 1, params.units), params.output_mean.dtype)
    velocity = jnp.mean(_mirrored(params, params.output_mean), axis=0)
    return State(hidden=nothing, cell=nothing, velocity=velocity)


def step(params: Params, state: State, u: Float[Array, "2"]) -> tuple[State, Float[Array, "2"]]:
    """Turn one frame's u into a velocity (eq. 17), and remember both.

    A caller that drives with another velocity than the one returned (limited, or somebody else's) puts it
    into the state's `velocity`, which `lstm-efference` sees next.
    """
    views = jax.vmap(partial(_look, params))
    (cell, hidden), answers = views((state.cell, state.hidden), _mirrored(params, u), _mirrored(params, state.velocity))
    # The answer to the mirror image, the second if there is one, is mirrored back.
    velocity = jnp.mean(answers.at[1:].set(answers[1:, ::-1]), axis=0)
    return State(hidden=hidden, cell=cell, velocity=velocity), velocity


def save(path: Path | str, params: Params, metadata: Mapping[str, Any] | None = None) -> None:
    """Write the navigator as one safetensors file, its variant, versions and `metadata` (JSON) in the header.

    `metadata` is for what the eyes must be like for this network: calibration, camera, room statistics. The
    file is written beside its place and moved there, so that no reader finds half of one.
    """
    path = Path(path)
    tensors = {name: np.asarray(value) for name, value in _tensors(params).items()}
    if not all(np.isfinite(value).all() for value in tensors.values()):
        raise InputError(f"{path}: expected finite weights to save, got some that are not; train again")
    structure = {"variant": params.variant, "units": params.units, "symmetric": params.symmetric}
    header = {**structure, "versions": versions.installed(), **(metadata or {})}
    text = {"format": FORMAT, "version": VERSION} | {name: json.dumps(x) for name, x in header.items()}
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        save_file(tensors, unfinished, text)
        unfinished.replace(path)
    except (OSError, SafetensorError) as error:
        unfinished.unlink(missing_ok=True)
        raise InputError(f"{path}: expected a place to write to, got {error}; choose another") from error


def load(path: Path | str) -> tuple[Params, dict[str, Any]]:
    """Read a navigator that `save` wrote, and its metadata; raise `InputError` for any other file."""
    again = "`lgmdjax train` makes one"
    try:
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise InputError(f"{path}: expected a navigator, got another kind of file; {again}")
            if header.get("version") != VERSION:
                raise InputError(f"{path}: expected version {VERSION}, got {header.get('version')}; {again}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        metadata = {name: json.loads(text) for name, text in header.items() if name not in ("format", "version")}
        structure = (metadata["variant"], metadata["units"])
        template = jax.eval_shape(lambda: create(jax.random.key(0), *structure, symmetric=metadata["symmetric"]))
    except (OSError, SafetensorError, json.JSONDecodeError, KeyError) as error:
        raise InputError(f"{path}: expected a safetensors file of a navigator, got {error}; {again}") from error
    expected = {name: value.shape for name, value in _tensors(template).items()}
    found = {name: value.shape for name, value in tensors.items()}
    if found != expected:
        raise InputError(f"{path}: expected weights {expected}, got {found}; {again}")
    if not all(np.isfinite(value).all() for value in tensors.values()):
        raise InputError(f"{path}: expected finite weights, got some that are not; {again}")
    return _with_tensors(template, tensors), metadata


def _mirrored(params: Params, sides: Float[Array, "2"]) -> Float[Array, "views 2"]:
    """Put something of both sides and its mirror image together, or alone."""
    return jnp.stack([sides, sides[::-1]] if params.symmetric else [sides])


def _look(
    params: Params, memory: tuple[Array, Array], u: Float[Array, "2"], last: Float[Array, "2"]
) -> tuple[tuple[Array, Array], Float[Array, "2"]]:
    """Answer to one view of the world."""
    if params.variant == "mean":
        return memory, params.output_mean
    inputs = (u - params.input_mean) / params.input_scale
    if params.variant == "lstm-efference":
        inputs = jnp.concatenate([inputs, (last - params.output_mean) / params.output_scale])
    network = nnx.merge(_graph(params.variant, params.units), params.weights)
    memory, output = network(memory, inputs)
    return memory, params.output_mean + params.output_scale * output


@lru_cache
def _graph(variant: Variant, units: int) -> nnx.GraphDef:
    """Describe the network without its weights."""
    return nnx.split(nnx.eval_shape(lambda: _network(variant, units, nnx.Rngs(0))))[0]


def _network(variant: Variant, units: int, rngs: nnx.Rngs) -> nnx.Module:
    if variant == "feed-forward":
        return _FeedForward(units, rngs)
    return _Recurrent(4 if variant == "lstm-efference" else 2, units, rngs)


def _draw(key: Array, variant: Variant, units: int) -> dict[str, Any]:
    if variant == "mean":
        return {}
    weights = nnx.to_pure_dict(nnx.split(_network(variant, units, nnx.Rngs(key)))[1])
    weights = jax.tree.map(lambda weight: jnp.asarray(weight, dtype=float), weights)
    if variant != "feed-forward":
        # Gates are input, forget, cell, output. An open forget gate lets early gradients reach far back.
        bias = weights["cell"]["dense_h"]["bias"]
        weights["cell"]["dense_h"]["bias"] = bias.at[units : 2 * units].set(1)
    return weights


def _tensors(params: Params) -> dict[str, Any]:
    """List weights and scales by name."""
    weights = traverse_util.flatten_dict({"weights": params.weights}, sep=".")
    return {name: getattr(params, name) for name in SCALES} | {str(name): w for name, w in weights.items()}


def _with_tensors(params: Params, tensors: Mapping[str, np.ndarray]) -> Params:
    arrays = {name: jnp.asarray(value, dtype=float) for name, value in tensors.items()}
    scales = {name: arrays.pop(name) for name in SCALES}
    weights = traverse_util.unflatten_dict(arrays, sep=".").get("weights", {})
    return replace(params, weights=weights, **scales)
