"""Fit the constants of any looming detector by gradient.

A detector is fitted within `scaled`, so that contrast and gain are constants like its own. What is fitted are the
logarithms of their factors: c = c_0 exp(x), which keeps every sign. An array with zeros, such as a kernel, becomes
c_0 + x rms(c_0), projected to zero or more if c_0 is nowhere negative.

Left as they are: integers; constants that are zero or infinite, which switch a mechanism off; and the widths of smooth
thresholds. Where a detector has `smooth`, its thresholds are sigmoids during the fit, whose published widths shrink
from `WIDTHS[0]` to `WIDTHS[1]` times; it is evaluated with steps.

Gradient: `loss` may be any differentiable function of the detector's parameters, for instance of
`lgmdjax.learning.detector_objectives`.
"""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree
from tqdm.auto import tqdm

from lgmdjax.detectors import scaled
from lgmdjax.errors import InputError
from lgmdjax.learning.settings import DetectorFitSettings
from lgmdjax.runtime import interruption, tracking
from lgmdjax.runtime.storage import JsonObject

WIDTHS = (2.0, 0.2)  # first and last width of the sigmoids, relative to the published one
WIDTH = "_width"  # end of the name of a threshold's width
MAX_GRAD_NORM = 1.0
ADAM_EPS = 1e-5  # keeps Adam from amplifying derivatives that are practically zero

Factors = Mapping[str, Array]
"""x of every constant that is fitted, by its name."""

Loss = Callable[[scaled.Params, PyTree], Float[Array, ""]]
"""Loss of a detector on a batch."""


def constants(params: scaled.Params) -> dict[str, np.ndarray]:
    """Return the constants that can be fitted, by name.

    >>> from lgmdjax.detectors import lgmd
    >>> list(constants(scaled.Params(detector=lgmd.Params(suppression=float("inf")))))
    ['contrast', 'detector.inhibition', 'detector.kernel', 'detector.threshold', 'gain']
    """
    leaves = jax.tree_util.tree_flatten_with_path(params)[0]
    named = {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in leaves}
    return {name: named[name] for name in sorted(named) if _can_be_fitted(name, named[name])}


def _can_be_fitted(name: str, value: np.ndarray) -> bool:
    is_number = value.dtype.kind == "f" and bool(np.isfinite(value).all())
    return is_number and bool(value.any()) and not name.endswith(WIDTH)


def move(params: scaled.Params, factors: Factors) -> scaled.Params:
    """Return the parameters with their constants changed; x = 0 changes nothing."""

    def moved(path: tuple[Any, ...], leaf: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        return _move(np.asarray(leaf), factors[name]) if name in factors else leaf

    return jax.tree_util.tree_map_with_path(moved, params)


def _move(start: np.ndarray, x: Array) -> Array:
    if start.all():
        return jnp.exp(x) * start
    changed = x * np.sqrt(np.mean(np.square(start))) + start
    return jnp.maximum(changed, 0.0) if (start >= 0).all() else changed


def smooth(params: scaled.Params, width: Float[Array, ""] | float) -> scaled.Params:
    """Return a detector whose thresholds are sigmoids, of `width` times the widths that it has.

    >>> from lgmdjax.detectors import lgmd
    >>> inside = smooth(scaled.Params(detector=lgmd.Params()), 0.5).detector
    >>> inside.smooth, inside.threshold_width, inside.suppression_width
    (True, 0.5, 0.5)
    """
    inside = params.detector
    if not hasattr(inside, "smooth"):
        return params
    widths = {field.name: width * getattr(inside, field.name) for field in fields(inside) if field.name.endswith(WIDTH)}
    return replace(params, detector=replace(inside, smooth=True, **widths))


def fit(
    params: scaled.Params,
    loss: Loss,
    sample: Callable[[np.random.Generator], PyTree],
    evaluate: Callable[[scaled.Params], float],
    settings: DetectorFitSettings,
    *,
    seed: int,
    label: str,
) -> tuple[scaled.Params, list[JsonObject]]:
    """Follow the gradient of a loss with Adam; return the best constants, and the curve.

    Args:
        params: initial constants.
        loss: of the detector, whose thresholds are smooth, on a batch.
        sample: returns the batch of a step; all batches have the same shapes.
        evaluate: returns a score of the detector with steps as thresholds, higher is better. Called at the start, every
            `settings.eval_every` steps, and at the end.
        settings: of the optimiser.
        seed: of the batches.
        label: of the progress bar.

    Returns:
        The evaluated parameters with the highest score, the earliest of equals, and a row for each evaluation: step,
        loss (mean since the last one) and score.

    Raises InputError for a loss or a derivative that is not finite.
    """
    generator = np.random.default_rng(seed)
    factors: Factors = {name: jnp.zeros(value.shape, float) for name, value in constants(params).items()}
    schedule = optax.cosine_decay_schedule(settings.learning_rate, settings.steps)
    optimiser = optax.chain(optax.clip_by_global_norm(MAX_GRAD_NORM), optax.adam(schedule, eps=ADAM_EPS))
    memory, best, rows, losses = optimiser.init(factors), params, list[JsonObject](), list[float]()
    update = _make_update(params, loss, optimiser)
    for step in tqdm(range(settings.steps + 1), desc=label, unit="step"):
        interruption.check()
        if step % settings.eval_every == 0 or step == settings.steps:
            current = move(params, factors)
            row = {"step": step, "loss": float(np.mean(losses)) if losses else None, "score": evaluate(current)}
            if all(row["score"] > other["score"] for other in rows):
                best = current
            rows.append(row)
            tracking.log(step, {f"{label}/score": row["score"]})
            losses = []
        if step < settings.steps:
            width = WIDTHS[0] * (WIDTHS[1] / WIDTHS[0]) ** (step / settings.steps)
            factors, memory, error, norm = update(factors, memory, sample(generator), jnp.asarray(width, float))
            losses.append(float(error))
            _require_finite(label, losses[-1], float(norm))
    return best, rows


def _make_update(params: scaled.Params, loss: Loss, optimiser: optax.GradientTransformation) -> Callable[..., Any]:
    """Return a jitted step: (factors, memory, batch, width) -> (factors, memory, loss, norm of its derivative)."""

    @jax.jit
    def update(factors: Factors, memory: optax.OptState, batch: PyTree, width: Array) -> tuple[Any, ...]:
        error, slope = jax.value_and_grad(lambda x: loss(smooth(move(params, x), width), batch))(factors)
        updates, memory = optimiser.update(slope, memory, factors)
        return optax.apply_updates(factors, updates), memory, error, optax.tree.norm(slope)

    return update


def _require_finite(label: str, error: float, norm: float) -> None:
    if not np.isfinite(error) or not np.isfinite(norm):
        raise InputError(
            f"{label}: expected a finite loss and derivative, got {error:g} and {norm:g}; "
            "avoid roots, logarithms and divisions of zero in the detector"
        )
