"""Looming detectors as the eyes of one robot: collisions, coverage and hard turning of each."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.reporting.figures import style
from lgmdjax.runtime.storage import JsonObject

MARKERS = ("o", "s", "^")


@style.styled
def plot(rows: Sequence[JsonObject], worlds: Sequence[str]) -> Figure:
    """Plot the scores of every detector in some worlds, each with its 95 % interval; rows as in scores.json."""
    figure = Figure(figsize=(style.WIDTH, 1.1 + 0.3 * len(rows)), layout="constrained")
    collisions, coverage, turning = figure.subplots(1, 3, sharey=True)
    for k, world in enumerate(worlds):
        shift = 0.22 * (k - (len(worlds) - 1) / 2)
        for y, row in enumerate(rows):
            if world in row:
                _add(collisions, y + shift, row[world]["per_100_m"], k)
                _add(coverage, y + shift, row[world]["progress"]["coverage"], k)
                _add(turning, y + shift, row[world]["progress"]["hard_turning"], k)
        coverage.plot([], [], MARKERS[k], color=style.PALETTE[k], markersize=4, label=world)
    collisions.set_yticks(range(len(rows)), [row["detector"] for row in rows])
    collisions.invert_yaxis()
    collisions.set_xscale("symlog", linthresh=1)
    collisions.xaxis.set_major_formatter("{x:g}")
    collisions.set(xlabel="collisions per 100 m", xlim=(-0.05, None))
    coverage.set(xlabel="new cells of 25 cm a minute", xlim=(0, None))
    turning.set(xlabel="share of time turning hard", xlim=(0, 1))
    for axes in (collisions, coverage, turning):
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0)
    figure.legend(loc="outside upper center", ncols=len(worlds))
    return figure


def _add(axes: Axes, y: float, estimate: JsonObject, k: int) -> None:
    colour = style.PALETTE[k]
    low, high = estimate["low"], estimate["high"]
    if low is not None and high is not None:
        axes.hlines(y, low, high, color=colour, alpha=0.5, linewidth=1.6)
    axes.plot([estimate["value"]], [y], MARKERS[k], color=colour, markersize=4, clip_on=False, zorder=3)
