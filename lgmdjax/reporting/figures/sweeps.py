"""Measures of a sweep against its settings."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from lgmdjax.reporting.figures import style
from lgmdjax.runtime.storage import JsonObject

MAX_LABELS = 40  # settings that are named below the axis


@style.styled
def plot(summary: Sequence[JsonObject]) -> Figure:
    """Plot the mean of each measure with its interval, and the runs as small dots; rows as of `results.summarise`."""
    measures = list(summary[0]["means"])
    figure = Figure(figsize=(style.WIDTH, 0.8 + 2.0 * len(measures)), layout="constrained")
    panels = np.ravel(figure.subplots(len(measures), 1, sharex=True))
    x, labels, axis = _positions([row["setting"] for row in summary])
    for panel, measure in zip(panels, measures, strict=True):
        for position, row in zip(x, summary, strict=True):
            values, mean = row["values"][measure], row["means"][measure]
            panel.plot([position] * len(values), values, ".", color=style.GREY, markersize=3)
            if np.isfinite([mean["low"], mean["high"]]).all():
                panel.vlines(position, mean["low"], mean["high"], color=style.LEFT_COLOUR, alpha=0.45, linewidth=1.6)
        panel.plot(x, [row["means"][measure]["value"] for row in summary], "o", color=style.LEFT_COLOUR, markersize=4)
        panel.set_ylabel(measure)
    if labels:
        panels[-1].set_xticks(x, labels, rotation=0 if len(labels) < 5 else 90)
        panels[-1].grid(False, axis="x")
    panels[-1].set_xlabel(axis)
    return figure


def _positions(settings: Sequence[JsonObject]) -> tuple[list[float], list[str], str]:
    """Return positions, labels and the name of the axis: the numbers of a single flag, or one place a setting."""
    flags = list(dict.fromkeys(flag for setting in settings for flag in setting))
    values = [setting.get(flags[0]) if flags else None for setting in settings]
    if len(flags) == 1 and all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return [float(value) for value in values if value is not None], [], flags[0]
    names = [", ".join(str(setting.get(flag, "-")) for flag in flags) for setting in settings]
    places = [float(place) for place in range(len(settings))]
    return places, names if len(names) <= MAX_LABELS else [], ", ".join(flags)
