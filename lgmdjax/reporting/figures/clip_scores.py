"""Looming detectors on video clips: ROC, and the responses to one clip below its pictures."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.errors import one_line
from lgmdjax.reporting.figures import style
from lgmdjax.runtime.storage import JsonObject

COLOURS = (*style.PALETTE, style.DARK, style.GREY, style.RED, "#8c564b")
ADAPTED_COLOUR, OWN_COLOUR = style.LEFT_COLOUR, style.RIGHT_COLOUR
STRIP_HEIGHT, TRACE_HEIGHT, TITLE_HEIGHT = 0.75, 0.6, 0.9  # inches
MAX_TITLE = 90  # characters


class Responses(NamedTuple):
    """Responses of one detector to a clip."""

    u: Sequence[float]
    adapted: Sequence[float]
    alarms: Sequence[float]  # s, beginnings
    threshold: float


class ClipView(NamedTuple):
    """A clip, and where an alarm would be a hit."""

    title: str
    time: Sequence[float]  # s
    pictures: Sequence[tuple[float, np.ndarray]]  # time [s], grey
    window: tuple[float, float] | None  # s
    contact: float | None  # s


@style.styled
def plot_roc(rows: Sequence[JsonObject]) -> Figure:
    """Plot hit rate against the share of stretches with a false alarm, for every threshold; rows as in scores.json."""
    figure = Figure(figsize=(style.WIDTH, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, scale, title in zip(panels, ("own", "adapted"), ("u as published", "Adapted response"), strict=True):
        for k, row in enumerate(rows):
            curve, area = row[scale]["roc"], row[scale]["auc"]
            colour, dashes = COLOURS[k % len(COLOURS)], "-" if k < len(COLOURS) else "--"
            label = f"{row['detector']} {_format(area)}"
            x, y = ([*curve[name], 0.0] for name in ("stretches_with_alarm", "hit_rate"))
            axes.plot(x, y, dashes, color=colour, label=label, alpha=0.85)
        axes.set(xlabel="stretches with a false alarm", title=title, xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
        axes.legend(title="area under ROC", fontsize=6.5, title_fontsize=7, loc="lower right")
    panels[0].set_ylabel("hit rate")
    return figure


@style.styled
def plot_clip(clip: ClipView, responses: Mapping[str, Responses]) -> Figure:
    """Plot the responses of detectors to a clip below its pictures, each at its time."""
    height = TITLE_HEIGHT + STRIP_HEIGHT + TRACE_HEIGHT * len(responses)
    figure = Figure(figsize=(style.WIDTH, height))
    figure.set_layout_engine("none")  # arranged by hand for speed: there is a figure for each clip
    figure.subplots_adjust(left=0.2, right=0.98, top=1 - 0.25 / height, bottom=0.62 / height, hspace=0.3)
    ratios = [STRIP_HEIGHT] + [TRACE_HEIGHT] * len(responses)
    panels = np.atleast_1d(figure.subplots(1 + len(responses), 1, sharex=True, height_ratios=ratios))
    _draw_strip(panels[0], clip)
    for axes, (name, response) in zip(panels[1:], responses.items(), strict=True):
        _draw_trace(axes, clip, response)
        axes.set_ylabel(name, rotation=0, ha="right", va="center")
    panels[0].set_title(one_line(clip.title)[:MAX_TITLE], parse_math=False)  # a file may have any name
    panels[-1].set_xlabel("time [s]")
    lines = [
        panels[-1].plot([], [], color=colour, linewidth=width)[0]
        for colour, width in ((OWN_COLOUR, 0.9), (ADAPTED_COLOUR, 1.2), (style.RED, 1.5), (style.DARK, 1.0))
    ]
    names = ["u as published", "adapted response", "alarm", *(["contact"] if clip.contact is not None else [])]
    figure.legend(lines[: len(names)], names, loc="lower center", ncols=4)
    return figure


def _draw_strip(axes: Axes, clip: ClipView) -> None:
    """Draw pictures side by side, each around its time."""
    start, end = clip.time[0], max(clip.time[-1], clip.time[0] + 1e-3)
    width = (end - start) / len(clip.pictures)
    for k, (_, picture) in enumerate(clip.pictures):
        left = start + k * width
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, extent=(left, left + 0.97 * width, 0, 1), aspect="auto")
    for k, (time, _) in enumerate(clip.pictures):
        axes.text(start + (k + 0.03) * width, 0.03, f"{time:.1f}", color="white", fontsize=6, va="bottom")
    axes.set(xlim=(start, end), ylim=(0, 1), yticks=[])
    axes.grid(False)


def _draw_trace(axes: Axes, clip: ClipView, response: Responses) -> None:
    if clip.window is not None:
        axes.axvspan(*np.clip(clip.window, clip.time[0], clip.time[-1]), color="#fff3d6", zorder=0)
    if clip.contact is not None:
        axes.axvline(clip.contact, color=style.DARK, linewidth=1.0)
    axes.axhline(response.threshold, color=ADAPTED_COLOUR, linestyle=":", linewidth=0.7)
    axes.plot(clip.time, response.u, color=OWN_COLOUR, linewidth=0.9)
    axes.plot(clip.time, response.adapted, color=ADAPTED_COLOUR, linewidth=1.2)
    for start in response.alarms:
        axes.axvline(start, color=style.RED, linewidth=1.5)
    axes.set(ylim=(0, 1.05), yticks=(0, 0.5, 1))


def _format(area: float | None) -> str:
    return "–" if area is None else f"{area:.2f}"
