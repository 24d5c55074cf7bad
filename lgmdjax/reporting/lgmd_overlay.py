"""Overlay image of two LGMDs: the pictures of both eyes, the layers E, I and S, and u over the last frames.

| panels | content                                                                               |
| ------ | ------------------------------------------------------------------------------------- |
| eyes   | pictures, orange where S exceeds the threshold T_s                                    |
| E, I   | excitation and inhibition, multiplied by eight                                        |
| S      | summation: orange where it exceeds T_s, blue where inhibition outweighs excitation    |
| below  | u of the last frames, left blue and right orange                                      |
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from lgmdjax.detectors.lgmd import U_AT_REST, Layers

PANEL_TITLES = ("left eye | right eye, above T_s in orange", "E  excitation", "I  inhibition", "S  summation")
LAYER_GAIN = 8.0  # of the layers, which change by only a few grey levels
GAP, LINE_HEIGHT, CURVE_HEIGHT = 4, 20, 96  # px: between panels, of a line of text, of the curves
HISTORY_FRAMES = 150  # frames of u in the curves
MIN_PANEL_HEIGHT = 200  # px; smaller pictures are enlarged
BACKGROUND, TEXT_COLOUR, GRID_COLOUR = (24, 24, 24), (235, 235, 235), (90, 90, 90)
ABOVE_THRESHOLD_COLOUR, INHIBITED_COLOUR = np.array([255.0, 130.0, 30.0]), np.array([40.0, 90.0, 255.0])
EYE_COLOURS = ("#56B4E9", "#E69F00")  # blue and orange as in the figures, in lighter shades for a dark background


class Layout(NamedTuple):
    """Positions of the panels, and the background with everything that is the same in all images."""

    scale: int  # enlargement of the pictures
    panel_corners: tuple[tuple[int, int], ...]  # px: top, left of the four panels
    curve_box: tuple[int, int, int, int]  # px: left, top, right, bottom of the curves
    background: Image.Image


class ResponseSample(NamedTuple):
    """Responses of both LGMDs to one frame; left, right."""

    time: float  # s
    u: tuple[float, float]
    feed_forward: tuple[float, float]  # grey


def make_layout(rows: int, columns: int) -> Layout:
    """Lay out the overlay of two eyes of rows x columns pixels.

    >>> make_layout(60, 80).scale
    3
    """
    scale = max(1, round(MIN_PANEL_HEIGHT / rows))
    panel_height, panel_width = rows * scale, 2 * columns * scale + GAP
    corners = tuple(
        (LINE_HEIGHT + row * (panel_height + LINE_HEIGHT), GAP + column * (panel_width + GAP))
        for row in range(2)
        for column in range(2)
    )
    width, height = 2 * panel_width + 3 * GAP, 2 * (panel_height + LINE_HEIGHT) + LINE_HEIGHT + CURVE_HEIGHT
    background = Image.new("RGB", (width + width % 2, height + height % 2), BACKGROUND)
    pen = ImageDraw.Draw(background)
    for title, (top, left) in zip(PANEL_TITLES, corners, strict=True):
        pen.text((left + 2, top - LINE_HEIGHT + 2), title, fill=TEXT_COLOUR, font=ImageFont.load_default(13))
    curve_box = (GAP + 32, height - CURVE_HEIGHT + 4, width - GAP, height - 8)
    for level in (U_AT_REST, 0.75, 1.0):
        y = _to_pixel(curve_box, level)
        pen.line([(curve_box[0], y), (curve_box[2], y)], fill=GRID_COLOUR)
        pen.text((GAP, y - 7), f"{level:.2f}", fill=TEXT_COLOUR, font=ImageFont.load_default(11))
    return Layout(scale, corners, curve_box, background)


def render_overlay(
    layout: Layout,
    pictures: Float[ndarray, "2 rows columns"],
    layers: Layers,
    threshold: float,
    history: Sequence[ResponseSample],
) -> UInt8[ndarray, "height width 3"]:
    """Render the overlay of one frame.

    Args:
        layout: from `make_layout`.
        pictures: of the left and the right eye, in grey levels 0..255.
        layers: of both LGMDs.
        threshold: T_s [grey].
        history: responses up to this frame, the last of which is this frame's.
    """
    E, I, S = (np.asarray(layer) for layer in (layers.excitation, layers.inhibition, layers.summation))  # noqa: E741
    is_above = (threshold <= S) & (S != 0)
    summation = _tint(_to_rgb(LAYER_GAIN * S), S < 0, INHIBITED_COLOUR, LAYER_GAIN * np.abs(S))
    panels = (
        _tint(_to_rgb(pictures), is_above, ABOVE_THRESHOLD_COLOUR),
        _to_rgb(LAYER_GAIN * E),
        _to_rgb(LAYER_GAIN * np.abs(I)),
        _tint(summation, is_above, ABOVE_THRESHOLD_COLOUR, LAYER_GAIN * S),
    )
    image = layout.background.copy()
    for (top, left), panel in zip(layout.panel_corners, panels, strict=True):
        for side, eye in enumerate(panel):
            enlarged = Image.fromarray(eye.repeat(layout.scale, 0).repeat(layout.scale, 1))
            image.paste(enlarged, (left + side * (enlarged.width + GAP), top))
    _add_curves(ImageDraw.Draw(image), layout, history)
    return np.asarray(image)


def _to_rgb(values: Float[ndarray, "2 rows columns"]) -> UInt8[ndarray, "2 rows columns 3"]:
    return np.repeat(np.clip(values, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def _tint(
    rgb: UInt8[ndarray, "2 rows columns 3"],
    mask: Bool[ndarray, "2 rows columns"],
    colour: Float[ndarray, "3"],
    brightness: ndarray | float = 255.0,
) -> UInt8[ndarray, "2 rows columns 3"]:
    """Colour the cells of a mask in proportion to their brightness, but never too dark to see."""
    strength = np.clip(np.broadcast_to(brightness, mask.shape) / 255, 0.35, 1)
    return np.where(mask[..., None], strength[..., None] * colour, rgb).astype(np.uint8)


def _add_curves(pen: ImageDraw.ImageDraw, layout: Layout, history: Sequence[ResponseSample]) -> None:
    """Add the newest response as text and the last responses as curves."""
    now, (left, top, right, _) = history[-1], layout.curve_box
    font = ImageFont.load_default(13)
    pen.text((left, top - LINE_HEIGHT), f"{now.time:.2f} s", fill=TEXT_COLOUR, font=font)
    for side, (name, colour) in enumerate(zip(("left", "right"), EYE_COLOURS, strict=True)):
        text = f"{name} eye: u {now.u[side]:.2f}, FF {now.feed_forward[side]:.1f}"
        pen.text((left + 80 + 180 * side, top - LINE_HEIGHT), text, fill=colour, font=font)
    shown = history[-HISTORY_FRAMES:]
    for side, colour in enumerate(EYE_COLOURS):
        points = [
            (
                right - (len(shown) - 1 - i) * (right - left) / HISTORY_FRAMES,
                _to_pixel(layout.curve_box, sample.u[side]),
            )
            for i, sample in enumerate(shown)
        ]
        pen.line(points, fill=colour, width=2)


def _to_pixel(curve_box: tuple[int, int, int, int], u: float) -> float:
    """Convert a value of u into its row [px]."""
    return curve_box[3] - (u - U_AT_REST) / (1 - U_AT_REST) * (curve_box[3] - curve_box[1])
