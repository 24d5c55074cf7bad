"""Fit the navigator to recorded walks by truncated back-propagation through time.

The segments of the walks are concatenated and cut into parallel streams (`lgmdjax.learning.sequences`), so that a
network of 32 units makes full use of a processor. Each window of frames is one step of RMSprop. The recurrent state
is carried into the next window without its gradient, and is reset where a segment or a stream begins.

| symbol | name                | unit              | equation                                  |
| ------ | ------------------- | ----------------- | ----------------------------------------- |
| u      | walk.u              | 1                 | 17                                        |
| v      | walk.label          | nominal, 0.05 m/s | 17, 22                                    |
| -      | walk.velocity       | nominal           | the command that the robot walked with    |
| MSE    | train_mse, test_mse | nominal^2         | sec. 5.1; mean over frames and both sides |

Source: Cizek & Faigl, sec. 3.4, 4.2 and 5.1: RMSprop, mean squared error, 1000 epochs, data split in half.

Windows, streams and `mirrored` are our additions. The two hemifields are mirror images of each other, so every walk is
also a walk in the mirrored room, with left and right exchanged. A network fitted to both is then made `symmetric`: its
output becomes the mean of both views. During the fit it sees one view, since it then overfits less:

| fitted as          | correlation of its turns with the labels, held-out rooms |
| ------------------ | -------------------------------------------------------- |
| one view           | 0.68                                                     |
| mean of both views | 0.61                                                     |
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PyTree
from tqdm.auto import tqdm

from lgmdjax.control import navigator
from lgmdjax.errors import InputError
from lgmdjax.learning.checkpoints import Checkpoints, resumable
from lgmdjax.learning.sequences import SequenceBatch, pack
from lgmdjax.runtime import checksums, distributed, tracking
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import finite, sharding
from lgmdjax.simulation.episodes import Walk

TURN_GAIN = 1.5
"""How much harder a navigator turns than its teacher. For one network, over 120 m in held-out rooms:

| turn gain | collisions per 100 m | distance in the same time |
| --------- | -------------------- | ------------------------- |
| 1.0       | 8.4                  | 100 %                     |
| 1.6       | 0.9                  | 90 %                      |
| 2.5       | 2.6                  | 63 %                      |
"""

SAVE_EVERY = 10.0  # s between checkpoints; writing one takes as long as some epochs


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a fit. Values that the paper gives are the paper's."""

    epochs: int = 1000
    learning_rate: float = 1e-2  # at the first window; decays to zero along half a cosine
    clip: float = 1.0  # largest norm of a gradient
    window: int = 60  # frames of back-propagation through time: 2 s, two steps of the gait
    streams: int = 64  # parallel sequences
    mirrored: bool = True  # add the mirror image of every walk
    command_feedback: bool = False  # the efference copy is walk.velocity, not the network's own last output


@struct.dataclass(kw_only=True)
class Progress:
    """The state of a fit between two epochs; checkpoints have these names on disk."""

    weights: PyTree
    optimiser: optax.OptState
    best: PyTree  # weights with the lowest test error so far
    epoch: Int[Array, ""]
    train: Float[Array, "epochs"]  # MSE of the training data during each epoch, nan for later epochs
    test: Float[Array, "epochs"]  # MSE of the test data after each epoch


@dataclass(frozen=True, kw_only=True)
class FitResult:
    """The navigator after the last epoch, the best one on the test data, and the two curves of fig. 11."""

    params: navigator.Params
    best: navigator.Params
    train_mse: Float[np.ndarray, "epochs"]
    test_mse: Float[np.ndarray, "epochs"]


def standardise(params: navigator.Params, walks: Sequence[Walk], mirrored: bool = True) -> navigator.Params:
    """Set input and output scaling to mean and deviation of u and of the labels, equal for both sides if mirrored."""
    u, label = (np.concatenate([getattr(walk, name) for walk in walks]) for name in ("u", "label"))
    u, label = (np.concatenate([x, x[:, ::-1]]) if mirrored else x for x in (u, label))
    as_array = partial(jnp.asarray, dtype=float)
    return replace(
        params,
        input_mean=as_array(u.mean(0)),
        input_scale=as_array(np.maximum(u.std(0), 1e-3)),  # a constant u must not be amplified
        output_mean=as_array(label.mean(0)),
        output_scale=as_array(np.maximum(label.std(0), 1e-3)),
    )


def fit(
    params: navigator.Params,
    train: Sequence[Walk],
    test: Sequence[Walk],
    settings: Settings | None = None,
    *,
    checkpoints: Path | str | None = None,
    show_progress: bool = True,
) -> FitResult:
    """Fit the weights to the labels of `train`; measure the error on `test` after every epoch.

    Args:
        params: an untrained navigator; its scaling is set from `train`.
        train: segments to fit to.
        test: segments for the second curve and for the choice of `best`.
        settings: the defaults if None. `command_feedback` suits walks that the network itself controlled. On the
            teacher's walks a network with it only learns to repeat the last label, which is nearly the next one.
        checkpoints: folder to save progress in and to resume from; the result is the same, bit for bit.
        show_progress: show a progress bar.
    """
    settings = _require_sound(settings or Settings(), train, test)
    params = replace(standardise(params, train, settings.mirrored), symmetric=False)
    params = distributed.share_arrays("fit: start", params)
    data = _pack(params, train, settings), _pack(params, test, settings)
    initial = _initial_progress(params, settings)
    if checkpoints is None:
        progress = _run_epochs(params, initial, data, settings, checkpoints=None, show_progress=show_progress)
    else:
        with closing(Checkpoints(checkpoints, _identity(initial, data, settings))) as saved:
            progress = _run_epochs(params, initial, data, settings, checkpoints=saved, show_progress=show_progress)
    fitted = replace(params, symmetric=settings.mirrored)
    return FitResult(
        params=replace(fitted, weights=progress.weights),
        best=replace(fitted, weights=progress.best),
        train_mse=np.asarray(progress.train),
        test_mse=np.asarray(progress.test),
    )


def predict(params: navigator.Params, walks: Sequence[Walk]) -> list[Float[np.ndarray, "frames 2"]]:
    """Return the navigator's velocities for the u of each segment, from a reset state, with its own feedback."""
    frames = max(len(walk) for walk in walks)
    u = np.stack([np.pad(walk.u, ((0, frames - len(walk)), (0, 0)), mode="edge") for walk in walks])
    velocities = np.asarray(_predict_batch(params, jnp.asarray(u, dtype=float)))
    return [velocity[: len(walk)] for walk, velocity in zip(walks, velocities, strict=True)]


def rescale_turns(
    params: navigator.Params, walks: Sequence[Walk], turn_gain: float = TURN_GAIN, max_scale: float = 2.5
) -> navigator.Params:
    """Scale the outputs about their mean so that the navigator's turns vary `turn_gain` times as much as the labels'.

    A network with the lowest mean squared error turns too little: where it is uncertain it stays near the mean, and a
    robot that turns half as hard as it should collides. Errors also differ in cost: an unnecessary turn costs a little
    time, a missing one a collision. `output_scale` is multiplied by `turn_gain` times the ratio std(turns of the
    labels) / std(turns predicted), which is clipped to 1..`max_scale`.
    """
    predicted, label = np.concatenate(predict(params, walks)), np.concatenate([walk.label for walk in walks])
    wanted, actual = (float(np.std(v[:, 1] - v[:, 0])) for v in (label, predicted))
    factor = turn_gain * float(np.clip(wanted / max(actual, 1e-6), 1.0, max_scale))
    return replace(params, output_scale=params.output_scale * factor)


def score(params: navigator.Params, walks: Sequence[Walk]) -> JsonObject:
    """Compare predictions with labels: MSE, R2 of each side, correlation of the turns v_right - v_left."""
    predicted = np.concatenate(predict(params, walks)).astype(float)
    label = np.concatenate([walk.label for walk in walks]).astype(float)
    error = np.mean((predicted - label) ** 2, axis=0)
    turns = np.stack([v[:, 1] - v[:, 0] for v in (predicted, label)])
    varied = np.all(turns.std(axis=1) > 1e-9)
    return {
        "mse": float(error.mean()),
        "r2": (1 - error / np.maximum(label.var(axis=0), 1e-12)).tolist(),
        "steering": float(np.corrcoef(turns)[0, 1]) if varied else 0.0,
    }


def score_variants(navigators: Mapping[str, navigator.Params], walks: Mapping[str, Sequence[Walk]]) -> list[JsonObject]:
    """Score every navigator on every set of walks: one row each, with columns such as `test_mse`, `unseen_r2`."""
    rows = []
    for variant, params in navigators.items():
        scores = {name: score(params, some) for name, some in walks.items()}
        columns = {f"{name}_{key}": value for name, s in scores.items() for key, value in s.items()}
        rows.append({"variant": variant, **columns})
    return rows


def window_loss(
    params: navigator.Params, weights: PyTree, states: navigator.State, batch: SequenceBatch, *, command_feedback: bool
) -> tuple[Array, navigator.State]:
    """Run the network over one window; return its MSE, and the states after the window."""
    squares, states = window_squares(params, weights, states, batch, command_feedback=command_feedback)
    return squares / (2 * jnp.maximum(jnp.sum(batch.mask), 1.0)), states


def window_squares(
    params: navigator.Params, weights: PyTree, states: navigator.State, batch: SequenceBatch, *, command_feedback: bool
) -> tuple[Array, navigator.State]:
    """Run the network over one window; return the sum of its squared errors, and the states after the window."""
    executed = batch.previous_velocity if command_feedback else None
    states, velocity = navigator.run(replace(params, weights=weights), states, batch.u, batch.is_first, executed)
    return jnp.sum(batch.mask[..., None] * (velocity - batch.label) ** 2), states


def _run_epochs(
    params: navigator.Params,
    initial: Progress,
    data: tuple[SequenceBatch, SequenceBatch],
    settings: Settings,
    *,
    checkpoints: Checkpoints | None,
    show_progress: bool,
) -> Progress:
    """Run the remaining epochs, a hundredth of all epochs in one call, with a progress bar."""

    streams = data[0].is_first.shape[-1]
    divided, shared = sharding.divide_streams(data, streams, axis=2), sharding.replicate(params, streams)

    def advance(progress: Progress, epoch: int, end: int) -> Progress:
        progress = _train_epochs(shared, sharding.replicate(progress, streams), divided, end - epoch, settings)
        # Through the host, since the result is on all devices, and checkpoints and callers expect it on one.
        return jax.tree.map(jnp.asarray, jax.device_get(progress))

    total = settings.epochs
    steps = resumable(advance, initial, checkpoints, total=total, chunk=max(1, total // 100), interval=SAVE_EVERY)
    done, progress = next(steps)
    name = params.variant if checkpoints is None else tracking.name_fit(checkpoints.folder)
    with tqdm(total=total, initial=done, desc=params.variant, unit="epoch", disable=not show_progress) as bar:
        for epoch, progress in steps:
            bar.set_postfix(mse=f"{progress.train[epoch - 1]:.4f}", test=f"{progress.test[epoch - 1]:.4f}")
            bar.update(epoch - done)
            for number in range(done, epoch) if tracking.has_listener() else ():
                curves = {"train_mse": progress.train[number], "test_mse": progress.test[number]}
                tracking.log(number + 1, {f"{name}/{curve}": float(value) for curve, value in curves.items()})
            done = epoch
    return progress


@partial(jax.jit, static_argnames="settings")
def _train_epochs(
    params: navigator.Params,
    progress: Progress,
    data: tuple[SequenceBatch, SequenceBatch],
    epochs: Int[Array, ""] | int,
    settings: Settings,
) -> Progress:
    """Train for some epochs, with the streams over all devices; one program serves any number of epochs."""

    def train(
        data: tuple[SequenceBatch, SequenceBatch], params: navigator.Params, progress: Progress, epochs: Array
    ) -> Progress:
        return jax.lax.fori_loop(0, epochs, lambda _, p: _train_epoch(params, p, *data, settings), progress)

    return sharding.shard_streams(train, data, (params, progress, jnp.asarray(epochs)), axis=2)


def _train_epoch(
    params: navigator.Params, progress: Progress, train: SequenceBatch, test: SequenceBatch, settings: Settings
) -> Progress:
    optimiser = _optimiser(settings, len(train.u))
    loss = partial(window_squares, params, command_feedback=settings.command_feedback)

    def window(carry: tuple[PyTree, optax.OptState, navigator.State], batch: SequenceBatch):
        weights, memory, states = carry
        (squares, states), gradient = jax.value_and_grad(loss, has_aux=True)(weights, states, batch)
        squares, frames, gradient = sharding.sum_over_devices((squares, jnp.sum(batch.mask), gradient))
        gradient = jax.tree.map(lambda g: g / (2 * jnp.maximum(frames, 1.0)), gradient)
        updates, memory = optimiser.update(gradient, memory)
        return (optax.apply_updates(weights, updates), memory, states), (squares, frames)

    carry = progress.weights, progress.optimiser, _init_states(params, train)
    (weights, memory, _), (squares, frames) = jax.lax.scan(window, carry, train)
    error = _batch_mse(replace(params, weights=weights), test)
    # The first epoch has no earlier error to compare with; nan is never better.
    better = (error < jnp.nanmin(progress.test)) | (progress.epoch == 0)
    return Progress(
        weights=weights,
        optimiser=memory,
        best=jax.tree.map(lambda new, old: jnp.where(better, new, old), weights, progress.best),
        epoch=progress.epoch + 1,
        train=progress.train.at[progress.epoch].set(jnp.sum(squares) / (2 * jnp.sum(frames))),
        test=progress.test.at[progress.epoch].set(error),
    )


def _batch_mse(params: navigator.Params, batch: SequenceBatch) -> Float[Array, ""]:
    """Return the MSE over all windows of a batch."""

    def window(states: navigator.State, batch: SequenceBatch) -> tuple[navigator.State, Array]:
        squares, states = window_squares(params, params.weights, states, batch, command_feedback=False)
        return states, squares

    _, squares = jax.lax.scan(window, _init_states(params, batch), batch)
    squares, frames = sharding.sum_over_devices((jnp.sum(squares), jnp.sum(batch.mask)))
    return squares / (2 * frames)


@jax.jit
def _predict_batch(params: navigator.Params, u: Float[Array, "walks frames 2"]) -> Float[Array, "walks frames 2"]:
    walk = lambda u: jax.lax.scan(partial(navigator.step, params), navigator.init(params), u)[1]  # noqa: E731
    return jax.vmap(walk)(u)


def _optimiser(settings: Settings, windows: int) -> optax.GradientTransformation:
    """Return Keras's RMSprop with a decaying rate; a constant 1e-3 gives a fifth more error after 60 epochs."""
    rate = optax.cosine_decay_schedule(settings.learning_rate, settings.epochs * windows)
    return optax.chain(optax.clip_by_global_norm(settings.clip), optax.rmsprop(rate, decay=0.9, eps=1e-7))


def _initial_progress(params: navigator.Params, settings: Settings) -> Progress:
    unknown = jnp.full(settings.epochs, jnp.nan)
    return Progress(
        weights=params.weights,
        optimiser=_optimiser(settings, 1).init(params.weights),
        best=params.weights,
        epoch=jnp.asarray(0, jnp.int32),
        train=unknown,
        test=unknown,
    )


def _init_states(params: navigator.Params, batch: SequenceBatch) -> navigator.State:
    """Return one initial state per stream."""
    return jax.vmap(lambda _: navigator.init(params))(jnp.arange(batch.is_first.shape[-1]))


def _pack(params: navigator.Params, walks: Sequence[Walk], settings: Settings) -> SequenceBatch:
    mean = np.asarray(params.output_mean)
    return pack(walks, mean, streams=settings.streams, window=settings.window, mirrored=settings.mirrored)


def _require_sound(settings: Settings, train: Sequence[Walk], test: Sequence[Walk]) -> Settings:
    """Return the settings; raise `InputError` for settings out of range and for data missing or not finite."""
    for name in ("epochs", "window", "streams"):
        if getattr(settings, name) < 1:
            raise InputError(f"training {name}: expected 1 or more, got {getattr(settings, name)}")
    if not 0 < settings.learning_rate < math.inf:
        raise InputError(f"training learning_rate: expected a positive number, got {settings.learning_rate}")
    for name, walks in (("train", train), ("test", test)):
        if sum(len(walk) for walk in walks) < 2:
            raise InputError(f"training: expected frames to {name} on, got none; collect longer walks")
        if not all(finite.find_finite(walk).all() for walk in walks):
            raise InputError(f"training: expected finite walks to {name} on, got nan or infinity; collect them again")
    return settings


def _identity(initial: Progress, data: tuple[SequenceBatch, SequenceBatch], settings: Settings) -> JsonObject:
    """Return what distinguishes this fit from any other: its settings, data and initial weights.

    Only the signs of the weights are used. Their last digits depend on the processor, since some are made orthogonal by
    a matrix decomposition, and a fit may be continued on another computer.
    """

    def digest(tree: PyTree) -> str:
        return checksums.digest(*(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)))

    signs = jax.tree.map(lambda leaf: np.packbits(np.signbit(leaf)), initial.weights)

    names = asdict(settings)
    names["told"] = names.pop("command_feedback")  # its name on disk
    hashes = {
        "training data": digest(data[0]),
        "test data": digest(data[1]),
        "signs of the first weights": digest(signs),
    }
    return names | hashes
