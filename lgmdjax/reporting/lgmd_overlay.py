"""One picture of what two LGMDs do with a frame: what the eyes see, the layers E, I and S, the course of u.

| panels | what is drawn                                                                     |
| ------ | --------------------------------------------------------------------------------- |
| eyes   | what they see, and in orange where S passes the threshold T_s                     |
| E, I   | excitation and inhibition, eight times as bright as the change                    |
| S      | their difference: orange where it passes T_s, blue where inhibition outweighs     |
| below  | u of the last frames, left blue and right orange                                  |
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from lgmdjax.detectors.lgmd import STILL, Layers

NAMES = ("left eye | right eye, passed T_s in orange", "E  excitation", "I  inhibition", "S  summation")
GAIN = 8.0  # of the layers, whose changes are of a few grey levels
GAP, LINE, STRIP = 4, 20, 96  # px: between panels, of text, of the curves
SPAN = 150  # frames of u that the strip shows
SMALL = 200  # px; lower pictures are drawn larger
PAPER, INK, FAINT = (24, 24, 24), (235, 235, 235), (90, 90, 90)
PASSED, HELD = np.array([255.0, 130.0, 30.0]), np.array([40.0, 90.0, 255.0])
EYES = (
    "#56B4E9",
    "#E69F00",
)  # blue and orange as in the figures, in the shades of the palette for dark ground


class Sheet(NamedTuple):
    """Where everything goes, and what never changes."""

    scale: int
    corners: tuple[tuple[int, int], ...]  # top, left of the four panels
    strip: tuple[int, int, int, int]  # left, top, right, bottom of the curves
    paper: Image.Image


class Moment(NamedTuple):
    """What the eyes say of one frame; left, right."""

    time: float
    u: tuple[float, float]
    feed_forward: tuple[float, float]


def lay_out(rows: int, columns: int) -> Sheet:
    """Plan the sheet for two eyes of rows x columns pixels."""
    scale = max(1, round(SMALL / rows))
    tall, wide = rows * scale, 2 * columns * scale + GAP
    corners = tuple(
        (LINE + row * (tall + LINE), GAP + column * (wide + GAP)) for row in range(2) for column in range(2)
    )
    width, height = 2 * wide + 3 * GAP, 2 * (tall + LINE) + LINE + STRIP
    paper = Image.new("RGB", (width + width % 2, height + height % 2), PAPER)
    pen = ImageDraw.Draw(paper)
    for name, (top, left) in zip(NAMES, corners, strict=True):
        pen.text((left + 2, top - LINE + 2), name, fill=INK, font=ImageFont.load_default(13))
    strip = (GAP + 32, height - STRIP + 4, width - GAP, height - 8)
    for level in (STILL, 0.75, 1.0):
        y = _height(strip, level)
        pen.line([(strip[0], y), (strip[2], y)], fill=FAINT)
        pen.text((GAP, y - 7), f"{level:.2f}", fill=INK, font=ImageFont.load_default(11))
    return Sheet(scale, corners, strip, paper)


def draw(
    sheet: Sheet,
    pictures: Float[ndarray, "2 rows columns"],
    layers: Layers,
    threshold: float,
    course: Sequence[Moment],
) -> UInt8[ndarray, "height width 3"]:
    """Draw one frame; `course` ends with it."""
    E, I, S = (np.asarray(layer) for layer in (layers.excitation, layers.inhibition, layers.summation))  # noqa: E741
    passed = (threshold <= S) & (S != 0)
    panels = (
        _paint(_grey(pictures), passed, PASSED),
        _grey(GAIN * E),
        _grey(GAIN * np.abs(I)),
        _paint(_paint(_grey(GAIN * S), S < 0, HELD, GAIN * np.abs(S)), passed, PASSED, GAIN * S),
    )
    image = sheet.paper.copy()
    for (top, left), panel in zip(sheet.corners, panels, strict=True):
        for side, eye in enumerate(panel):
            large = Image.fromarray(eye.repeat(sheet.scale, 0).repeat(sheet.scale, 1))
            image.paste(large, (left + side * (large.width + GAP), top))
    _write(ImageDraw.Draw(image), sheet, course)
    return np.asarray(image)


def _grey(values: Float[ndarray, "2 rows columns"]) -> UInt8[ndarray, "2 rows columns 3"]:
    return np.repeat(np.clip(values, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def _paint(colours: ndarray, mask: ndarray, colour: ndarray, brightness: ndarray | float = 255.0) -> ndarray:
    """Give the cells of a mask a colour, the brighter the larger their value, never too dark to see."""
    strength = np.clip(np.broadcast_to(brightness, mask.shape) / 255, 0.35, 1)
    return np.where(mask[..., None], strength[..., None] * colour, colours).astype(np.uint8)


def _write(pen: ImageDraw.ImageDraw, sheet: Sheet, course: Sequence[Moment]) -> None:
    """Write down the newest moment, and draw the last ones up to it."""
    now, (left, top, right, _) = course[-1], sheet.strip
    font = ImageFont.load_default(13)
    pen.text((left, top - LINE), f"{now.time:.2f} s", fill=INK, font=font)
    for side, (name, colour) in enumerate(zip(("left", "right"), EYES, strict=True)):
        text = f"{name} eye: u {now.u[side]:.2f}, FF {now.feed_forward[side]:.1f}"
        pen.text((left + 80 + 180 * side, top - LINE), text, fill=colour, font=font)
    shown = course[-SPAN:]
    for side, colour in enumerate(EYES):
        points = [
            (right - (len(shown) - 1 - i) * (right - left) / SPAN, _height(sheet.strip, moment.u[side]))
            for i, moment in enumerate(shown)
        ]
        pen.line(points, fill=colour, width=2)


def _height(strip: tuple[int, int, int, int], u: float) -> float:
    """Find the height on the strip [px] of a value of u."""
    return strip[3] - (u - STILL) / (1 - STILL) * (strip[3] - strip[1])
