"""Fits of the navigator to recorded walks: back-propagation through time over windows, the state carried on.

Stretches of walking lie end to end on a tape (`lgmdjax.learning.sequences`), cut into streams that are walked side by
side, so that a network of 32 units fills a processor. A window of frames is one step of RMSprop; the state goes on
into the next window, without its gradient, and starts anew where a stretch or a stream starts.

| symbol | name          | unit              | equation                                    |
| ------ | ------------- | ----------------- | ------------------------------------------- |
| u      | walk.u        | 1                 | 17                                          |
| v      | walk.label    | nominal, 0.05 m/s | 17, 22                                      |
| -      | walk.velocity | nominal           | what the robot was told, whoever drove      |
| MSE    | train, test   | nominal^2         | sec. 5.1; mean over frames and both sides   |

Source: Cizek & Faigl, sec. 3.4, 4.2 and 5.1: RMSprop, mean squared error, 1000 epochs, data split in half.
Windows and streams are ours, and so is `mirrored`: the two hemifields are mirror images, so every walk is
also a walk in the mirrored room, with left and right exchanged, and what is fitted is made `symmetric`. Fitted as it
is, not as the mean of both, it has less to learn the walks by heart with: in rooms kept back its turns followed the
labels with r = 0.68, in place of 0.61.
"""

import hashlib
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int
from tqdm import tqdm

from lgmdjax.control import navigator
from lgmdjax.errors import InputError
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.learning.sequences import Tape, lay
from lgmdjax.simulation.episodes import Walk

CAUTION = 1.5
"""By how much a driver should turn harder than its teacher. One network, 120 m in unseen rooms: 8.4 collisions per
100 m at 1.0, 0.9 at 1.6, 2.6 at 2.5, and of the way that it made in the time at 1.0, 90 % and 63 % are left."""

SAVE_EVERY = 10.0  # s between checkpoints, each of which takes as long as some epochs do


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How to fit; the numbers that the paper gives are its own."""

    epochs: int = 1000
    learning_rate: float = 1e-2  # of the first window; falls to nothing like half a cosine
    clip: float = 1.0  # largest norm of a gradient
    window: int = 60  # frames through which the error goes back: 2 s, two steps of the gait
    streams: int = 64  # walked side by side
    mirrored: bool = True  # also with left and right exchanged
    told: bool = False  # an efference copy is of walk.velocity, not of what the network itself said


@struct.dataclass(kw_only=True)
class Progress:
    """Where a fit is; everything that it needs to go on."""

    weights: Any
    optimiser: Any
    best: Any  # weights with the least test error so far
    epoch: Int[Array, ""]
    train: Float[Array, "epochs"]  # MSE while the epoch was walked
    test: Float[Array, "epochs"]  # MSE after it


@dataclass(frozen=True, kw_only=True)
class Fit:
    """What came of a fit: the last network, the best one on the test half, and the two curves of fig. 11."""

    params: navigator.Params
    best: navigator.Params
    train: Float[np.ndarray, "epochs"]
    test: Float[np.ndarray, "epochs"]


def standardise(params: navigator.Params, walks: Sequence[Walk], mirrored: bool = True) -> navigator.Params:
    """Set the constants to mean and deviation of u and of the labels, both sides alike if mirrored."""
    u, label = (np.concatenate([getattr(walk, name) for walk in walks]) for name in ("u", "label"))
    u, label = (np.concatenate([x, x[:, ::-1]]) if mirrored else x for x in (u, label))
    as_array = partial(jnp.asarray, dtype=float)
    return replace(
        params,
        input_mean=as_array(u.mean(0)),
        input_scale=as_array(np.maximum(u.std(0), 1e-3)),  # a blind eye must not become a loud one
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
    show: bool = True,
) -> Fit:
    """Fit the weights to the labels of `train`, and watch the error on `test`.

    Args:
        params: an untrained navigator; its constants are set from `train`.
        train: stretches of walking to learn from.
        test: stretches for the second curve, and to choose `best` by.
        settings: see there. `told` suits walks that the network drove itself; from the teacher's it learns to
            repeat the last label, which is nearly the next, and knows nothing when it drives.
        checkpoints: folder to save progress in, and to carry on from: the result is the same, bit for bit.
        show: show a progress bar.
    """
    settings = _checked(settings or Settings(), train, test)
    params = replace(standardise(params, train, settings.mirrored), symmetric=False)
    tapes = _tape(params, train, settings), _tape(params, test, settings)
    progress = _start(params, settings)
    if checkpoints is None:
        progress = _finish(params, progress, tapes, settings, None, show)
    else:
        with closing(Checkpoints(checkpoints, _identity(progress, tapes, settings))) as saved:
            progress = _finish(params, saved.latest(progress), tapes, settings, saved, show)
    fitted = replace(params, symmetric=settings.mirrored)
    return Fit(
        params=replace(fitted, weights=progress.weights),
        best=replace(fitted, weights=progress.best),
        train=np.asarray(progress.train),
        test=np.asarray(progress.test),
    )


def _finish(
    params: navigator.Params,
    progress: Progress,
    tapes: tuple[Tape, Tape],
    settings: Settings,
    saved: Checkpoints | None,
    show: bool,
) -> Progress:
    """Run the epochs that are left, some hundredth of all at a time."""
    total, done = settings.epochs, int(progress.epoch)
    chunk = max(1, total // 100)
    last_saved = time.monotonic()
    with tqdm(total=total, initial=done, desc=params.variant, unit="epoch", disable=not show) as bar:
        while done < total:
            epochs = min(chunk, total - done)
            progress = jax.block_until_ready(_advance(params, progress, *tapes, epochs, settings))
            done += epochs
            if saved is not None and (done == total or time.monotonic() - last_saved >= SAVE_EVERY):
                saved.save(done, progress)
                last_saved = time.monotonic()
            bar.set_postfix(mse=f"{progress.train[done - 1]:.4f}", test=f"{progress.test[done - 1]:.4f}")
            bar.update(epochs)
    return progress


def predict(params: navigator.Params, walks: Sequence[Walk]) -> list[Float[np.ndarray, "frames 2"]]:
    """Let the navigator answer to the u of each stretch from a fresh start, hearing its own last velocity."""
    frames = max(len(walk) for walk in walks)
    u = np.stack([np.pad(walk.u, ((0, frames - len(walk)), (0, 0)), mode="edge") for walk in walks])
    velocities = np.asarray(_respond(params, jnp.asarray(u, dtype=float)))
    return [velocity[: len(walk)] for walk, velocity in zip(walks, velocities, strict=True)]


def enliven(
    params: navigator.Params, walks: Sequence[Walk], caution: float = CAUTION, most: float = 2.5
) -> navigator.Params:
    """Scale the outputs about their mean until the navigator's turns vary `caution` times as much as the labels do.

    The least mean squared error is that of a timid driver: the less sure the network is, the nearer it stays to
    the mean, and a robot that turns half as hard as it should, when it should, walks into what it has seen. Nor do
    errors cost the same: a turn too many costs a little time, a turn too few a collision. The scale is
    `output_scale`, times std(turn of the labels) / std(turn predicted) from 1 up to `most`, times `caution`.
    """
    predicted, label = np.concatenate(predict(params, walks)), np.concatenate([walk.label for walk in walks])
    asked, given = (float(np.std(v[:, 1] - v[:, 0])) for v in (label, predicted))
    factor = caution * float(np.clip(asked / max(given, 1e-6), 1.0, most))
    return replace(params, output_scale=params.output_scale * factor)


def score(params: navigator.Params, walks: Sequence[Walk]) -> dict[str, Any]:
    """Compare predictions with labels: MSE, R2 of either side, correlation of the turns v_right - v_left."""
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


def table(fitted: Mapping[str, navigator.Params], walks: Mapping[str, Sequence[Walk]]) -> list[dict[str, Any]]:
    """Score every navigator on every set of walks: a row each, columns like `test_mse`, `unseen_r2`."""
    rows = []
    for variant, params in fitted.items():
        scores = {name: score(params, some) for name, some in walks.items()}
        columns = {f"{name}_{key}": value for name, s in scores.items() for key, value in s.items()}
        rows.append({"variant": variant, **columns})
    return rows


@partial(jax.jit, static_argnames="settings")
def _advance(
    params: navigator.Params,
    progress: Progress,
    train: Tape,
    test: Tape,
    epochs: Int[Array, ""] | int,
    settings: Settings,
) -> Progress:
    """Walk the tapes some epochs on; a number of epochs that is no constant of the program."""
    return jax.lax.fori_loop(0, epochs, lambda _, p: _epoch(params, p, train, test, settings), progress)


def _epoch(params: navigator.Params, progress: Progress, train: Tape, test: Tape, settings: Settings) -> Progress:
    optimiser = _optimiser(settings, len(train.u))

    def window(carry: tuple[Any, Any, navigator.State], tape: Tape):
        weights, memory, states = carry
        loss = jax.value_and_grad(partial(window_error, params, told=settings.told), has_aux=True)
        (_, (squares, states)), gradient = loss(weights, states, tape)
        updates, memory = optimiser.update(gradient, memory)
        return (optax.apply_updates(weights, updates), memory, states), squares

    carry = progress.weights, progress.optimiser, _states(params, train)
    (weights, memory, _), squares = jax.lax.scan(window, carry, train)
    error = _tape_error(replace(params, weights=weights), test)
    better = ~(error >= jnp.nanmin(progress.test))  # the first epoch too, when there is nothing but nan
    return Progress(
        weights=weights,
        optimiser=memory,
        best=jax.tree.map(lambda new, old: jnp.where(better, new, old), weights, progress.best),
        epoch=progress.epoch + 1,
        train=progress.train.at[progress.epoch].set(jnp.sum(squares) / (2 * jnp.sum(train.counts))),
        test=progress.test.at[progress.epoch].set(error),
    )


def window_error(
    params: navigator.Params, weights: Any, states: navigator.State, tape: Tape, *, told: bool
) -> tuple[Array, tuple[Array, navigator.State]]:
    """Walk one window; return its MSE, and its sum of squares and the states at its end."""
    params = replace(params, weights=weights)
    start = _states(params, tape)

    def frame(states: navigator.State, now: Tape) -> tuple[navigator.State, Array]:
        if told:
            states = replace(states, velocity=now.last)
        states = jax.vmap(lambda fresh, *both: jax.tree.map(partial(jnp.where, fresh), *both))(now.fresh, start, states)
        states, velocity = jax.vmap(navigator.step, in_axes=(None, 0, 0))(params, states, now.u)
        return states, jnp.sum(now.counts[:, None] * (velocity - now.label) ** 2)

    states, squares = jax.lax.scan(frame, states, tape)
    total = jnp.sum(squares)
    return total / (2 * jnp.maximum(jnp.sum(tape.counts), 1.0)), (total, states)


def _tape_error(params: navigator.Params, tape: Tape) -> Float[Array, ""]:
    """Walk a tape without learning, and return its MSE."""

    def window(states: navigator.State, tape: Tape) -> tuple[navigator.State, Array]:
        _, (squares, states) = window_error(params, params.weights, states, tape, told=False)
        return states, squares

    _, squares = jax.lax.scan(window, _states(params, tape), tape)
    return jnp.sum(squares) / (2 * jnp.sum(tape.counts))


@jax.jit
def _respond(params: navigator.Params, u: Float[Array, "walks frames 2"]) -> Float[Array, "walks frames 2"]:
    walk = lambda u: jax.lax.scan(partial(navigator.step, params), navigator.init(params), u)[1]  # noqa: E731
    return jax.vmap(walk)(u)


def _optimiser(settings: Settings, windows: int) -> optax.GradientTransformation:
    """RMSprop as Keras has it, but for a rate that falls; its own 1e-3 throughout is a fifth worse after 60 epochs."""
    rate = optax.cosine_decay_schedule(settings.learning_rate, settings.epochs * windows)
    return optax.chain(optax.clip_by_global_norm(settings.clip), optax.rmsprop(rate, decay=0.9, eps=1e-7))


def _start(params: navigator.Params, settings: Settings) -> Progress:
    unknown = jnp.full(settings.epochs, jnp.nan)
    return Progress(
        weights=params.weights,
        optimiser=_optimiser(settings, 1).init(params.weights),
        best=params.weights,
        epoch=jnp.asarray(0, jnp.int32),
        train=unknown,
        test=unknown,
    )


def _states(params: navigator.Params, tape: Tape) -> navigator.State:
    """One fresh state a stream."""
    return jax.vmap(lambda _: navigator.init(params))(jnp.arange(tape.fresh.shape[-1]))


def _tape(params: navigator.Params, walks: Sequence[Walk], settings: Settings) -> Tape:
    first = np.asarray(params.output_mean)
    return lay(walks, first, streams=settings.streams, window=settings.window, mirrored=settings.mirrored)


def _checked(settings: Settings, train: Sequence[Walk], test: Sequence[Walk]) -> Settings:
    """Raise `InputError` for settings without sense, and for data that are missing or not finite."""
    for name in ("epochs", "window", "streams"):
        if getattr(settings, name) < 1:
            raise InputError(f"training {name}: expected 1 or more, got {getattr(settings, name)}")
    if not 0 < settings.learning_rate < math.inf:
        raise InputError(f"training learning_rate: expected a positive number, got {settings.learning_rate}")
    for name, walks in (("train", train), ("test", test)):
        if sum(len(walk) for walk in walks) < 2:
            raise InputError(f"training: expected frames to {name} on, got none; collect longer walks")
        if not all(np.isfinite(x).all() for walk in walks for x in (walk.u, walk.label, walk.velocity)):
            raise InputError(f"training: expected finite u and v to {name} on, got some that are not")
    return settings


def _identity(start: Progress, tapes: tuple[Tape, Tape], settings: Settings) -> dict[str, Any]:
    """Tell this fit from any other: its settings, and what it starts from."""

    def digest(tree: Any) -> str:
        leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]
        return hashlib.sha256(b"".join(leaves)).hexdigest()

    data = {"training data": digest(tapes[0]), "test data": digest(tapes[1])}
    return asdict(settings) | data | {"first weights": digest(start.weights)}
