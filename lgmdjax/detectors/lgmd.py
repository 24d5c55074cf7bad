"""Lobula giant movement detector (LGMD): a model of the locust's neuron that responds to objects on a collision course.

One detector serves one eye. Each cell is excited by the change of its pixels since the last frame and inhibited, one
frame later, by the changes around it. Edges that spread faster than the inhibition pass, which are those of an
approaching object. Whole-field motion, such as a fast turn, is recognised by its total change and suppresses the
response.

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

Source: Cizek & Faigl, sec. 3.3; Blanchard, Rind & Verschure 2000. Two equations contradict the text as printed and are
corrected: eq. 15 averages the signed change, which is zero for a moving edge (`printed_feed_forward`), and eq. 16 keeps
u when FF is high, where the text says that high FF suppresses it (`printed_gate`). Cells outside the image are zero.

The paper has one cell per pixel; with `pooling` n a cell averages about n x n pixels. A texture that is resolved moves
across the image at v/d, but it is finer by the same factor, so that the change it causes is the same at any distance.
Cells of several degrees average out distant, fine texture, as the locust's facets do, and keep what is near. The
difference between the u of the two eyes correlates with that of nearness as follows (320 x 240 pixels):

| pooling | r    |
| ------- | ---- |
| 1       | 0.14 |
| 8       | 0.8  |

The kernel sums to 2.92, times W_I to 1.168: where a change repeats itself, summation is negative, and only new edges
pass. The frame after `init` has no last change yet, hence no inhibition.

Gradient: thresholds are steps, so the gradients of T_s and T_f are zero and the others are exact almost everywhere.
With `smooth` both steps are sigmoids of a width in grey levels, which tend to the steps as the width tends to zero.
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

KERNEL_RADIUS = 2  # n of eq. 8: inhibition extends over two rows and columns
U_AT_REST = 0.5  # u without motion

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
    """Constants of the detector.

    T_s and T_f depend on resolution, textures and speed; `lgmdjax.learning.lgmd_grid_search` calibrates them.
    """

    threshold: Float[Array, ""] | float = 6.0  # T_s, grey
    suppression: Float[Array, ""] | float = 20.0  # T_f, grey
    inhibition: Float[Array, ""] | float = 0.4  # W_I
    kernel: Float[Array, "5 5"] = struct.field(default_factory=lambda: jnp.asarray(KERNEL, dtype=float))
    threshold_width: Float[Array, ""] | float = 1.0  # grey, of the sigmoid at T_s
    suppression_width: Float[Array, ""] | float = 1.0  # grey, of the sigmoid at T_f
    pooling: int = struct.field(pytree_node=False, default=1)  # px, side of the square that a cell averages
    smooth: bool = struct.field(pytree_node=False, default=False)  # sigmoids instead of steps
    printed_feed_forward: bool = struct.field(pytree_node=False, default=False)  # eq. 15: signed mean
    printed_gate: bool = struct.field(pytree_node=False, default=False)  # eq. 16: low FF suppresses


@struct.dataclass(kw_only=True)
class State:
    """The last pooled frame L_{f-1} and the last change P_{f-1}."""

    frame: Float[Array, "rows columns"]
    difference: Float[Array, "rows columns"]


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame; nan if a pixel of this frame or of the last two is not finite."""

    u: Float[Array, ""]  # eqs. 14, 16
    feed_forward: Float[Array, ""]  # FF, eq. 15 [grey]
    excitation: Float[Array, ""]  # U / n_cell, eqs. 13, 14 [grey]; determines u unless FF suppresses it


@struct.dataclass(kw_only=True)
class Layers:
    """Layers of cells for one frame, in grey levels, for figures and videos."""

    difference: Float[Array, "rows columns"]  # P, eq. 7
    excitation: Float[Array, "rows columns"]  # E, eq. 10
    inhibition: Float[Array, "rows columns"]  # I, eq. 8
    summation: Float[Array, "rows columns"]  # S, eq. 11, before the threshold


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    _require_frame(frame)
    pooled = pool(params, frame)
    return State(frame=pooled, difference=jnp.zeros_like(pooled))


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame (eqs. 7-16).

    Raises `InputError` during tracing if the frame has another size than the last one or is not of floats.

    Gradient: see the module; |.| of eqs. 8, 10 and 13 has derivative 0 at 0.

    >>> params = Params(threshold=2.0)
    >>> state = init(params, jnp.zeros((6, 8)))
    >>> state, response = step(params, state, jnp.full((6, 8), 10.0))
    >>> float(response.excitation), float(response.feed_forward), response.u.round(4).tolist()
    (10.0, 0.0, 1.0)

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    cells = layers(params, state, frame)
    U = _mean_excitation(params, cells.summation)
    FF = _feed_forward(params, state.difference)
    u = U_AT_REST + _gate(params, FF) * (jax.nn.sigmoid(U) - U_AT_REST)
    return State(frame=pool(params, frame), difference=cells.difference), Response(u=u, feed_forward=FF, excitation=U)


def layers(params: Params, state: State, frame: Float[Array, "height width"]) -> Layers:
    """Return the layers of cells for the next frame (eqs. 7-11)."""
    _require_frame(frame)
    pooled = pool(params, frame)
    _require_size(pooled.shape, state.frame.shape)
    P = pooled - state.frame
    E = jnp.abs(P)
    I = inhibit(params.kernel, state.difference)  # noqa: E741
    return Layers(difference=P, excitation=E, inhibition=I, summation=E - jnp.abs(I) * params.inhibition)


def pool(params: Params, frame: Float[Array, "height width"]) -> Float[Array, "rows columns"]:
    """Average a frame over the square of each cell.

    The number of cells is the one that comes nearest to `pooling` pixels a side. The cells divide the frame evenly,
    pixels on a border belong to two cells in part, and mirrored frames give mirrored cells.

    >>> pool(Params(pooling=2), jnp.arange(8.0).reshape(2, 4)).tolist()
    [[2.5, 4.5]]
    """
    if params.pooling == 1:
        return frame
    rows, columns = (jnp.asarray(_pooling_weights(size, params.pooling), frame.dtype) for size in frame.shape)
    matmul = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
    return matmul(matmul(rows, frame), columns.T)


def _pooling_weights(pixels: int, pooling: int) -> Float[np.ndarray, "cells pixels"]:
    """Return the weight of each pixel in each cell, along one side of the frame."""
    cells = max(round(pixels / pooling), 1)
    edges = np.arange(cells + 1) * pixels / cells
    pixel = np.arange(pixels)
    common = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    return np.clip(common, 0.0, None) * cells / pixels


def inhibit(kernel: Float[Array, "5 5"], difference: Float[Array, "height width"]) -> Float[Array, "height width"]:
    """Return the last change, spread over the neighbours (eq. 8); zero beyond the border.

    The kernel is replaced by the mean of its four mirror images. The detectors of the left and right eye then remain
    mirror images of each other whatever is learned. Rows can also be added in pairs before they are weighted: 13
    products a cell instead of 25, which XLA compiles to one vectorised loop (`lax.conv` takes 30 times as long on a
    CPU).
    """
    height, width = difference.shape
    padded = jnp.pad(difference, KERNEL_RADIUS)
    quarter = _quarter(kernel).astype(difference.dtype)

    def row(i: int) -> Array:
        return lax.slice_in_dim(padded, KERNEL_RADIUS + i, KERNEL_RADIUS + i + height, axis=0)

    def shifted(rows: Array, j: int) -> Array:
        return lax.slice_in_dim(rows, KERNEL_RADIUS + j, KERNEL_RADIUS + j + width, axis=1)

    rows = (row(0), row(1) + row(-1), row(2) + row(-2))
    inner, near, far = (w[0] * rows[0] + w[1] * rows[1] + w[2] * rows[2] for w in quarter.T)
    return shifted(inner, 0) + shifted(near, 1) + shifted(near, -1) + shifted(far, 2) + shifted(far, -2)


def with_smooth_thresholds(params: Params, relative_width: Float[Array, ""] | float) -> Params:
    """Return parameters with sigmoids instead of steps, whose gradients reach T_s and T_f.

    Args:
        params: of the detector.
        relative_width: widths of the sigmoids, as a fraction of T_s (at least of 0.1 grey) and of T_f.
    """
    widths = {
        "threshold_width": relative_width * jnp.maximum(params.threshold, 0.1),
        "suppression_width": relative_width * params.suppression,
    }
    return replace(params, smooth=True, **widths)


def check(params: Params) -> None:
    """Raise `InputError` if a constant is negative or not finite, or if the kernel is not symmetric."""
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
    if w.shape != (2 * KERNEL_RADIUS + 1, 2 * KERNEL_RADIUS + 1):
        raise InputError(f"lgmd kernel: expected shape (5, 5), got {w.shape}; eq. 9 is lgmd.KERNEL")
    if not (np.allclose(w, w[::-1]) and np.allclose(w, w[:, ::-1])):
        raise InputError("lgmd kernel: expected a symmetric kernel, got other weights on one side; average them")


def _mean_excitation(params: Params, summation: Float[Array, "height width"]) -> Float[Array, ""]:
    """Return the mean over the cells of what exceeds T_s (eqs. 12, 13, and the division of eq. 14) [grey]."""
    S, margin = summation, summation - params.threshold
    sigmoid = params.smooth
    # A pixel that is not a number has to show: `margin >= 0` would count it as no excitation.
    passed = S * jax.nn.sigmoid(margin / params.threshold_width) if sigmoid else jnp.where(margin < 0, 0.0, S)
    return _mean(jnp.abs(passed))


def _quarter(kernel: Float[Array, "5 5"]) -> Float[Array, "3 3"]:
    """Return the weights by distance in rows and columns, averaged over the kernel's four mirror images."""
    w = (kernel + kernel[::-1]) / 2
    return ((w + w[:, ::-1]) / 2)[KERNEL_RADIUS:, KERNEL_RADIUS:]


def _feed_forward(params: Params, difference: Float[Array, "height width"]) -> Float[Array, ""]:
    """Return FF, the mean magnitude of the last change (eq. 15), or the mean of the change itself as printed."""
    return _mean(difference if params.printed_feed_forward else jnp.abs(difference))


def _gate(params: Params, FF: Float[Array, ""]) -> Float[Array, ""]:
    """Return 0 where FF suppresses the response, else 1 (eq. 16)."""
    excess = FF - params.suppression
    if params.smooth:
        return jax.nn.sigmoid((excess if params.printed_gate else -excess) / params.suppression_width)
    is_high = excess > 0
    return jnp.where(is_high if params.printed_gate else ~is_high, jnp.ones_like(FF), jnp.zeros_like(FF))


def _mean(cells: Float[Array, "height width"]) -> Float[Array, ""]:
    """Return the mean over all cells, with rows summed by a product with ones: XLA's sum on a CPU is not vectorised."""
    ones = jnp.ones(cells.shape[1], cells.dtype)
    return jnp.sum(jnp.matmul(cells, ones, precision=lax.Precision.HIGHEST)) / cells.size


def _require_frame(frame: Array) -> None:
    if jnp.ndim(frame) != 2 or not jnp.issubdtype(frame.dtype, jnp.floating):
        raise InputError(
            f"lgmd: expected a frame of floats, grey 0..255, shape (height, width), got {frame.dtype} {frame.shape}; "
            "use frame.astype(float), and vmap for several eyes"
        )


def _require_size(shape: tuple[int, ...], before: tuple[int, ...]) -> None:
    if shape != before:
        raise InputError(
            f"lgmd: expected a frame of {before[1]} x {before[0]} cells as before, got {shape[1]} x {shape[0]}; "
            "keep one resolution, or init again"
        )
