"""What the robot senses and does, beside the scene: both eyes' pictures, layers of the LGMDs, u and v over time.

Left is blue and right is orange, as in the figures. A picture is dimmed where no LGMD sees it.
"""

import math
from collections import deque

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image, ImageDraw

from lgmdjax.reporting.playback import LAYERS, Playback
from lgmdjax.reporting.walk_scene import HAS_VISER

if HAS_VISER:
    import viser
    from viser import uplot

LEFT_RGB, RIGHT_RGB, CONTACT_RGB = (0, 114, 178), (213, 94, 0), (193, 18, 31)  # as in the figures
LEFT_COLOUR, RIGHT_COLOUR, CONTACT_COLOUR = "#0072B2", "#D55E00", "#c1121f"
WIDTH = 480  # px, of the composed pictures
BORDER, CAPTION = 3, 15  # px
WINDOW = 10.0  # s, of the curves
CURVES_EVERY = 3  # frames between two updates of the curves
DIM = 0.5
SEEN = (0.5, 0.5)  # default fractions of the width and the height of its picture that an LGMD sees


class Dashboard:
    """Pictures and curves in viser's panel."""

    def __init__(self, server: "viser.ViserServer", seen: tuple[float, float] = SEEN):
        self.seen = seen
        blank = np.full((240, WIDTH, 3), 245, np.uint8)
        self._eyes = server.gui.add_image(blank, label="Both eyes (dimmed: seen by no detector)", format="jpeg")
        self._layers = server.gui.add_image(blank, label="Layers of both LGMDs", format="png")
        self._u = _add_plot(server, "LGMD outputs u", (0.5, 1.0))
        self._v = _add_plot(server, "velocities v [0.05 m/s]", (-1.1, 2.1))
        self._recent: deque[tuple[float, ndarray, ndarray, bool]] = deque(maxlen=math.ceil(WINDOW * 30))
        self._shown = 0

    def show_pictures(self, pictures: UInt8[ndarray, "2 h w"], layers: UInt8[ndarray, "2 3 rows columns"]) -> None:
        """Show both eyes' pictures and the layers of both LGMDs."""
        self._eyes.image = compose_eyes(pictures, self.seen)
        self._layers.image = compose_layers(layers)

    def show_nothing(self) -> None:
        """Show that there are no pictures."""
        self._eyes.image = self._layers.image = np.full((60, WIDTH, 3), 245, np.uint8)

    def show_curves(self, playback: Playback, frame: int) -> None:
        """Show u and v of the last seconds of a recorded walk."""
        first = max(frame - round(WINDOW * 30), 0)
        rows = slice(first, frame + 1)
        self._draw(*(getattr(playback, name)[rows] for name in ("time", "u", "velocity", "contact")))

    def append(self, time: float, u: ndarray, velocity: ndarray, contact: bool) -> None:
        """Show u and v of one more frame of a live simulation."""
        if self._recent and time < self._recent[-1][0]:
            self._recent.clear()
        self._recent.append((time, u, velocity, contact))
        self._shown += 1
        if self._shown % CURVES_EVERY == 0:
            self._draw(*(np.asarray(series) for series in zip(*self._recent, strict=True)))

    def _draw(self, time: ndarray, u: ndarray, velocity: ndarray, contact: ndarray) -> None:
        end = max(float(time[-1]), WINDOW)
        top = max(0.6, 0.5 + 1.1 * (float(u.max()) - 0.5))
        for plot, series, low, high in ((self._u, u, 0.5, top), (self._v, velocity, -1.1, 2.1)):
            touching = np.where(contact, low + 0.04 * (high - low), np.nan)
            plot.data = tuple(np.asarray(row, float) for row in (time, series[:, 0], series[:, 1], touching))
            plot.scales = _scales((end - WINDOW, end), (low, high))


def compose_eyes(
    pictures: UInt8[ndarray, "2 height width"], seen: tuple[float, float] = SEEN
) -> UInt8[ndarray, "rows columns 3"]:
    """Return both eyes' pictures side by side, each framed in the colour of its side."""
    _, height, width = pictures.shape
    columns, rows = math.ceil(seen[0] * width), math.ceil(seen[1] * height)
    bright = pictures.astype(float)
    dimmed = DIM * bright
    dimmed[0, :rows, :columns] = bright[0, :rows, :columns]
    dimmed[1, :rows, width - columns :] = bright[1, :rows, width - columns :]
    each = WIDTH // 2 - 2 * BORDER
    size = (each, round(each * height / width))
    framed = [
        _frame(np.asarray(Image.fromarray(side.astype(np.uint8)).resize(size, Image.Resampling.BICUBIC)), colour)
        for side, colour in zip(dimmed, (LEFT_RGB, RIGHT_RGB), strict=True)
    ]
    return np.concatenate(framed, axis=1)


def compose_layers(layers: UInt8[ndarray, "2 3 rows columns"]) -> UInt8[ndarray, "rows columns 3"]:
    """Return the layers E, I and S of both LGMDs, each side framed in its colour, with their names."""
    _, count, rows, columns = layers.shape
    each = WIDTH // (2 * count) - 2 * BORDER
    size = (each, round(each * rows / columns))
    tiles = [
        _frame(np.asarray(Image.fromarray(layer).resize(size, Image.Resampling.NEAREST)), colour)
        for side, colour in zip(layers, (LEFT_RGB, RIGHT_RGB), strict=True)
        for layer in side
    ]
    page = Image.fromarray(np.concatenate([np.full((CAPTION, WIDTH, 3), 255, np.uint8), np.concatenate(tiles, axis=1)]))
    draw = ImageDraw.Draw(page)
    for number, name in enumerate(2 * LAYERS):
        draw.text(((number + 0.5) * WIDTH / (2 * count), CAPTION / 2), name, (60, 60, 60), anchor="mm")
    return np.asarray(page)


def _frame(grey: UInt8[ndarray, "h w"], colour: tuple[int, int, int]) -> UInt8[ndarray, "rows columns 3"]:
    height, width = grey.shape
    framed = np.empty((height + 2 * BORDER, width + 2 * BORDER, 3), np.uint8)
    framed[:] = colour
    framed[BORDER:-BORDER, BORDER:-BORDER] = grey[..., None]
    return framed


def _scales(time: tuple[float, float], value: tuple[float, float]) -> dict[str, "uplot.Scale"]:
    return {
        "x": uplot.Scale(time=False, auto=False, range=time),
        "y": uplot.Scale(auto=False, range=value),
    }


def _add_plot(server: "viser.ViserServer", title: str, limits: tuple[float, float]) -> "viser.GuiUplotHandle":
    start: tuple[Float[ndarray, " n"], ...] = tuple(np.zeros(2) for _ in range(4))
    return server.gui.add_uplot(
        start,
        (
            uplot.Series(label="s"),
            uplot.Series(label="left", stroke=LEFT_COLOUR, width=2),
            uplot.Series(label="right", stroke=RIGHT_COLOUR, width=2),
            uplot.Series(label="contact", stroke=CONTACT_COLOUR, width=6),
        ),
        title=title,
        scales=_scales((0.0, WINDOW), limits),
        height=150,
    )
