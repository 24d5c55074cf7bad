"""The upright picture of a video: its display matrix and the shape of its pixels.

A stored pixel (x, y) is shown at (a x + c y, b x + d y), up to a shift. Signs and zeros of a, b, c, d give the eight
orientations of a picture; other angles are rounded to the nearest of them.

Source: ISO/IEC 14496-12, 6.2.2, as FFmpeg reads it (`libavutil/display.h`).
"""

import struct
from fractions import Fraction
from typing import NamedTuple

import av
import numpy as np
from jaxtyping import UInt8


class Orientation(NamedTuple):
    """How a stored picture is brought upright: transposed first, then flipped."""

    transpose: bool = False
    flip_rows: bool = False
    flip_columns: bool = False


def from_matrix(a: float, b: float, c: float, d: float) -> Orientation:
    """Return the orientation of a display matrix.

    >>> from_matrix(0, 1, -1, 0)  # a quarter turn clockwise
    Orientation(transpose=True, flip_rows=False, flip_columns=True)
    """
    transpose = abs(b) + abs(c) > abs(a) + abs(d)
    x, y = (c, b) if transpose else (a, d)
    return Orientation(transpose, flip_rows=y < 0, flip_columns=x < 0)


def of_frame(frame: av.VideoFrame) -> Orientation:
    """Return the orientation of a decoded frame, which has the display matrix of its stream."""
    stored = frame.side_data.get("DISPLAYMATRIX")
    if stored is None:
        return Orientation()
    a, b, _, c, d, *_ = struct.unpack("=9i", bytes(stored))
    return from_matrix(a, b, c, d)


def to_upright(picture: UInt8[np.ndarray, "rows columns"], orientation: Orientation) -> UInt8[np.ndarray, "..."]:
    """Bring a stored picture upright."""
    upright = picture.T if orientation.transpose else picture
    return upright[:: -1 if orientation.flip_rows else 1, :: -1 if orientation.flip_columns else 1]


def swap_axes(size: tuple[int, int], orientation: Orientation) -> tuple[int, int]:
    """Exchange width and height if the orientation transposes."""
    return (size[1], size[0]) if orientation.transpose else size


def square_size(width: int, height: int, pixel_aspect: Fraction) -> tuple[int, int]:
    """Return the size of a picture with square pixels; it is never enlarged, but averaged along the other axis.

    >>> square_size(720, 576, Fraction(16, 15)), square_size(432, 240, Fraction(80, 81))
    ((720, 540), (427, 240))

    Args:
        width: of the picture [px].
        height: of the picture [px].
        pixel_aspect: width / height of a pixel.
    """
    if pixel_aspect > 1:
        return width, max(1, round(height / pixel_aspect))
    return max(1, round(width * pixel_aspect)), height
