"""Operations on layers of cells: pooling, neighbourhoods, thresholds, filters, grouping, checks.

| symbol    | name             | unit | meaning                                                      |
| --------- | ---------------- | ---- | ------------------------------------------------------------ |
| dt        | frame_time       | s    | time from one frame to the next                              |
| tau       | time_constant    | s    | of a filter of the first order                               |
| S         | summation        | grey | cells that are grouped                                       |
| Ce        | -                | grey | mean of the 3 x 3 cells around each: its passing coefficient |
| w, C_w, D | -, share, offset | grey | w = D + max |Ce| / C_w, the scale of Ce                      |

The 3 x 3 kernels of the detectors depend on the distance alone, so a neighbourhood is two sums: over the four nearest
cells and over the four diagonal ones. Such weights stay mirror-symmetric whatever is learned.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt8

from lgmdjax.errors import InputError
from lgmdjax.minmax import amin

U_AT_REST = 0.5  # response without motion
MAX_BAND = 120  # columns up to which correlations are products with banded matrices

Scalar = Float[Array, ""] | float
Cells = Float[Array, "rows columns"]
Frame = Float[Array, "height width"] | UInt8[Array, "height width"]
"""An image of one eye, grey levels 0..255, in floating point or as a camera delivers it."""


class Neighbours(NamedTuple):
    """Sums over the cells around each cell."""

    nearest: Cells  # left, right, above, below
    diagonal: Cells


def neighbours(cells: Cells) -> Neighbours:
    """Return the sums over the four nearest and four diagonal neighbours; cells on the border replace missing ones.

    >>> neighbours(jnp.asarray([[1.0, 2.0], [3.0, 4.0]])).nearest.tolist()
    [[7.0, 9.0], [11.0, 13.0]]
    """
    padded = jnp.pad(cells, 1, mode="edge")
    vertical, middle = padded[:-2] + padded[2:], padded[1:-1]
    nearest = vertical[:, 1:-1] + middle[:, :-2] + middle[:, 2:]
    return Neighbours(nearest=nearest, diagonal=vertical[:, :-2] + vertical[:, 2:])


def local_mean(cells: Cells) -> Cells:
    """Return the mean of the 3 x 3 cells around each cell."""
    around = neighbours(cells)
    return (cells + around.nearest + around.diagonal) / 9


def group(summation: Cells, share: Scalar, offset: Scalar) -> Cells:
    """Return S Ce / w: cells in a cluster are raised up to C_w times, isolated ones are lowered (Yue & Rind 2006).

    Gradient: of the maximum, that of the first largest |Ce|.

    Args:
        summation: S.
        share: C_w.
        offset: D, keeps the scale above zero.
    """
    Ce = local_mean(summation)
    w = offset - amin(-jnp.abs(Ce).ravel(), 0) / share
    return summation * Ce / w


def correlate(
    layers: Float[Array, "layers rows columns"],
    weights: Float[Array, "layers K K"],
    before: int,
    after: int,
    stride: int = 1,
) -> Float[Array, "layers out_rows out_columns"]:
    """Return each layer correlated with its weights; cells beyond the border are zero.

    Small layers are multiplied with banded matrices, one for each row of the weights: on a CPU that takes a half to a
    quarter of the time of `lax.conv`, and its derivative a fifth. A band wastes products in proportion to the width.

    >>> ramp = jnp.arange(5.0)[None, None]
    >>> correlate(ramp, jnp.asarray([[[0.0, 1.0, 2.0]] * 3]), 1, 1)[0, 0].tolist()
    [2.0, 5.0, 8.0, 11.0, 4.0]

    Args:
        layers: of cells.
        weights: of the cells around each, the same number in rows and columns.
        before: cells of zeros added above and to the left.
        after: the same below and to the right.
        stride: cells from one output to the next.
    """
    count, rows, columns = layers.shape
    side = weights.shape[-1]
    if columns > MAX_BAND:
        padding = ((before, after), (before, after))
        return lax.conv_general_dilated(
            layers[None],
            weights[:, None],
            (stride, stride),
            padding,
            feature_group_count=count,
            precision=lax.Precision.HIGHEST,
        )[0]
    out_rows, out_columns = ((size + before + after - side) // stride + 1 for size in (rows, columns))
    padded = jnp.pad(layers, ((0, 0), (before, after), (0, 0)))
    last = (out_rows - 1) * stride + 1
    shifted = jnp.stack([padded[:, row : row + last : stride] for row in range(side)], axis=1)
    offset = np.arange(columns)[:, None] - stride * np.arange(out_columns) + before
    band = jnp.where((offset >= 0) & (offset < side), weights[..., np.clip(offset, 0, side - 1)], 0.0)
    return jnp.einsum("lkrc,lkcx->lrx", shifted, band.astype(layers.dtype), precision=lax.Precision.HIGHEST)


def gate(margin: Array, width: Scalar | None) -> Array:
    """Return 1 where the margin is zero or more and else 0; with a width a sigmoid instead.

    Gradient: zero for the step.

    >>> gate(jnp.asarray([-1.0, 0.0, 2.0]), None).tolist()
    [0.0, 1.0, 1.0]
    """
    if width is None:
        return jnp.where(margin >= 0, jnp.ones_like(margin), jnp.zeros_like(margin))
    return jax.nn.sigmoid(margin / width)


def low_pass(before: Array, now: Array, frame_time: float, time_constant: Scalar) -> Array:
    """Return the next output of a low-pass filter of the first order (backward Euler).

    Args:
        before: last output.
        now: input.
        frame_time: dt [s].
        time_constant: tau [s].
    """
    return before + (now - before) * (frame_time / (frame_time + time_constant))


def high_pass(before: Array, change: Array, frame_time: float, time_constant: Scalar) -> Array:
    """Return the next output of a high-pass filter of the first order (backward Euler).

    Args:
        before: last output.
        change: of the input since the last frame.
        frame_time: dt [s].
        time_constant: tau [s].
    """
    return (before + change) * (time_constant / (frame_time + time_constant))


def rectify(x: Array) -> Array:
    """Return max(x, 0).

    Gradient: 0 at 0.
    """
    return jnp.where(x > 0, x, jnp.zeros_like(x))


def mean(cells: Cells, weights: Float[np.ndarray, " columns"] | None = None) -> Float[Array, ""]:
    """Return the mean over all cells; `weights` of their columns have the mean 1.

    Rows are summed by a product with the weights, since XLA's sum on a CPU is not vectorised.
    """
    columns = jnp.ones(cells.shape[1], cells.dtype) if weights is None else jnp.asarray(weights, cells.dtype)
    return jnp.sum(jnp.matmul(cells, columns, precision=lax.Precision.HIGHEST)) / cells.size


def pool(frame: Frame, pooling: int) -> Cells:
    """Average a frame over the square of each cell.

    The side of a cell is as near to `pooling` pixels as a whole number of cells allows. The cells divide the frame
    evenly: a pixel on their border counts partly for each. Mirrored frames give mirrored cells. Frames of bytes are
    summed exactly, so that any compiler gives the same bits.

    >>> pool(jnp.arange(8.0).reshape(2, 4), 2).tolist()
    [[2.5, 4.5]]
    """
    if pooling == 1:
        return as_float(frame)
    (rows, row_total), (columns, column_total) = (pooling_parts(size, pooling) for size in frame.shape)
    if frame.dtype == jnp.uint8:
        sums = _sum_cells(rows, as_float(frame), columns)
        # The zero hides a constant: XLA would multiply by its inverse, and in some programs fuse that product with the
        # difference of two frames, which is then rounded differently.
        return sums / (row_total * column_total + 0 * sums[0, 0])
    return _sum_cells(rows / row_total, frame, columns / column_total)


def pooling_parts(pixels: int, pooling: int) -> tuple[Int[np.ndarray, "cells pixels"], int]:
    """Return how many parts of each pixel are in each cell, along one side of the frame, and how many parts a cell has.

    >>> pooling_parts(5, 2)  # the pixel in the middle is in both cells
    (array([[2, 2, 1, 0, 0],
           [0, 0, 1, 2, 2]]), 5)
    """
    cells = max(round(pixels / pooling), 1)
    divisor = math.gcd(cells, pixels)
    total, part = pixels // divisor, cells // divisor
    cell, pixel = np.arange(cells)[:, None], np.arange(pixels)
    common = np.minimum((cell + 1) * total, (pixel + 1) * part) - np.maximum(cell * total, pixel * part)
    return np.maximum(common, 0), total


def _sum_cells(rows: np.ndarray, frame: Float[Array, "height width"], columns: np.ndarray) -> Array:
    """Return the sums over cells, with pixels weighted by row and column."""
    cells, height = rows.shape
    if height % cells == 0:  # a sum of whole rows takes a quarter of the product's time
        inner = jnp.sum(frame.reshape(cells, height // cells, -1), axis=1) * float(rows[0, 0])
    else:
        inner = jnp.matmul(jnp.asarray(rows, frame.dtype), frame, precision=lax.Precision.HIGHEST)
    return jnp.matmul(inner, jnp.asarray(columns, frame.dtype).T, precision=lax.Precision.HIGHEST)


def as_float(frame: Frame) -> Float[Array, "height width"]:
    """Return a frame as floats, the grey levels 0..255 of bytes unchanged."""
    return frame.astype(float) if frame.dtype == jnp.uint8 else frame


def require_frame(detector: str, frame: Array, *, takes_bytes: bool = False) -> None:
    """Raise `InputError` unless a frame has rows and columns of floats, or of bytes where the detector takes them."""
    is_grey = jnp.issubdtype(frame.dtype, jnp.floating) or (takes_bytes and frame.dtype == jnp.uint8)
    if jnp.ndim(frame) != 2 or not is_grey:
        kinds = "floats or uint8" if takes_bytes else "floats"
        raise InputError(
            f"{detector}: expected a frame of {kinds}, grey 0..255, shape (height, width), got {frame.dtype} "
            f"{frame.shape}; use frame.astype(float), and vmap for several eyes"
        )


def require_size(detector: str, cells: Array, before: Array) -> None:
    """Raise `InputError` unless there are as many cells as in the last frame."""
    if cells.shape != before.shape:
        raise InputError(
            f"{detector}: expected a frame of {before.shape[1]} x {before.shape[0]} cells as before, got "
            f"{cells.shape[1]} x {cells.shape[0]}; keep one resolution, or init again"
        )
