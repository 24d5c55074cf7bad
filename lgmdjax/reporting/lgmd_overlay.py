"""Overlay image of two LGMDs: the pictures of both eyes, the layers E, I and S, and u over the last frames.

| panels | content                                                                               |
| ------ | ------------------------------------------------------------------------------------- |
| eyes   | pictures, orange where S exceeds the threshold T_s                                    |
| E, I   | excitation and inhibition, multiplied by eight                                        |
| S      | summation: orange where it exceeds T_s, blue where inhibition outweighs excitation    |
| below  | u of the last frames, left blue and right orange; thin lines: the adapted response;   |
|        | red: alarms                                                                           |
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, UInt8, UInt16, UInt32
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from lgmdjax.detectors.lgmd import U_AT_REST, Layers
from lgmdjax.errors import InputError
from lgmdjax.sensors import hemifield

FloatT = TypeVar("FloatT", float, ndarray)
PANEL_TITLES = ("left eye | right eye, above T_s in orange", "E  excitation", "I  inhibition", "S  summation")
LAYER_GAIN = 8.0  # of the layers, which change by only a few grey levels
GAP, LINE_HEIGHT, CURVE_HEIGHT = 4, 20, 96  # px: between panels, of a line of text, of the curves
TEXT_WIDTH = 240  # px, of the responses of an eye
HISTORY_FRAMES = 150  # frames of u in the curves
MIN_PANEL_HEIGHT = 200  # px; smaller pictures are enlarged
BACKGROUND, TEXT_COLOUR, GRID_COLOUR = (24, 24, 24), (235, 235, 235), (90, 90, 90)
ABOVE_THRESHOLD_COLOUR, INHIBITED_COLOUR = np.array([255.0, 130.0, 30.0]), np.array([40.0, 90.0, 255.0])
MAX_SIZE = 8192  # px, of the largest video that players show
MIN_BRIGHTNESS = 0.35  # of a coloured cell, so that it is not too dark to see
GREY, ABOVE_THRESHOLD, INHIBITED = 0, 256, 512  # first index of each row of the palette
ALARM_COLOUR = "#FF4040"
EYE_COLOURS = ("#56B4E9", "#E69F00")  # blue and orange as in the figures, in lighter shades for a dark background


class Layout(NamedTuple):
    """Positions of the panels, and the background with everything that is the same in all images."""

    scale: int  # enlargement of the pictures
    panel_corners: tuple[tuple[int, int], ...]  # px: top, left of the four panels
    curve_box: tuple[int, int, int, int]  # px: left, top, right, bottom of the curves
    background: UInt32[ndarray, "height width"]  # RGBA, each pixel in one number

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images [px]."""
        return self.background.shape[1], self.background.shape[0]


class ResponseSample(NamedTuple):
    """Responses of both LGMDs to one frame; left, right."""

    time: float  # s
    u: tuple[float, float]
    feed_forward: tuple[float, float]  # grey
    adapted: tuple[float, float] = (0.5, 0.5)  # A of `lgmdjax.detectors.alarm`
    is_alarm: bool = False  # of either eye


def make_layout(rows: int, columns: int) -> Layout:
    """Lay out the overlay of two eyes of rows x columns pixels; raise InputError if it is too large for a video.

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
    if max(width, height) > MAX_SIZE:
        raise InputError(
            f"expected an overlay of at most {MAX_SIZE} px either way, got {width} x {height}; "
            "lower --width, or use --no-overlay"
        )
    background = Image.new("RGBA", (width + width % 2, height + height % 2), BACKGROUND)
    pen = ImageDraw.Draw(background)
    for title, (top, left) in zip(PANEL_TITLES, corners, strict=True):
        pen.text((left + 2, top - LINE_HEIGHT + 2), title, fill=TEXT_COLOUR, font=_font(13))
    curve_box = (GAP + 32, height - CURVE_HEIGHT + 4, width - GAP, height - 8)
    for level in (U_AT_REST, 0.75, 1.0):
        y = _to_pixel(curve_box, level)
        pen.line([(curve_box[0], y), (curve_box[2], y)], fill=GRID_COLOUR)
        pen.text((GAP, y - 7), f"{level:.2f}", fill=TEXT_COLOUR, font=_font(11))
    return Layout(scale, corners, curve_box, np.array(background).view(np.uint32)[..., 0])


def render_overlay(
    layout: Layout,
    pictures: Float[ndarray, "2 rows columns"],
    layers: Layers,
    threshold: float,
    history: Sequence[ResponseSample],
) -> UInt8[ndarray, "height width 4"]:
    """Render the overlay of one frame, in RGBA.

    Args:
        layout: from `make_layout`.
        pictures: of the left and the right eye, in grey levels 0..255.
        layers: of both LGMDs.
        threshold: T_s [grey].
        history: responses up to this frame, the last of which is this frame's.
    """
    indices = np.asarray(_palette_indices(pictures, layers, threshold))
    image = layout.background.copy()
    for (top, left), panel in zip(layout.panel_corners, _palette().take(indices), strict=True):
        for side, eye in enumerate(panel):
            enlarged = eye.repeat(layout.scale, 0).repeat(layout.scale, 1) if layout.scale > 1 else eye
            rows, columns = enlarged.shape
            x = left + side * (columns + GAP)
            image[top : top + rows, x : x + columns] = enlarged
    curves_top = layout.curve_box[1] - LINE_HEIGHT
    image[curves_top:] = _render_curves(layout, curves_top, history)
    return image[..., None].view(np.uint8)


@cache
def _palette() -> UInt32[ndarray, " 768"]:
    """Return the colours (RGBA in one number) of grey cells, of those above the threshold and of inhibited ones.

    Cells of the last two have a colour in proportion to their brightness, but never too dark to see.
    """
    levels = np.arange(256)
    strength = np.clip(levels / 255, MIN_BRIGHTNESS, 1)
    colours = np.full((3, 256, 4), 255, np.uint8)
    colours[0, :, :3] = levels[:, None]
    colours[1, :, :3] = strength[:, None] * ABOVE_THRESHOLD_COLOUR
    colours[2, :, :3] = strength[:, None] * INHIBITED_COLOUR
    return colours.reshape(-1, 4).view(np.uint32)[:, 0]


@jax.jit
def _palette_indices(
    pictures: Float[ArrayLike, "2 rows columns"], layers: Layers, threshold: float | Float[ArrayLike, ""]
) -> UInt16[Array, "4 2 rows columns"]:
    """Return the cells of the four panels as indices of the palette."""
    S = layers.summation
    is_above = (threshold <= S) & (S != 0)
    eyes = jnp.where(is_above, ABOVE_THRESHOLD + 255, _to_level(pictures))
    excitation, inhibition, summation = (
        _to_level(LAYER_GAIN * jnp.abs(layer)) for layer in (layers.excitation, layers.inhibition, S)
    )
    colour = jnp.where(is_above, ABOVE_THRESHOLD, jnp.where(S < 0, INHIBITED, GREY))
    return jnp.stack([eyes, excitation, inhibition, summation + colour]).astype(jnp.uint16)


def _to_level(values: Float[ArrayLike, "2 rows columns"]) -> Int[Array, "2 rows columns"]:
    return jnp.clip(values, 0, 255).astype(jnp.int32)


@cache
def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    """Return the font of a size; cached, since it takes longer to load than to use."""
    return ImageFont.load_default(size)


def _render_curves(layout: Layout, top: int, history: Sequence[ResponseSample]) -> UInt32[ndarray, "rows width"]:
    """Render the lowest rows, with the newest response as text and the last responses as curves."""
    image = Image.fromarray(layout.background[top:, :, None].view(np.uint8), "RGBA")
    pen, font, now = ImageDraw.Draw(image), _font(13), history[-1]
    left, _, right, _ = layout.curve_box
    pen.text((left, 0), f"{now.time:.2f} s", fill=TEXT_COLOUR, font=font)
    for side, (name, colour) in enumerate(zip(hemifield.SIDES, EYE_COLOURS, strict=True)):
        text = f"{name} u {now.u[side]:.2f}, adapted {now.adapted[side]:.2f}, FF {now.feed_forward[side]:.1f}"
        pen.text((left + 60 + TEXT_WIDTH * side, 0), text, fill=colour, font=font)
    shown = history[-HISTORY_FRAMES:]
    x = right - np.arange(len(shown))[::-1] * (right - left) / HISTORY_FRAMES
    _, highest, _, lowest = layout.curve_box
    for alarmed in x[[sample.is_alarm for sample in shown]]:
        pen.line([(alarmed, highest - top), (alarmed, lowest - top)], fill=ALARM_COLOUR, width=1)
    for values, width in (("adapted", 1), ("u", 2)):
        curves = np.clip([getattr(sample, values) for sample in shown], U_AT_REST, 1)
        for side, colour in enumerate(EYE_COLOURS):
            y = _to_pixel(layout.curve_box, curves[:, side]) - top
            pen.line(np.stack([x, y], axis=-1).ravel().tolist(), fill=colour, width=width)
    if now.is_alarm:
        pen.text((left + 4, LINE_HEIGHT + 4), "ALARM", fill=ALARM_COLOUR, font=font)
    return np.asarray(image).view(np.uint32)[..., 0]


def _to_pixel(curve_box: tuple[int, int, int, int], u: FloatT) -> FloatT:
    """Convert values of u into their rows [px]."""
    return curve_box[3] - (u - U_AT_REST) / (1 - U_AT_REST) * (curve_box[3] - curve_box[1])
