"""Plots that compare policies: how often they collide, and how much floor they cover."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.reporting.figures.style import GREY, POLICY_COLOURS, WIDTH, styled
from lgmdjax.runtime.storage import JsonObject

Scores = Mapping[str, Mapping[str, JsonObject]]
"""Title of the trial -> name of the policy -> score (`metrics.Score`), whose estimates have value, low and high."""


@styled
def plot_collision_rates(scores: Scores) -> Figure:
    """Plot collisions per 100 m of every policy in every trial, with 95 % intervals."""
    figure = Figure(figsize=(WIDTH, 0.85 + 0.27 * max(len(policies) for policies in scores.values())))
    panels = np.atleast_1d(figure.subplots(1, len(scores)))
    for axes, (trial, policies) in zip(panels, scores.items(), strict=True):
        for row, (name, score) in enumerate(policies.items()):
            rate, colour = score["per_100_m"], POLICY_COLOURS.get(name, GREY)
            axes.plot([rate["low"], rate["high"]], [row, row], color=colour, linewidth=2.2)
            axes.plot([rate["value"]], [row], "o", color=colour, markersize=6, clip_on=False, zorder=3)
            axes.annotate(
                f"{rate['value']:.3g}",
                (rate["high"], row),
                xytext=(5, 0),
                va="center",
                fontsize=8,
                textcoords="offset points",
            )
        axes.set_yticks(range(len(policies)), list(policies))
        axes.set(title=trial, xlabel="collisions per 100 m", ylim=(len(policies) - 0.5, -0.5))
        axes.set_xlim(0, 1.14 * axes.get_xlim()[1])
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0)
    return figure


@styled
def plot_collisions_against_coverage(scores: Scores) -> Figure:
    """Plot collisions per 100 m against coverage, a dot for every policy with both 95 % intervals.

    Better is down and right: a robot that turns on the spot is at the left, one that walks into everything at the top.
    The scale is linear up to one collision, and logarithmic above.
    """
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(scores), sharey=True))
    for axes, (trial, policies) in zip(panels, scores.items(), strict=True):
        for name, score in policies.items():
            _add_policy(axes, name, score)
        axes.set(title=trial, xlabel="coverage: new cells of 0.25 m [1/min]")
        axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
    panels[0].set_ylabel("collisions per 100 m")
    handles, names = panels[0].get_legend_handles_labels()  # names beside the dots would cover each other
    figure.legend(handles, names, loc="outside upper right", ncols=len(names))
    return figure


def _add_policy(axes: Axes, name: str, score: JsonObject) -> None:
    rate, coverage, colour = score["per_100_m"], score["progress"]["coverage"], POLICY_COLOURS.get(name, GREY)
    axes.plot([coverage["low"], coverage["high"]], [rate["value"]] * 2, color=colour, linewidth=1.6, alpha=0.6)
    axes.plot([coverage["value"]] * 2, [rate["low"], rate["high"]], color=colour, linewidth=1.6, alpha=0.6)
    dot = {"marker": "o", "markersize": 5.5, "linestyle": "none", "clip_on": False, "zorder": 3}
    axes.plot([coverage["value"]], [rate["value"]], color=colour, label=name, **dot)
