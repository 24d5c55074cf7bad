"""The navigator: a small recurrent network from the outputs of both LGMDs to left and right velocity.

| symbol         | name                       | unit              | equation |
| -------------- | -------------------------- | ----------------- | -------- |
| u              | u, left and right          | 1, 0.5..1         | 17       |
| v              | velocity, left and right   | nominal, 0.05 m/s | 17       |
| s^chi          | state (hidden, cell)       | 1                 | 17       |
| chi            | weights                    | 1                 | 17       |

Source: Cizek & Faigl, sec. 3.4 (fig. 7); Hochreiter & Schmidhuber 1997, with the forget gate and the initial
weights of Keras. `step` is one frame of the closed loop, `run` many frames of parallel walks with a fast derivative;
the equations of their cell are in `lgmdjax.control.lstm`. Inputs are standardised and outputs rescaled by constants of
the training data, which are not trained. The network then works around zero; the paper's network must have learned the
offsets and scales.

| variant           | what it is                                                                            |
| ----------------- | ------------------------------------------------------------------------------------- |
| `lstm`            | the paper's: two inputs, 32 LSTM units with sigmoid gates, two linear outputs         |
| `lstm-efference`  | the same with its last velocity as two further inputs (efference copy, as in insects) |
| `feed-forward`    | 32 tanh units without memory                                                          |
| `mean`            | the mean of the training velocities, whatever u is                                    |

The outputs are linear, so they can leave the range of the gait; `braitenberg.limit` brings them back.

A `symmetric` navigator also runs on the mirror image, with a separate memory, and averages both outputs:

    f_sym(u) = (f(u) + M f(M u)) / 2,  M (left, right) = (right, left),

so that mirrored u give exactly the mirrored velocities. A fitted network by itself is only approximately symmetric: far
from all obstacles ours turned to one side. The average has 5 to 9 % less squared error in held-out rooms.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct, traverse_util
from jaxtyping import Array, Bool, Float, PyTree

from lgmdjax.control import lstm
from lgmdjax.control.names import VARIANTS, Variant
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.runtime import schema, storage, versions
from lgmdjax.runtime.storage import JsonObject

UNITS = 32
FILE = storage.TensorFile(
    format="lgmdjax navigator", version="2", name="a navigator", remedy="`lgmdjax train` makes one"
)
RECURRENT = ("lstm", "lstm-efference")
HEADER = schema.Object({"variant": schema.Text(VARIANTS), "units": schema.Integer(1, 4096), "symmetric": schema.Flag()})
SCALE = schema.Numbers((2,), 1e-6, storage.MAX_WEIGHT)  # inputs are divided by it
SCALES = ("input_mean", "input_scale", "output_mean", "output_scale")


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Weights by layer, and means and standard deviations of u and v in the training data."""

    weights: dict[str, PyTree]
    input_mean: Float[Array, "2"]
    input_scale: Float[Array, "2"]
    output_mean: Float[Array, "2"]
    output_scale: Float[Array, "2"]
    variant: Variant = struct.field(pytree_node=False, default="lstm")
    units: int = struct.field(pytree_node=False, default=UNITS)
    symmetric: bool = struct.field(pytree_node=False, default=False)  # also run on the mirror image


@struct.dataclass(kw_only=True)
class State:
    """Memory of the network (s of eq. 17) and the last velocity; variants without memory carry zeros."""

    hidden: Float[Array, "views units"]  # views: the scene, and its mirror image if symmetric
    cell: Float[Array, "views units"]
    velocity: Float[Array, "2"]


class _Recurrent(nnx.Module):
    def __init__(self, inputs: int, units: int, rngs: nnx.Rngs):
        self.cell = nnx.OptimizedLSTMCell(inputs, units, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)
        self.head = nnx.Linear(units, 2, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)


class _FeedForward(nnx.Module):
    def __init__(self, units: int, rngs: nnx.Rngs):
        self.layer = nnx.Linear(2, units, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)
        self.head = nnx.Linear(units, 2, kernel_init=jax.nn.initializers.glorot_uniform(), rngs=rngs)


def create(key: Array, variant: Variant = "lstm", units: int = UNITS, *, symmetric: bool = False) -> Params:
    """Return an untrained navigator, initialised as in Keras: Glorot inputs, orthogonal recurrence, forget bias 1.

    >>> params = create(jax.random.key(0), "feed-forward", units=8)
    >>> sum(leaf.size for leaf in jax.tree.leaves(params.weights))
    42
    """
    if variant not in VARIANTS:
        raise InputError(f"navigator variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
    if not isinstance(units, int) or units < 1:
        raise InputError(f"navigator units: expected 1 or more, got {units}; the paper has 32")
    ones = jnp.ones(2)
    return Params(
        weights=_sample_weights(key, variant, units),
        input_mean=0.5 * ones,
        input_scale=0.1 * ones,
        output_mean=1.2 * ones,
        output_scale=ones,
        variant=variant,
        units=units,
        symmetric=symmetric,
    )


def init(params: Params) -> State:
    """Return a state with empty memory and the mean velocity as the last one."""
    empty = jnp.zeros((2 if params.symmetric else 1, params.units), params.output_mean.dtype)
    velocity = jnp.mean(_views(params, params.output_mean), axis=0)
    return State(hidden=empty, cell=empty, velocity=velocity)


def step(params: Params, state: State, u: Float[Array, "2"]) -> tuple[State, Float[Array, "2"]]:
    """Return the velocity for the u of one frame (eq. 17), and the next state.

    If the robot executes another velocity than the returned one (a limited one, or another policy's), the caller must
    put it into the state's `velocity`, the next input of `lstm-efference`.
    """
    inputs = _inputs(params, u, state.velocity)
    memory = lstm.Memory(hidden=state.hidden, cell=state.cell)
    if params.variant in RECURRENT:
        memory, _ = lstm.step(_recurrence(params), memory, _drive(params, inputs))
    velocity = _velocity(params, inputs, memory.hidden)
    return State(hidden=memory.hidden, cell=memory.cell, velocity=velocity), velocity


def run(
    params: Params,
    states: State,
    u: Float[Array, "frames streams 2"],
    is_first: Bool[Array, "frames streams"],
    executed: Float[Array, "frames streams 2"] | None = None,
) -> tuple[State, Float[Array, "frames streams 2"]]:
    """Return the velocities of parallel streams, and their states after the last frame: many calls of `step` in one.

    Args:
        params: of all streams.
        states: before the first frame, with a leading axis of streams.
        u: of every frame.
        is_first: whether a stream starts again from the initial state with this frame.
        executed: the velocity executed before each frame, an input of `lstm-efference`; the network's own if None.
    """
    if params.variant == "lstm-efference" and executed is None:
        return _run_stepwise(params, states, u, is_first)
    last = jnp.where(is_first[..., None], init(params).velocity, 0 if executed is None else executed)
    inputs = _inputs(params, u, last)
    memories = lstm.Memory(hidden=states.hidden[None], cell=states.cell[None])
    if params.variant in RECURRENT:
        memory, drive = lstm.Memory(hidden=states.hidden, cell=states.cell), _drive(params, inputs)
        memories = lstm.scan(_recurrence(params), memory, drive, is_first[..., None])
    velocity = _velocity(params, inputs, memories.hidden)
    return State(hidden=memories.hidden[-1], cell=memories.cell[-1], velocity=velocity[-1]), velocity


def save(path: Path | str, params: Params, metadata: JsonObject | None = None) -> None:
    """Write the navigator as one safetensors file, with its variant, versions and `metadata` (JSON) in the header.

    `metadata` says with which camera and detector the network was trained, and in which rooms.
    """
    structure = {"variant": params.variant, "units": params.units, "symmetric": params.symmetric}
    tensors = {name: np.asarray(value) for name, value in _tensors(params).items()}
    storage.save_tensors(path, tensors, FILE, {**structure, "versions": versions.installed(), **(metadata or {})})


def load(path: Path | str) -> tuple[Params, JsonObject]:
    """Read a navigator that `save` wrote, and its metadata; raise `InputError` for any other file."""
    tensors, metadata = storage.load_tensors(path, FILE)
    schema.check(HEADER, metadata, f"{path}: header", FILE.remedy)
    variant, units, symmetric = (metadata[name] for name in HEADER.fields)
    template = jax.eval_shape(lambda: create(jax.random.key(0), variant, units, symmetric=symmetric))
    shapes = {name: value.shape for name, value in _tensors(template).items()}
    storage.check_weights(path, tensors, FILE, shapes)
    for name in ("input_scale", "output_scale"):
        schema.check(SCALE, tensors[name], f"{path}: {name}", FILE.remedy)
    return _with_tensors(template, tensors), metadata


def _run_stepwise(params: Params, states: State, u: Array, is_first: Array) -> tuple[State, Array]:
    """Compute `run` frame by frame, for networks whose last output is an input."""
    initial = init(params)

    def frame(state: State, now: tuple[Array, Array]) -> tuple[State, Array]:
        u, is_first = now
        return step(params, jax.tree.map(partial(jnp.where, is_first), initial, state), u)

    return jax.lax.scan(jax.vmap(frame), states, (u, is_first))


def _views(params: Params, sides: Float[Array, "*frames 2"]) -> Float[Array, "*frames views 2"]:
    """Stack (left, right) pairs and, if symmetric, their mirror images."""
    return jnp.stack([sides, sides[..., ::-1]] if params.symmetric else [sides], axis=-2)


def _inputs(
    params: Params, u: Float[Array, "*frames 2"], last: Float[Array, "*frames 2"]
) -> Float[Array, "*frames views inputs"]:
    """Return the standardised inputs of the network for each view of the scene."""
    inputs = (_views(params, u) - params.input_mean) / params.input_scale
    if params.variant == "lstm-efference":
        last = (_views(params, last) - params.output_mean) / params.output_scale
        inputs = jnp.concatenate([inputs, last], axis=-1)
    return inputs


def _drive(params: Params, inputs: Float[Array, "*frames inputs"]) -> Float[Array, "*frames gates"]:
    cell = params.weights["cell"]
    return inputs @ cell["dense_i"]["kernel"] + cell["dense_h"]["bias"]


def _recurrence(params: Params) -> Float[Array, "units gates"]:
    return params.weights["cell"]["dense_h"]["kernel"]


def _velocity(
    params: Params, inputs: Float[Array, "*frames views inputs"], hidden: Float[Array, "*_ views units"]
) -> Float[Array, "*frames 2"]:
    """Return the output of the network in units of velocity, averaged over the views."""
    if params.variant == "mean":
        outputs = jnp.zeros((*inputs.shape[:-1], 2), inputs.dtype)
    else:
        outputs = _features(params, inputs, hidden) @ params.weights["head"]["kernel"] + params.weights["head"]["bias"]
    views = params.output_mean + params.output_scale * outputs
    # The second view, if there is one, is of the mirror image and is mirrored back.
    return jnp.mean(views.at[..., 1:, :].set(views[..., 1:, ::-1]), axis=-2)


def _features(
    params: Params, inputs: Float[Array, "*frames views inputs"], hidden: Float[Array, "*_ views units"]
) -> Float[Array, "*frames views units"]:
    """Return the input of the last layer: the hidden state of the LSTM, or the units without memory."""
    if params.variant == "feed-forward":
        return jnp.tanh(inputs @ params.weights["layer"]["kernel"] + params.weights["layer"]["bias"])
    return hidden


def _network(variant: Variant, units: int, rngs: nnx.Rngs) -> nnx.Module:
    if variant == "feed-forward":
        return _FeedForward(units, rngs)
    return _Recurrent(4 if variant == "lstm-efference" else 2, units, rngs)


def _sample_weights(key: Array, variant: Variant, units: int) -> dict[str, PyTree]:
    if variant == "mean":
        return {}
    weights = nnx.to_pure_dict(nnx.split(_network(variant, units, nnx.Rngs(key)))[1])
    weights = jax.tree.map(lambda weight: jnp.asarray(weight, dtype=float), weights)
    if variant in RECURRENT:
        # The gates are input, forget, cell, output. With forget bias 1 the first gradients reach far back in time.
        bias = weights["cell"]["dense_h"]["bias"]
        weights["cell"]["dense_h"]["bias"] = bias.at[units : 2 * units].set(1)
    return weights


def _tensors(params: Params) -> dict[str, PyTree]:
    """Return weights and scales by name."""
    weights = traverse_util.flatten_dict({"weights": params.weights}, sep=".")
    return {name: getattr(params, name) for name in SCALES} | {str(name): w for name, w in weights.items()}


def _with_tensors(params: Params, tensors: Mapping[str, np.ndarray]) -> Params:
    arrays = {name: jnp.asarray(value, dtype=float) for name, value in tensors.items()}
    scales = {name: arrays.pop(name) for name in SCALES}
    weights = traverse_util.unflatten_dict(arrays, sep=".").get("weights", {})
    return replace(params, weights=weights, **scales)
