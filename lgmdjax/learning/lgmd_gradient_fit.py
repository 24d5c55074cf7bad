"""The LGMD fitted to recorded walks: the imitation loss, differentiated through navigator and detector.

What the cells of an eye see has no parameter that is fitted. So walks are drawn again once
(`lgmdjax.simulation.rerender`), pooled, and only the changes from frame to frame are kept; from two of them follow S,
U, FF and u, and from u the loss

    L = mean over a window's frames and both sides of |v - v*|^2.

States go on into the next window, without their derivative. Steps are sigmoids while fitting, and narrow from
`WIDTHS[0]` of T_s and T_f to `WIDTHS[1]`.

| symbol        | name                  | unit      | equation |
| ------------- | --------------------- | --------- | -------- |
| P_f, P_{f-1}  | cells.change, .before | grey      | 7        |
| u             | `respond`             | 1, 0.5..1 | 14, 16   |
| v             | velocity              | nominal   | 17       |
| v*            | tape.label            | nominal   | 22       |
| L             | loss                  | nominal^2 | sec. 5.1 |

Fitted are the logarithms of T_s, T_f and W_I, and w_I in units of `SIZE`, kept from becoming negative. W_I times the
sum of w_I is one number; `normal` gives w_I the sum that it has in the paper.

Gradient: by all of these, and by the navigator's weights. Of hard steps T_s and T_f have none.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int
from tqdm import tqdm

from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.learning import behaviour_cloning, sequences
from lgmdjax.learning.settings import LgmdGradientSettings
from lgmdjax.simulation import episodes
from lgmdjax.simulation.closed_loop import FRAME_RATE, Leaf
from lgmdjax.simulation.episodes import Walk

SCALARS = ("threshold", "suppression", "inhibition")  # T_s, T_f, W_I
PARTS = ("detector", "navigator")
WIDTHS = (0.3, 0.03)  # of the sigmoids, as shares of T_s and T_f: at first and at last
LEAST = 1e-3  # what a constant must be to have a logarithm
TOTAL = float(np.sum(lgmd.KERNEL))
SIZE = float(np.sqrt(np.mean(np.square(lgmd.KERNEL))))  # of a weight of the kernel
CLIP = 1.0  # largest norm of a gradient
SLIGHT = 1e-5  # a slope that is none: that of a gate that stands open must not be made large


@struct.dataclass(kw_only=True)
class Pilot:
    """A detector, and the navigator that listens to it."""

    detector: lgmd.Params
    navigator: navigator.Params


@struct.dataclass(kw_only=True)
class Cells:
    """How what the cells of both eyes see changed [grey]: all that the detector knows of the world."""

    change: Float[Leaf, "*walks frames 2 rows columns"]
    before: Float[Leaf, "*walks frames 2 rows columns"]


@struct.dataclass(kw_only=True)
class Film:
    """Walks to fit to: stretches end to end, in streams that are walked side by side."""

    cells: Cells  # axes (window, frame, stream, eye, row, column)
    tape: sequences.Tape


Judge = Callable[[Pilot], Mapping[str, Any]]  # looks at walks kept back; "choice" is what the best step has least of


def changes(seen: Float[Leaf, "walks frames 2 rows columns"], fresh: Leaf) -> Cells:
    """Take the differences of what cells saw; none where a robot was just put down, nor on the first picture.

    What a walk that is cut out of a longer one says in its first two frames is therefore not what the whole one does.
    `episodes.stretches` leaves them out.
    """
    seen, opened = np.asarray(seen), np.array(fresh)[..., None, None, None]
    opened[:, 0] = True
    change = np.where(opened, 0, np.diff(seen, axis=1, prepend=seen[:, :1]))
    before = np.where(opened, 0, np.roll(change, 1, axis=1))
    return Cells(change=change.astype(seen.dtype), before=before.astype(seen.dtype))


def respond(detector: lgmd.Params, cells: Cells) -> Float[Array, "*walks frames 2"]:
    """Give u of every frame and eye (eqs. 8-16): a change is what a picture differs from a black one by."""
    detector = replace(detector, pooling=1)

    def eye(P: Float[Array, "rows columns"], before: Float[Array, "rows columns"]) -> Float[Array, ""]:
        return lgmd.step(detector, lgmd.State(frame=jnp.zeros_like(P), difference=before), P)[1].u

    change, before = (jnp.reshape(leaf, (-1, *leaf.shape[-2:])) for leaf in (cells.change, cells.before))
    return jax.vmap(eye)(change, before).reshape(cells.change.shape[:-2])


@jax.jit
def watch(detector: lgmd.Params, cells: Cells) -> Float[Array, "walks frames 2"]:
    """Give u of whole walks, as `respond` does, one after the other."""
    return jax.lax.map(partial(respond, detector), jax.tree.map(jnp.asarray, cells))


def film(walks: Sequence[Walk], cells: Cells, streams: int, window: int, order: np.random.Generator) -> Film:
    """Lay the stretches of walks end to end, in the order of luck, with what the cells saw on them."""
    pieces = [(k, stretch) for k, walk in enumerate(walks) for stretch in episodes.stretches([walk])]
    pieces = [pieces[k] for k in order.permutation(len(pieces))]
    spans = []
    for k, stretch in pieces:
        first = round(float(stretch.time[0] - walks[k].time[0]) * FRAME_RATE)
        spans.append((k, slice(first, first + len(stretch))))

    def lay(leaf: Leaf) -> Array:
        return jnp.asarray(
            sequences.cut(np.concatenate([leaf[span] for span in spans]), streams=streams, window=window)
        )

    tape = sequences.lay([piece for _, piece in pieces], np.zeros(2), streams=streams, window=window, mirrored=False)
    return Film(cells=jax.tree.map(lay, cells), tape=tape)


def parts(pilot: Pilot) -> dict[str, Any]:
    """Name what can be fitted, by the names of `PARTS`, in the numbers that steps are made in."""
    logs = {name: jnp.log(jnp.maximum(getattr(pilot.detector, name), LEAST)) for name in SCALARS}
    return {"detector": logs | {"kernel": pilot.detector.kernel / SIZE}, "navigator": pilot.navigator.weights}


def together(pilot: Pilot, parts: Mapping[str, Any]) -> Pilot:
    """Put a pilot together from parts, its structure and constants those of another."""
    constants = {name: jnp.exp(parts["detector"][name]) for name in SCALARS}
    return Pilot(
        detector=replace(pilot.detector, kernel=SIZE * parts["detector"]["kernel"], **constants),
        navigator=replace(pilot.navigator, weights=parts["navigator"]),
    )


def normal(detector: lgmd.Params) -> lgmd.Params:
    """Give w_I the symmetry that it is used with and the sum of eq. 9; what it had more goes into W_I."""
    w = detector.kernel
    w = (w + w[::-1] + w[:, ::-1] + w[::-1, ::-1]) / 4
    factor = jnp.maximum(jnp.sum(w), 1e-9) / TOTAL
    return replace(detector, kernel=w / factor, inhibition=detector.inhibition * factor)


def loss(
    tuned: Mapping[str, Any], pilot: Pilot, states: navigator.State, film: Film, share: Float[Array, ""] | float
) -> tuple[Float[Array, ""], navigator.State]:
    """Walk one window; give the mean squared error of its commands, and the navigators' states at its end.

    Args:
        tuned: what the derivative is asked of, in place of what `pilot` has.
        states: of the navigator, one a stream. film: a window of it, without the axis of windows.
        share: width of the sigmoids.
    """
    own = together(pilot, {**parts(pilot), **tuned})
    u = respond(lgmd.smoothed(own.detector, share), film.cells)
    tape = replace(film.tape, u=u)
    error, (_, states) = behaviour_cloning.window_error(own.navigator, own.navigator.weights, states, tape, told=False)
    return error, states


def start(pupil: navigator.Params, streams: int) -> navigator.State:
    """Let the navigator of every stream begin with nothing remembered."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (streams, *leaf.shape)), navigator.init(pupil))


def fit(
    pilot: Pilot, film: Film, names: Sequence[str], settings: LgmdGradientSettings, judge: Judge, label: str = "fit"
) -> tuple[Pilot, list[dict[str, Any]]]:
    """Follow the gradient of the loss (Adam), window after window; give the pilot of the step that is judged best.

    Args:
        pilot: to start from. names: of the `PARTS` that are fitted; of none, nothing is.
        judge: asked at the start, every `settings.every` steps and at the end. label: for the progress bar.

    Returns:
        The pilot, and what was said of every one asked about: step, mean loss of the windows since the last, and what
        the judge said.
    """
    tuned = {name: parts(pilot)[name] for name in names}
    optimiser, steps = _optimiser(names, settings), settings.steps if names else 0
    memory, states, windows = optimiser.init(tuned), start(pilot.navigator, film.tape.fresh.shape[-1]), len(film.tape.u)

    @jax.jit
    def update(tuned: Any, memory: Any, states: navigator.State, film: Film, number: Int[Array, ""]):
        window = jax.tree.map(lambda leaf: leaf[number % windows], film)
        share = WIDTHS[0] * (WIDTHS[1] / WIDTHS[0]) ** (number / steps)
        (error, states), slope = jax.value_and_grad(loss, has_aux=True)(tuned, pilot, states, window, share)
        moves, memory = optimiser.update(slope, memory, tuned)
        tuned = _allowed(optax.apply_updates(tuned, moves))
        return tuned, memory, states, error

    best, rows, errors = pilot, [], []
    for number in tqdm(range(steps + 1), desc=label, unit="step"):
        if number % settings.every == 0 or number == steps:
            now = together(pilot, {**parts(pilot), **tuned})
            rows.append({"step": number, "loss": float(np.mean(errors)) if errors else None, **judge(now)})
            best = now if rows[-1]["choice"] <= min(row["choice"] for row in rows) else best
            errors = []
        if number < steps:
            tuned, memory, states, error = update(tuned, memory, states, film, jnp.asarray(number, jnp.int32))
            errors.append(error)
    return best, rows


def _optimiser(names: Sequence[str], settings: LgmdGradientSettings) -> optax.GradientTransformation:
    """Cut the gradient of each part, and step each at its own rate, which falls to nothing like half a cosine."""
    rates = {"detector": settings.learning_rate, "navigator": settings.navigator_rate}

    def steps(rate: float) -> optax.GradientTransformation:
        return optax.chain(
            optax.clip_by_global_norm(CLIP), optax.adam(optax.cosine_decay_schedule(rate, settings.steps), eps=SLIGHT)
        )

    return optax.partition({name: steps(rates[name]) for name in names}, {name: name for name in names})


def _allowed(tuned: Any) -> dict[str, Any]:
    """Put weights of the kernel that became negative back to nothing."""
    if "detector" not in tuned:
        return tuned
    kernel = optax.projections.projection_non_negative(tuned["detector"]["kernel"])
    return tuned | {"detector": tuned["detector"] | {"kernel": kernel}}
