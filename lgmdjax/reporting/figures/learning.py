"""TODO docstring."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy import ndarray

from lgmdjax.reporting.figures.style import LEFT, PALETTE, RIGHT, WIDTH, styled


@styled
def losses(curves: Mapping[str, Mapping[str, Sequence[float]]], names: Mapping[str, str]) -> Figure:
    """Draw mean squared error over epochs (fig. 11) on a log axis: training and test beside each other.

    Args:
        curves: for each learner "train" and "test", an error [(0.05 m/s)^2] an epoch;
            one entry alone is a level.
        names: how to call the learners in the legend.
    """
    figure = Figure(figsize=(WIDTH, 2.9))
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    last = max((len(curve[half]) for curve in curves.values() for half in ("train", "test")), default=1)
    for index, (name, curve) in enumerate(curves.items()):
        colour, label = PALETTE[index % len(PALETTE)], names.get(name, name)
        for axes, half in zip(panels, ("train", "test"), strict=True):
            if len(curve[half]) == 1:
                axes.axhline(curve[half][0], color=colour, linestyle="--", linewidth=1, label=label)
            else:
                epochs = np.arange(1, len(curve[half]) + 1)
                axes.plot(epochs, curve[half], color=colour, linewidth=1.1, label=label)
    for axes, title in zip(panels, ("training", "test"), strict=True):
        axes.set(title=title, xlabel="epoch", yscale="log", xlim=(0, max(last, 2)))
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    panels[0].set_ylabel("mean squared error [(0.05 m/s)²]")
    figure.legend(handles=panels[0].get_legend_handles_labels()[0], loc="outside upper left", ncols=3)
    return figure


@styled
def stretch(
    time: Float[ndarray, " frames"],
    u: Float[ndarray, "frames 2"],
    distances: Float[ndarray, "frames 2"],
    label: Float[ndarray, "frames 2"],
    predicted: Float[ndarray, "frames 2"],
) -> Figure:
    """Draw a stretch of recorded walking (fig. 12): u, distances, the rule's command and the learner's.

    u, which every step shakes, is drawn with its mean over a second.

    Args:
        time: seconds. u: LGMD outputs. distances: nearest obstacle a side [m].
        label, predicted: velocities in multiples of 0.05 m/s.
    """
    figure = Figure(figsize=(WIDTH, 5.4))
    panels = figure.subplots(4, 1, sharex=True)
    titles = (
        ("LGMD outputs: all that the learner is given", "u [1]"),
        ("nearest obstacle by laser: all that the rule is given", "d [m]"),
        ("command of the rule (the label)", "v [0.05 m/s]"),
        ("command of the learned controller", "v [0.05 m/s]"),
    )
    for axes, series, (title, unit) in zip(panels, (u, distances, label, predicted), titles, strict=True):
        for values, colour, side in zip(series.T, (LEFT, RIGHT), ("left", "right"), strict=True):
            flickers = series is u
            axes.plot(time, values, color=colour, linewidth=1.0, alpha=0.35 if flickers else 1.0, label=side)
            if flickers:
                axes.plot(time, _averaged(time, values), color=colour, linewidth=1.3)
        axes.set(title=title, ylabel=unit)
        axes.margins(x=0)
    panels[3].sharey(panels[2])
    panels[3].autoscale_view()
    panels[3].set_xlabel("time [s]")
    panels[1].legend(ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.98), borderaxespad=0)
    figure.align_ylabels(panels)
    return figure


def _averaged(time: Float[ndarray, " frames"], values: Float[ndarray, " frames"]) -> Float[ndarray, " frames"]:
    """Average over a second; at the ends over what there is of it."""
    rate = (len(time) - 1) / (time[-1] - time[0]) if len(time) > 1 else 1.0
    window = np.ones(min(max(round(rate), 1), len(time)))
    return np.convolve(values, window, mode="same") / np.convolve(np.ones_like(values), window, mode="same")
