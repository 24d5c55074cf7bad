"""Looming detectors on laboratory stimuli: what they respond to, and when."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from lgmdjax.reporting.figures import style
from lgmdjax.runtime.storage import JsonObject

GROUPS = (
    "approach bright",
    "approach textured",
    "recede dark",
    "recede bright",
    "translate",
    "elongate",
    "grating",
    "yaw",
    "sway",
    "flash",
)
"""Kinds of clips, by the beginning of their names."""
SHOWN = 1.2  # selectivity at the end of the colour scale
COLOURS = (*style.PALETTE, style.DARK, style.GREY, style.RED, "#8c564b")


def grouped(row: JsonObject) -> dict[str, float | None]:
    """Return the mean selectivity of the clips of each kind; None for a detector that ignores approach."""
    found: dict[str, float | None] = {}
    for group in GROUPS:
        values = [value for name, value in row["selectivity"].items() if name.startswith(group)]
        found[group] = None if None in values else float(np.mean(values))
    return found


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot selectivity, timing, contrast and noise of every detector; rows as in scores.json."""
    figure = Figure(figsize=(style.WIDTH, 7.2), layout="constrained")
    upper, lower = np.asarray(figure.subfigures(2, 1, height_ratios=(1.1, 1.0)))
    _plot_selectivity(upper.subplots(), rows)
    timing, contrast, noise = lower.subplots(1, 3)
    for colour, row in zip((COLOURS * (len(rows) // len(COLOURS) + 1)), rows, strict=False):
        dashes = "--" if row["is_ideal"] else "-"
        when = row["timing"]
        shown = [(x, y) for x, y in zip(when["l_over_v"], when["before_contact"], strict=True) if y is not None]
        if shown:
            timing.plot(*np.transpose(shown), dashes, marker="o", markersize=3, color=colour)
        contrast.plot(row["contrast"]["contrasts"], row["contrast"]["peaks"], dashes, color=colour)
        difference = np.subtract(row["noise"]["approach"], row["noise"]["still"])
        noise.plot(row["noise"]["sigma"], difference, dashes, color=colour, label=row["detector"])
    timing.set_xscale("log")
    timing.set_yscale("symlog", linthresh=0.03, linscale=0.5)
    timing.xaxis.set_major_formatter("{x:g}")
    timing.xaxis.set_minor_formatter(NullFormatter())
    timing.yaxis.set_major_formatter("{x:g}")
    timing.set(xlabel="l/|v| [s]", ylabel="peak before contact [s]", ylim=(0, None), title="Timing")
    contrast.set(xlabel="contrast", ylabel="peak of u - 0.5", ylim=(-0.02, 0.52), title="Contrast")
    noise.set(xlabel="noise [grey]", ylabel="peak: approach minus still", title="Noise")
    lower.legend(*noise.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure


def _plot_selectivity(axes: Axes, rows: Sequence[JsonObject]) -> None:
    table = np.array([[np.nan if value is None else value for value in grouped(row).values()] for row in rows], float)
    axes.imshow(np.clip(table, 0, SHOWN), cmap="Blues", vmin=0, vmax=SHOWN, aspect="auto")
    for (i, j), value in np.ndenumerate(table):
        text = "-" if np.isnan(value) else f"{value:.2f}"
        axes.text(j, i, text, ha="center", va="center", color="white" if value > 0.7 else style.DARK, fontsize=7.5)
    names = [f"{row['detector']}  ({row['auc_dark']:.2f})" for row in rows]
    axes.set_yticks(range(len(rows)), names)
    axes.set_xticks(range(len(GROUPS)), [group.replace(" ", "\n") for group in GROUPS])
    axes.set_title("Peak, over that to dark approach (with area under ROC)")
    axes.grid(False)
