"""Lobula giant movement detector: the locust's neuron that fires when something comes straight at an eye.

One eye. A picture is compared with the last one; every cell is excited by its own change and inhibited, a
frame later, by the changes around it. Edges that spread faster than the inhibition get through: those of an
approaching object. Whole-field motion (a fast turn) is recognised by its total change and silences the cell.

| symbol    | name                        | unit        | equation |
| --------- | --------------------------- | ----------- | -------- |
| L_f       | frame                       | grey 0..255 | 7        |
| P_f       | difference                  | grey        | 7        |
| I_f       | layers.inhibition           | grey        | 8        |
| w_I       | kernel                      | 1           | 9        |
| E_f       | layers.excitation           | grey        | 10       |
| S_f       | layers.summation            | grey        | 11       |
| W_I       | inhibition                  | 1           | 11       |
| T_s       | threshold                   | grey        | 12       |
| U_f/n     | response.excitation         | grey        | 13, 14   |
| u_f       | response.u                  | 1, 0.5..1   | 14, 16   |
| FF        | response.feed_forward       | grey        | 15       |
| T_f       | suppression                 | grey        | 16       |

Source: Cizek & Faigl, sec. 3.3; Blanchard, Rind & Verschure 2000. Two equations contradict the text as
printed and are corrected: eq. 15 averages the signed change, which is zero for a moving edge
(`printed_feed_forward`), and eq. 16 keeps u when FF is high, where the text says that high FF suppresses it
(`printed_gate`). Cells outside the picture are zero.

The paper has a cell a pixel; with `pooling` n a cell looks at the mean of about n x n pixels. A texture that is
resolved moves across the picture at v/d, but is as much finer there, so that the change it makes is the same at any
distance. Cells of some degrees average out what is far and fine, as a locust's facets do, and leave what is near: the
difference of the two eyes' u follows that of nearness with r = 0.14 at a cell a pixel of 320 x 240, and 0.8 at 8 x 8.

The kernel sums to 2.92, times W_I to 1.168: where a change repeats itself, summation is negative and only
fresh edges pass. The frame after `init` has no last change yet, hence no inhibition either.

Gradient: thresholds are steps, so those of T_s and T_f are zero and the others' are exact almost everywhere.
With `smooth` both steps are sigmoids of a width in grey levels, which tend to the steps as it tends to zero.
"""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from lgmdjax.errors import InputError

REACH = 2  # n of eq. 8: a cell is inhibited by cells up to two rows or columns away
STILL = 0.5  # u of a cell that sees nothing move

# w_I (eq. 9)
KERNEL = (
    (0.06, 0.12, 0.25, 0.12, 0.06),
    (0.12, 0.06, 0.12, 0.06, 0.12),
    (0.25, 0.12, 0.00, 0.12, 0.25),
    (0.12, 0.06, 0.12, 0.06, 0.12),
    (0.06, 0.12, 0.25, 0.12, 0.06),
)


@struct.dataclass(kw_only=True)
class Params:
    """The constants. T_s and T_f depend on resolution, textures and speed: `lgmdjax.learning.lgmd_grid_search`."""

    threshold: Float[Array, ""] | float = 6.0  # T_s, grey
    suppression: Float[Array, ""] | float = 20.0  # T_f, grey
    inhibition: Float[Array, ""] | float = 0.4  # W_I
    kernel: Float[Array, "5 5"] = struct.field(default_factory=lambda: jnp.asarray(KERNEL, dtype=float))
    threshold_width: Float[Array, ""] | float = 1.0  # grey, of the smooth threshold
    suppression_width: Float[Array, ""] | float = 1.0  # grey, of the smooth gate
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell looks at
    smooth: bool = struct.field(pytree_node=False, default=False)  # sigmoids in the place of steps
    printed_feed_forward: bool = struct.field(pytree_node=False, default=False)  # eq. 15: signed mean
    printed_gate: bool = struct.field(pytree_node=False, default=False)  # eq. 16: low FF suppresses


@struct.dataclass(kw_only=True)
class State:
    """The last picture L_{f-1}, as the cells saw it, and the last change P_{f-1}."""

    frame: Float[Array, "rows columns"]
    difference: Float[Array, "rows columns"]


@struct.dataclass(kw_only=True)
class Response:
    """What one frame makes of the two single cells."""

    u: Float[Array, ""]  # eqs. 14, 16
    feed_forward: Float[Array, ""]  # FF, eq. 15 [grey]
    excitation: Float[Array, ""]  # U / n_cell, eqs. 13, 14 [grey]; what u would be told by without the gate


@struct.dataclass(kw_only=True)
class Layers:
    """The layers of cells of one frame, in grey levels, for drawing."""

    difference: Float[Array, "rows columns"]  # P, eq. 7
    excitation: Float[Array, "rows columns"]  # E, eq. 10
    inhibition: Float[Array, "rows columns"]  # I, eq. 8
    summation: Float[Array, "rows columns"]  # S, eq. 11, before the threshold


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Open the eye on a first picture: nothing has changed yet."""
    _require_picture(frame)
    seen = pool(params, frame)
    return State(frame=seen, difference=jnp.zeros_like(seen))


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Show the next picture (eqs. 7-16).

    Raises `InputError`, when traced, if the picture has another size than the last one or is not of floats.

    Gradient: see the module; |.| of eqs. 8, 10 and 13 has slope 0 at 0.
    """
    cells = layers(params, state, frame)
    U = _mean_excitation(params, cells.summation)
    FF = _feed_forward(params, state.difference)
    u = STILL + _pass(params, FF) * (jax.nn.sigmoid(U) - STILL)
    return State(frame=pool(params, frame), difference=cells.difference), Response(u=u, feed_forward=FF, excitation=U)


def layers(params: Params, state: State, frame: Float[Array, "height width"]) -> Layers:
    """Evaluate the layers of cells for the next picture (eqs. 7-11)."""
    _require_picture(frame)
    seen = pool(params, frame)
    _require_size(seen.shape, state.frame.shape)
    P = seen - state.frame
    E = jnp.abs(P)
    I = inhibit(params.kernel, state.difference)  # noqa: E741
    return Layers(difference=P, excitation=E, inhibition=I, summation=E - jnp.abs(I) * params.inhibition)


def pool(params: Params, frame: Float[Array, "height width"]) -> Float[Array, "rows columns"]:
    """Average a picture over the square that each cell looks at.

    As many cells as come nearest to `pooling` pixels a side share the picture evenly, with parts of pixels where they
    must: mirrored pictures give mirrored cells.
    """
    if params.pooling == 1:
        return frame
    rows, columns = (jnp.asarray(_shares(size, params.pooling), frame.dtype) for size in frame.shape)
    exactly = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
    return exactly(exactly(rows, frame), columns.T)


def _shares(pixels: int, pooling: int) -> Float[np.ndarray, "cells pixels"]:
    """Weight each pixel by its share of each cell, along one side of the picture."""
    cells = max(round(pixels / pooling), 1)
    edges = np.arange(cells + 1) * pixels / cells
    pixel = np.arange(pixels)
    common = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    return np.clip(common, 0.0, None) * cells / pixels


def inhibit(kernel: Float[Array, "5 5"], difference: Float[Array, "height width"]) -> Float[Array, "height width"]:
    """Spread the last change over the neighbours (eq. 8), zero beyond the border.

    The kernel is taken as the mean of its four mirror images, so that left and right eye stay mirror images
    of each other whatever is learned, and so that rows can be added in pairs before they are weighted: 13
    products a cell instead of 25, which XLA makes one vectorised loop of (`lax.conv` takes 30 times as long
    on a CPU).
    """
    height, width = difference.shape
    padded = jnp.pad(difference, REACH)
    quarter = _quarter(kernel).astype(difference.dtype)

    def row(i: int) -> Array:
        return lax.slice_in_dim(padded, REACH + i, REACH + i + height, axis=0)

    def moved(column: Array, j: int) -> Array:
        return lax.slice_in_dim(column, REACH + j, REACH + j + width, axis=1)

    rows = (row(0), row(1) + row(-1), row(2) + row(-2))
    inner, near, far = (w[0] * rows[0] + w[1] * rows[1] + w[2] * rows[2] for w in quarter.T)
    return moved(inner, 0) + moved(near, 1) + moved(near, -1) + moved(far, 2) + moved(far, -2)


def _mean_excitation(params: Params, summation: Float[Array, "height width"]) -> Float[Array, ""]:
    """Average what passes T_s over the cells (eqs. 12, 13, and the division of eq. 14) [grey]."""
    S, margin = summation, summation - params.threshold
    soft = params.smooth
    passed = S * jax.nn.sigmoid(margin / params.threshold_width) if soft else jnp.where(margin >= 0, S, 0.0)
    return _mean(jnp.abs(passed))


def smoothed(params: Params, share: Float[Array, ""] | float) -> Params:
    """Make sigmoids of both steps, as wide as a share of T_s (of 0.1 grey at least) and of T_f."""
    widths = {
        "threshold_width": share * jnp.maximum(params.threshold, 0.1),
        "suppression_width": share * params.suppression,
    }
    return replace(params, smooth=True, **widths)


def check(params: Params) -> None:
    """Raise `InputError` if a constant is negative or not finite, or the kernel not its own mirror image."""
    for name in ("threshold", "suppression", "inhibition", "kernel"):
        value = np.asarray(getattr(params, name), dtype=float)
        if not np.all(np.isfinite(value) & (value >= 0)):
            raise InputError(f"lgmd {name}: expected finite numbers >= 0, got {value.min()}; see lgmd.Params")
    if params.pooling < 1:
        raise InputError(f"lgmd pooling: expected 1 pixel or more a cell, got {params.pooling}; the paper has 1")
    for name in ("threshold_width", "suppression_width"):
        if not 0 < float(getattr(params, name)) < math.inf:
            raise InputError(
                f"lgmd {name}: expected a positive grey level, got {getattr(params, name)}; the default is 1"
            )
    w = np.asarray(params.kernel)
    if w.shape != (2 * REACH + 1, 2 * REACH + 1):
        raise InputError(f"lgmd kernel: expected shape (5, 5), got {w.shape}; eq. 9 is lgmd.KERNEL")
    if not (np.allclose(w, w[::-1]) and np.allclose(w, w[:, ::-1])):
        raise InputError("lgmd kernel: expected its own mirror image, got other weights on one side; average them")


def _quarter(kernel: Float[Array, "5 5"]) -> Float[Array, "3 3"]:
    """Fold the kernel at its middle: weights by distance in rows and columns, mirror images averaged."""
    w = (kernel + kernel[::-1]) / 2
    return ((w + w[:, ::-1]) / 2)[REACH:, REACH:]


def _feed_forward(params: Params, difference: Float[Array, "height width"]) -> Float[Array, ""]:
    """Average the last change over the picture (eq. 15), its size unless the printed form is asked for."""
    return _mean(difference if params.printed_feed_forward else jnp.abs(difference))


def _pass(params: Params, FF: Float[Array, ""]) -> Float[Array, ""]:
    """Open the gate (1) or close it (0) by the feed-forward cell (eq. 16)."""
    above = FF - params.suppression
    if params.smooth:
        return jax.nn.sigmoid((above if params.printed_gate else -above) / params.suppression_width)
    fast = above > 0
    return jnp.where(fast if params.printed_gate else ~fast, jnp.ones_like(FF), jnp.zeros_like(FF))


def _mean(cells: Float[Array, "height width"]) -> Float[Array, ""]:
    """Average over all cells, rows by a product with ones: XLA's sum adds one by one on a CPU."""
    ones = jnp.ones(cells.shape[1], cells.dtype)
    return jnp.sum(jnp.matmul(cells, ones, precision=lax.Precision.HIGHEST)) / cells.size


def _require_picture(frame: Array) -> None:
    if jnp.ndim(frame) != 2 or not jnp.issubdtype(frame.dtype, jnp.floating):
        raise InputError(
            f"lgmd: expected a picture of floats, grey 0..255, shape (height, width), got {frame.dtype} "
            f"{frame.shape}; use frame.astype(float), and vmap for several eyes"
        )


def _require_size(shape: tuple[int, ...], before: tuple[int, ...]) -> None:
    if shape != before:
        raise InputError(
            f"lgmd: expected a picture of {before[1]} x {before[0]} cells as before, got {shape[1]} x {shape[0]}; "
            "keep one resolution, or init again"
        )
