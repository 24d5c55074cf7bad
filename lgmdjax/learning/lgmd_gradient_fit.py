"""Fit the LGMD to recorded walks by gradient: the imitation loss, differentiated through navigator and detector.

Nothing before the frame differences has a fitted parameter. Recorded walks are therefore rendered and pooled only once
(`lgmdjax.simulation.rerender`), and only the differences between frames are kept. S, U, FF and u follow from two
consecutive differences, and from u the loss

    L = mean over a window's frames and both sides of |v - v*|^2.

States are passed on to the next window without their derivative. During the fit, thresholds are sigmoids whose width
shrinks from `SMOOTH_WIDTHS[0]` to `SMOOTH_WIDTHS[1]`, relative to T_s and T_f.

| symbol       | name                            | unit      | equation |
| ------------ | ------------------------------- | --------- | -------- |
| P_f, P_{f-1} | differences.current, .previous  | grey      | 7        |
| u            | result of `respond`             | 1, 0.5..1 | 14, 16   |
| v            | velocity                        | nominal   | 17       |
| v*           | sequences.label                 | nominal   | 22       |
| L            | loss                            | nominal^2 | sec. 5.1 |

The fitted parameters are the logarithms of T_s, T_f and W_I, and w_I in units of `KERNEL_RMS`, projected to
non-negative values. Only the product of W_I and the sum of w_I matters; `normalise_kernel` sets that sum to the
paper's.

Gradient: with respect to all of these and the navigator's weights; zero for T_s and T_f if thresholds are hard.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PyTree
from tqdm.auto import tqdm

from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.learning import behaviour_cloning, sequences
from lgmdjax.learning.settings import LgmdGradientSettings
from lgmdjax.runtime import tracking
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import episodes
from lgmdjax.simulation.closed_loop import FRAME_RATE, AnyArray
from lgmdjax.simulation.episodes import Walk

PARTS = ("detector", "navigator")
SMOOTH_WIDTHS = (0.3, 0.03)  # of the sigmoids, relative to T_s and T_f: first and last
MIN_CONSTANT = 1e-3  # smaller constants are raised to this before their logarithm is taken
KERNEL_SUM = float(np.sum(lgmd.KERNEL))
KERNEL_RMS = float(np.sqrt(np.mean(np.square(lgmd.KERNEL))))  # of the kernel's weights
MAX_GRAD_NORM = 1.0
ADAM_EPS = 1e-5  # keeps Adam from amplifying derivatives that are practically zero, as for T_f without suppression


@struct.dataclass(kw_only=True)
class LgmdNavigator:
    """Parameters of a detector and of the navigator that gets its u."""

    detector: lgmd.Params
    navigator: navigator.Params


@struct.dataclass(kw_only=True)
class FrameDifferences:
    """Differences of pooled images, of both eyes [grey]: the whole input of the detector."""

    current: Float[AnyArray, "*walks frames 2 rows columns"]
    previous: Float[AnyArray, "*walks frames 2 rows columns"]


@struct.dataclass(kw_only=True)
class LgmdBatch:
    """Training data: frame differences, and everything else as `behaviour_cloning` uses it."""

    differences: FrameDifferences  # axes (window, frame, stream, eye, row, column)
    sequences: sequences.SequenceBatch


Evaluate = Callable[[LgmdNavigator], Mapping[str, float]]
"""Returns errors on held-out walks; the fit's result is the step with the lowest "choice"."""

FitParams = Mapping[str, PyTree]
"""Fitted parameters by the names of `PARTS`, in the coordinates of the optimiser."""


def frame_differences(images: Float[AnyArray, "walks frames 2 rows columns"], is_first: AnyArray) -> FrameDifferences:
    """Return the differences of pooled images; zero at the first frame of a walk and after a reset.

    A walk cut out of a longer one therefore has other responses in its first two frames. `episodes.segments` leaves
    these out.
    """
    images, restarted = np.asarray(images), np.array(is_first)[..., None, None, None]
    restarted[:, 0] = True
    current = np.where(restarted, 0, np.diff(images, axis=1, prepend=images[:, :1]))
    previous = np.where(restarted, 0, np.roll(current, 1, axis=1))
    return FrameDifferences(current=current.astype(images.dtype), previous=previous.astype(images.dtype))


def respond(detector: lgmd.Params, differences: FrameDifferences) -> Float[Array, "*walks frames 2"]:
    """Return u of every frame and eye (eqs. 8-16).

    The LGMD gets each difference as an image that follows a black one, so that it computes the same difference.
    """
    detector = replace(detector, pooling=1)

    def eye(current: Float[Array, "rows columns"], previous: Float[Array, "rows columns"]) -> Float[Array, ""]:
        state = lgmd.State(frame=jnp.zeros_like(current), difference=previous)
        return lgmd.step(detector, state, current)[1].u

    current, previous = (
        jnp.reshape(leaf, (-1, *leaf.shape[-2:])) for leaf in (differences.current, differences.previous)
    )
    return jax.vmap(eye)(current, previous).reshape(differences.current.shape[:-2])


@jax.jit
def respond_walks(detector: lgmd.Params, differences: FrameDifferences) -> Float[Array, "walks frames 2"]:
    """Return u of whole walks, as `respond` does, one walk after the other to save memory."""
    return jax.lax.map(partial(respond, detector), jax.tree.map(jnp.asarray, differences))


def pack_walks(
    walks: Sequence[Walk], differences: FrameDifferences, streams: int, window: int, generator: np.random.Generator
) -> LgmdBatch:
    """Concatenate the segments of walks in random order and cut them, with their differences, into parallel streams."""
    segments = [(k, segment) for k, walk in enumerate(walks) for segment in episodes.segments([walk])]
    segments = [segments[k] for k in generator.permutation(len(segments))]
    spans = []
    for k, segment in segments:
        first = round(float(segment.time[0] - walks[k].time[0]) * FRAME_RATE)
        spans.append((k, slice(first, first + len(segment))))

    def pack(leaf: AnyArray) -> Array:
        series = np.concatenate([leaf[span] for span in spans])
        return jnp.asarray(sequences.to_streams(series, streams=streams, window=window))

    batch = sequences.pack(
        [segment for _, segment in segments], np.zeros(2), streams=streams, window=window, mirrored=False
    )
    return LgmdBatch(differences=jax.tree.map(pack, differences), sequences=batch)


def to_fit_params(params: LgmdNavigator) -> dict[str, PyTree]:
    """Return all parameters that can be fitted, in the coordinates of the optimiser."""
    logs = {name: jnp.log(jnp.maximum(getattr(params.detector, name), MIN_CONSTANT)) for name in lgmd.SCALARS}
    return {"detector": logs | {"kernel": params.detector.kernel / KERNEL_RMS}, "navigator": params.navigator.weights}


def from_fit_params(params: LgmdNavigator, fitted: FitParams) -> LgmdNavigator:
    """Return `params` with its fitted parameters replaced; the inverse of `to_fit_params`."""
    constants = {name: jnp.exp(fitted["detector"][name]) for name in lgmd.SCALARS}
    return LgmdNavigator(
        detector=replace(params.detector, kernel=KERNEL_RMS * fitted["detector"]["kernel"], **constants),
        navigator=replace(params.navigator, weights=fitted["navigator"]),
    )


def normalise_kernel(detector: lgmd.Params) -> lgmd.Params:
    """Return the same detector with a symmetric w_I whose sum is that of eq. 9; the factor goes into W_I."""
    w = detector.kernel
    w = (w + w[::-1] + w[:, ::-1] + w[::-1, ::-1]) / 4
    factor = jnp.maximum(jnp.sum(w), 1e-9) / KERNEL_SUM
    return replace(detector, kernel=w / factor, inhibition=detector.inhibition * factor)


def loss(
    fitted: FitParams, params: LgmdNavigator, states: navigator.State, batch: LgmdBatch, width: Float[Array, ""] | float
) -> tuple[Float[Array, ""], navigator.State]:
    """Return the mean squared error of the commands in one window, and the navigators' states after it.

    Args:
        fitted: parameters to differentiate with respect to; they replace those in `params`.
        params: all other parameters.
        states: of the navigators, one per stream.
        batch: one window, without the axis of windows.
        width: of the smooth thresholds, relative to them.
    """
    own = from_fit_params(params, {**to_fit_params(params), **fitted})
    u = respond(lgmd.with_smooth_thresholds(own.detector, width), batch.differences)
    return behaviour_cloning.window_loss(
        own.navigator, own.navigator.weights, states, replace(batch.sequences, u=u), command_feedback=False
    )


def init_states(params: navigator.Params, streams: int) -> navigator.State:
    """Return the initial state of a navigator for every stream."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (streams, *leaf.shape)), navigator.init(params))


def fit(
    params: LgmdNavigator,
    batch: LgmdBatch,
    parts: Sequence[str],
    settings: LgmdGradientSettings,
    evaluate: Evaluate,
    *,
    label: str = "fit",
) -> tuple[LgmdNavigator, list[JsonObject]]:
    """Follow the gradient of the loss with Adam, window after window; return the best parameters and the curve.

    Args:
        params: initial parameters.
        batch: training data.
        parts: which of `PARTS` are fitted; without any, `params` are only evaluated.
        settings: of the optimiser.
        evaluate: called at the start, every `settings.eval_every` steps and at the end.
        label: of the progress bar.

    Returns:
        The evaluated parameters with the lowest "choice", and a row per evaluation: `step`, `loss` (mean of the windows
        since the last evaluation), and what `evaluate` returned.
    """
    fitted = {name: to_fit_params(params)[name] for name in parts}
    optimiser, steps = _optimiser(parts, settings), settings.steps if parts else 0
    memory, states = optimiser.init(fitted), init_states(params.navigator, batch.sequences.is_first.shape[-1])
    update = _make_update(params, optimiser, windows=len(batch.sequences.u), steps=steps)
    best, rows, errors = params, [], []
    for step in tqdm(range(steps + 1), desc=label, unit="step"):
        if step % settings.eval_every == 0 or step == steps:
            current = from_fit_params(params, {**to_fit_params(params), **fitted})
            rows.append({"step": step, "loss": float(np.mean(errors)) if errors else None, **evaluate(current)})
            best = current if rows[-1]["choice"] <= min(row["choice"] for row in rows) else best
            known = {name: value for name, value in rows[-1].items() if name != "step" and value is not None}
            tracking.log(step, {f"{label}/{name}": float(value) for name, value in known.items()})
            errors = []
        if step < steps:
            fitted, memory, states, error = update(fitted, memory, states, batch, jnp.asarray(step, jnp.int32))
            errors.append(error)
    return best, rows


def _make_update(
    params: LgmdNavigator, optimiser: optax.GradientTransformation, *, windows: int, steps: int
) -> Callable[..., tuple[dict[str, PyTree], optax.OptState, navigator.State, Float[Array, ""]]]:
    """Return a jitted step: (fitted parameters, optimiser's state, states, batch, step) -> (the same three, loss)."""

    @jax.jit
    def update(
        fitted: FitParams, memory: optax.OptState, states: navigator.State, batch: LgmdBatch, step: Int[Array, ""]
    ):
        window = jax.tree.map(lambda leaf: leaf[step % windows], batch)
        width = SMOOTH_WIDTHS[0] * (SMOOTH_WIDTHS[1] / SMOOTH_WIDTHS[0]) ** (step / steps)
        (error, states), grad = jax.value_and_grad(loss, has_aux=True)(fitted, params, states, window, width)
        updates, memory = optimiser.update(grad, memory, fitted)
        return _project(optax.apply_updates(fitted, updates)), memory, states, error

    return update


def _optimiser(parts: Sequence[str], settings: LgmdGradientSettings) -> optax.GradientTransformation:
    """Return Adam with gradient clipping for each part, at a rate of its own that decays along half a cosine."""
    rates = {"detector": settings.learning_rate, "navigator": settings.navigator_learning_rate}

    def adam(rate: float) -> optax.GradientTransformation:
        schedule = optax.cosine_decay_schedule(rate, settings.steps)
        return optax.chain(optax.clip_by_global_norm(MAX_GRAD_NORM), optax.adam(schedule, eps=ADAM_EPS))

    return optax.partition({name: adam(rates[name]) for name in parts}, {name: name for name in parts})


def _project(fitted: PyTree) -> dict[str, PyTree]:
    """Set negative weights of the kernel to zero."""
    if "detector" not in fitted:
        return fitted
    kernel = optax.projections.projection_non_negative(fitted["detector"]["kernel"])
    return fitted | {"detector": fitted["detector"] | {"kernel": kernel}}
