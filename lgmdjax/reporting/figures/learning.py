"""Plots of learning: losses, and predictions over time."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy import ndarray

from lgmdjax.reporting.figures.style import LEFT_COLOUR, PALETTE, RIGHT_COLOUR, WIDTH, styled
from lgmdjax.sensors.hemifield import SIDES


@styled
def plot_losses(curves: Mapping[str, Mapping[str, Sequence[float]]], names: Mapping[str, str]) -> Figure:
    """Plot the mean squared error over epochs (fig. 11) on a log axis, training and test side by side.

    Args:
        curves: of each learner "train" and "test", one error [(0.05 m/s)^2] per epoch; a single entry is plotted as a
            horizontal line.
        names: of the learners in the legend.
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
def plot_predictions(
    time: Float[ndarray, " frames"],
    u: Float[ndarray, "frames 2"],
    corridor: Float[ndarray, "frames 2"],
    label: Float[ndarray, "frames 2"],
    predicted: Float[ndarray, "frames 2"],
) -> Figure:
    """Plot a segment of recorded walking (fig. 12): u, free distance, and the commands of rule and learned policy.

    u oscillates with every step and is plotted with its mean over a second.

    Args:
        time: s.
        u: LGMD outputs.
        corridor: free distance ahead on either side, to which the rule reacts [m].
        label: the rule's command, in multiples of 0.05 m/s.
        predicted: the learned policy's command, in multiples of 0.05 m/s.
    """
    figure = Figure(figsize=(WIDTH, 5.4))
    panels = figure.subplots(4, 1, sharex=True)
    titles = (
        ("LGMD outputs: input of the learned policy", "u [1]"),
        ("free way on either side by laser: input of the rule", "e [m]"),
        ("command of the rule (the label)", "v [0.05 m/s]"),
        ("command of the learned policy", "v [0.05 m/s]"),
    )
    for axes, series, (title, unit) in zip(panels, (u, corridor, label, predicted), titles, strict=True):
        for values, colour, side in zip(series.T, (LEFT_COLOUR, RIGHT_COLOUR), SIDES, strict=True):
            oscillates = series is u
            axes.plot(time, values, color=colour, linewidth=1.0, alpha=0.35 if oscillates else 1.0, label=side)
            if oscillates:
                axes.plot(time, _average_over_second(time, values), color=colour, linewidth=1.3)
        axes.set(title=title, ylabel=unit)
        axes.margins(x=0)
    panels[3].sharey(panels[2])
    panels[3].autoscale_view()
    panels[3].set_xlabel("time [s]")
    panels[1].legend(ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.98), borderaxespad=0)
    figure.align_ylabels(panels)
    return figure


def _average_over_second(
    time: Float[ndarray, " frames"], values: Float[ndarray, " frames"]
) -> Float[ndarray, " frames"]:
    """Average over a second, of which only the recorded part counts at the ends."""
    rate = (len(time) - 1) / (time[-1] - time[0]) if len(time) > 1 else 1.0
    window = np.ones(min(max(round(rate), 1), len(time)))
    return np.convolve(values, window, mode="same") / np.convolve(np.ones_like(values), window, mode="same")
