"""Lobula giant movement detector (LGMD): a model of the locust's neuron that responds to objects on a collision course.

One detector serves one eye. Each cell is excited by the change of its pixels since the last frame and inhibited, one
frame later, by the changes around it. Edges that move faster than the inhibition spreads pass: those of an approaching
object. Whole-field motion, such as a fast turn, is recognised by its total change and suppresses the response.

| symbol | name                  | unit        | equation |
| ------ | --------------------- | ----------- | -------- |
| L_f    | frame                 | grey 0..255 | 7        |
| P_f    | difference            | grey        | 7        |
| I_f    | layers.inhibition     | grey        | 8        |
| w_I    | kernel                | 1           | 9        |
| E_f    | layers.excitation     | grey        | 10       |
| S_f    | layers.summation      | grey        | 11       |
| W_I    | inhibition            | 1           | 11       |
| T_s    | threshold             | grey        | 12       |
| U_f/n  | response.excitation   | grey        | 13, 14   |
| u_f    | response.u            | 1, 0.5..1   | 14, 16   |
| FF     | response.feed_forward | grey        | 15       |
| w      | column_weights        | 1           | -        |
| T_f    | suppression           | grey        | 16       |

Source: Cizek & Faigl, sec. 3.3; Blanchard, Rind & Verschure 2000. Two equations contradict the text as printed and are
corrected: eq. 15 averages the signed change, which is zero for a moving edge (`printed_feed_forward`), and eq. 16 keeps
u when FF is high, where the text says that high FF suppresses it (`printed_gate`). Cells outside the image are zero.

The paper has one cell per pixel; with `pooling` n a cell averages about n x n pixels. A resolved texture at distance d
moves across the image at v/d, but it is finer by the same factor, so it causes the same change at any distance.
Cells of several degrees average out distant, fine texture, as the locust's facets do, and keep what is near. The
difference between the u of the two eyes correlates with the difference in nearness as follows (320 x 240 pixels):

| pooling | r    |
| ------- | ---- |
| 1       | 0.14 |
| 8       | 0.8  |

With a `falloff` p the means of eqs. 13 and 15 are weighted by the bearing theta of a cell's column:

    w(theta) = min(1, sin(theta_0) / sin(theta))^p,  theta_0 = 20 degrees,

divided by the mean of all w. An obstacle that a robot passes at a distance y from its path moves across the image at
v sin(theta)^2 / y, fastest when it is beside the robot and no longer matters; p = 2 compensates for that. The first
column of a frame is then the outermost one, for the right eye too (`hemifield.outermost_first`).

The sum of the kernel is 2.92, and times W_I it is 1.168. So where a change repeats itself, the summation is negative,
and only new edges pass. The frame after `init` has no last change yet, hence no inhibition.

Gradient: thresholds are steps, so the gradients of T_s and T_f are zero and the others are exact almost everywhere.
With `smooth` both steps are sigmoids of a width in grey levels, which tend to the steps as the width tends to zero.
"""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from lgmdjax.detectors import cells
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable

KERNEL_RADIUS = 2  # n of eq. 8: inhibition extends over two rows and columns
U_AT_REST = cells.U_AT_REST
SCALARS = ("threshold", "suppression", "inhibition")  # T_s, T_f, W_I: the constants that are calibrated
FULL_WEIGHT_BEARING = math.radians(20.0)  # theta_0, up to which all cells have the same weight

# w_I (eq. 9)
KERNEL = (
    (0.06, 0.12, 0.25, 0.12, 0.06),
    (0.12, 0.06, 0.12, 0.06, 0.12),
    (0.25, 0.12, 0.00, 0.12, 0.25),
    (0.12, 0.06, 0.12, 0.06, 0.12),
    (0.06, 0.12, 0.25, 0.12, 0.06),
)


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
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
    falloff: float = struct.field(pytree_node=False, default=0.0)  # p; 0 as in the paper
    edges: tuple[float, float] = struct.field(pytree_node=False, default=(math.radians(85.0), 0.0))  # bearing, rad
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


def init(params: Params, frame: cells.Frame) -> State:
    """Return the state after a first frame, before any change."""
    cells.require_frame("lgmd", frame, takes_bytes=True)
    pooled = pool(params, frame)
    return State(frame=pooled, difference=jnp.zeros_like(pooled))


def step(params: Params, state: State, frame: cells.Frame) -> tuple[State, Response]:
    """Process the next frame (eqs. 7-16).

    Raises `InputError` during tracing if the frame differs in size from the last one or is of neither floats nor bytes.

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
    now = layers(params, state, frame)
    U = _mean_excitation(params, now.summation)
    FF = _feed_forward(params, state.difference)
    u = U_AT_REST + _gate(params, FF) * (jax.nn.sigmoid(U) - U_AT_REST)
    return State(frame=pool(params, frame), difference=now.difference), Response(u=u, feed_forward=FF, excitation=U)


def layers(params: Params, state: State, frame: cells.Frame) -> Layers:
    """Return the layers of cells for the next frame (eqs. 7-11)."""
    cells.require_frame("lgmd", frame, takes_bytes=True)
    pooled = pool(params, frame)
    cells.require_size("lgmd", pooled, state.frame)
    P = pooled - state.frame
    E = jnp.abs(P)
    I = inhibit(params.kernel, state.difference)  # noqa: E741
    return Layers(difference=P, excitation=E, inhibition=I, summation=E - jnp.abs(I) * params.inhibition)


def pool(params: Params, frame: cells.Frame) -> Float[Array, "rows columns"]:
    """Average a frame over the square of each cell (`lgmdjax.detectors.cells.pool`).

    The sums of an 8-bit frame are whole numbers, exact in any order. So all machines and compilers get the same cells,
    and agree about a cell at the threshold.

    >>> pool(Params(pooling=2), jnp.arange(8.0).reshape(2, 4)).tolist()
    [[2.5, 4.5]]
    """
    return cells.pool(frame, params.pooling)


def inhibit(kernel: Float[Array, "5 5"], difference: Float[Array, "height width"]) -> Float[Array, "height width"]:
    """Return the last change, spread over the neighbours (eq. 8); zero beyond the border.

    The kernel is replaced by the mean of its four mirror images. The detectors of the left and right eye then remain
    mirror images of each other whatever is learned. Rows can also be added in pairs before they are weighted: 13
    products per cell instead of 25, which XLA compiles to one vectorised loop (`lax.conv` takes 30 times as long on a
    CPU).
    """
    height, width = difference.shape
    padded = jnp.pad(difference, KERNEL_RADIUS)
    quarter = kernel_quarter(kernel).astype(difference.dtype)

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
    for name in (*SCALARS, "kernel"):
        value = np.asarray(getattr(params, name), dtype=float)
        if not np.all(np.isfinite(value) & (value >= 0)):
            raise InputError(f"lgmd {name}: expected finite numbers >= 0, got {value.min()}; see lgmd.Params")
    if not (0 <= params.falloff < math.inf and all(abs(edge) <= math.pi for edge in params.edges)):
        raise InputError(
            f"lgmd falloff: expected a finite number >= 0 and edges within pi rad, got {params.falloff} and "
            f"{params.edges}; 0 gives all cells the same weight"
        )
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
        raise InputError("lgmd kernel: expected a symmetric kernel, got different weights on two sides; average them")


def _mean_excitation(params: Params, summation: Float[Array, "height width"]) -> Float[Array, ""]:
    """Return the mean over the cells of what exceeds T_s (eqs. 12, 13, and the division of eq. 14) [grey]."""
    S, margin = summation, summation - params.threshold
    sigmoid = params.smooth
    # A pixel that is not a number must show in u: `margin >= 0` would count it as no excitation.
    passed = S * jax.nn.sigmoid(margin / params.threshold_width) if sigmoid else jnp.where(margin < 0, 0.0, S)
    return _mean(params, jnp.abs(passed))


def kernel_quarter(kernel: Float[Array, "5 5"]) -> Float[Array, "3 3"]:
    """Return the weights by distance in rows and columns, averaged over the kernel's four mirror images."""
    w = (kernel + kernel[::-1]) / 2
    return ((w + w[:, ::-1]) / 2)[KERNEL_RADIUS:, KERNEL_RADIUS:]


def _feed_forward(params: Params, difference: Float[Array, "height width"]) -> Float[Array, ""]:
    """Return FF, the mean magnitude of the last change (eq. 15), or the mean of the change itself as printed."""
    return _mean(params, difference if params.printed_feed_forward else jnp.abs(difference))


def _gate(params: Params, FF: Float[Array, ""]) -> Float[Array, ""]:
    """Return 0 where FF suppresses the response, else 1 (eq. 16)."""
    excess = FF - params.suppression
    if params.smooth:
        return jax.nn.sigmoid((excess if params.printed_gate else -excess) / params.suppression_width)
    is_high = excess > 0
    return jnp.where(is_high if params.printed_gate else ~is_high, jnp.ones_like(FF), jnp.zeros_like(FF))


def column_weights(params: Params, columns: int) -> Float[np.ndarray, " columns"]:
    """Return the weight of each column of cells, the outermost first; their mean is 1.

    >>> column_weights(Params(falloff=2.0), 4).round(2).tolist()
    [0.29, 0.42, 0.97, 2.31]
    """
    outer, inner = params.edges
    theta = np.abs(outer + (inner - outer) * (np.arange(columns) + 0.5) / columns)
    weights = np.minimum(1.0, math.sin(FULL_WEIGHT_BEARING) / np.maximum(np.sin(theta), 1e-9)) ** params.falloff
    return weights / weights.mean()


def _mean(params: Params, layer: Float[Array, "rows columns"]) -> Float[Array, ""]:
    """Return the mean over all cells, weighted by the bearing of their column."""
    return cells.mean(layer, column_weights(params, layer.shape[1]))
