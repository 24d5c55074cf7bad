"""Scores of looming detectors with published constants, after a search, and after a fit by gradient."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.reporting.figures import style
from lgmdjax.runtime.storage import JsonObject

MARKERS = ("x", "o", "D")


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot both scores of every detector before and after; rows as in scores.json."""
    figure = Figure(figsize=(style.WIDTH, 1.1 + 0.26 * len(rows)), layout="constrained")
    walks, stimuli = figure.subplots(1, 2, sharey=True)
    steps = list(rows[0]["stimuli"]["scores"])
    for y, row in enumerate(rows):
        _add(walks, y, [row["walks"]["scores"][step]["value"] for step in steps])
        for run in row["walks"]["runs"]:
            walks.plot([run["scores"][steps[-1]]], [y], ".", color=style.PALETTE[2], alpha=0.4, markersize=3)
        _add(stimuli, y, [row["stimuli"]["scores"][step] for step in steps])
    for k, step in enumerate(steps):
        walks.plot([], [], MARKERS[k], color=style.PALETTE[k], markersize=4, label=step)
    walks.set_yticks(range(len(rows)), [row["detector"] for row in rows])
    walks.invert_yaxis()
    walks.axvline(0, color=style.GREY, linewidth=0.6)
    stimuli.axvline(0.5, color=style.GREY, linewidth=0.6)
    walks.set(xlabel="r with proximity, held-out walks", xlim=(None, 1))
    stimuli.set(xlabel="area under ROC, other stimuli", xlim=(0, 1.02))
    for axes in (walks, stimuli):
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0)
    figure.legend(loc="outside upper center", ncols=len(steps))
    return figure


def _add(axes: Axes, y: float, values: Sequence[float]) -> None:
    axes.hlines(y, min(values), max(values), color=style.GREY, linewidth=0.8)
    for k, value in enumerate(values):
        axes.plot([value], [y], MARKERS[k], color=style.PALETTE[k], markersize=4, clip_on=False, zorder=3)
