"""Plots of the CPG, the foot paths and the gait."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray

from lgmdjax.reporting.figures.style import DARK, GREY, LEFT_COLOUR, PALETTE, RIGHT_COLOUR, WIDTH, styled
from lgmdjax.runtime.storage import JsonObject

LEG_NAMES = ("left front", "left middle", "left rear", "right rear", "right middle", "right front")


@styled
def plot_cpg_outputs(
    time: Float[ndarray, " steps"],
    outputs: Float[ndarray, "steps 6"],
    period: float,
    transient_cycles: float,
) -> Figure:
    """Plot the six CPG outputs from a random start (fig. 5b), one panel per tripod, with the transient shaded.

    Args:
        time: s.
        outputs: u_e - u_f of each unit (eq. 6).
        period: of the settled rhythm [s].
        transient_cycles: number of cycles until the tripod gait has formed.
    """
    figure = Figure(figsize=(WIDTH, 3.1))
    rows = figure.subplots(2, 1, sharex=True, sharey=True)
    for tripod, axes in enumerate(rows):
        axes.axvspan(time[0], time[0] + transient_cycles * period, color="#f1efe9", linewidth=0)
        for leg, style in zip(range(tripod, 6, 2), ("-", (0, (5, 2)), (0, (1.5, 1.5))), strict=True):
            axes.plot(time, outputs[:, leg], color=PALETTE[tripod], linestyle=style, label=LEG_NAMES[leg])
        axes.set_ylabel("CPG output [1]")
        axes.legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 0.98), borderaxespad=0)
        axes.set_title(f"tripod {tripod + 1}" + ("" if tripod else ", transient shaded"))
        axes.margins(x=0)
    rows[1].set_xlabel("time [s]")
    return figure


@styled
def plot_foot_paths(
    velocities: Float[ndarray, " speeds"],
    commanded: Float[ndarray, "speeds steps 3"],
    simulated: Float[ndarray, "speeds steps 3"],
    literal: Float[ndarray, "steps 3"],
) -> Figure:
    """Plot the path of leg 1's foot in the body frame, seen from the side (fig. 5c), also with the paper's input.

    Args:
        velocities: v of each path, in multiples of 0.05 m/s.
        commanded: positions of the foot at the servo targets [m].
        simulated: positions of the foot of the simulated robot [m].
        literal: simulated positions at v = 1 with the paper's single input of the shaping networks [m].
    """
    count = len(velocities)
    figure = Figure(figsize=(WIDTH, 2.5))
    panels = figure.subplots(1, count + 1, sharex=True, sharey=True)
    for axes, v, target, actual in zip(panels, velocities, commanded, simulated, strict=False):
        _plot_side_view(axes, actual, color=LEFT_COLOUR, label="simulated foot")
        _plot_side_view(axes, target, color=DARK, label="commanded", dashed=True)
        axes.set_title(f"v = {v:g}")
    _plot_side_view(panels[-1], literal, color=RIGHT_COLOUR, label="simulated foot, with the paper's input")
    panels[-1].set_title("v = 1, paper's input")
    for axes in panels:
        axes.set_xlabel("forward x [mm]")
    panels[0].set_ylabel("height z [mm]")
    handles = panels[0].get_legend_handles_labels()[0] + panels[-1].get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside upper left", ncols=3)
    return figure


def _plot_side_view(
    axes: Axes, path: Float[ndarray, "steps 3"], *, color: str, label: str, dashed: bool = False
) -> None:
    """Plot one foot path seen from the side in mm, forward to the right."""
    x, z = 1000 * path[:, 0], 1000 * path[:, 2]
    if dashed:
        axes.plot(x, z, color=color, label=label, linewidth=1.0, linestyle=(0, (3, 2)))
    else:
        axes.plot(x, z, color=color, label=label)


@styled
def plot_gait_sweep(sweep: Sequence[JsonObject], literal: Mapping[str, float], nominal: float) -> Figure:
    """Plot commanded and simulated speed over v, and the yaw rate over v_r - v_l.

    Args:
        sweep: rows with velocity [l, r], mjx, c [m/s], yaw_rate_mjx, yaw_rate_c [rad/s].
        literal: speed with the paper's input of the shaping networks at v = (1, 1), "mjx" and "c" [m/s].
        nominal: speed at v = 1 [m/s].
    """
    figure = Figure(figsize=(WIDTH, 2.9))
    speed, turn = figure.subplots(1, 2)
    straight = [row for row in sweep if row["velocity"][0] == row["velocity"][1]]
    v = np.array([row["velocity"][0] for row in straight])
    span = np.array([min(v.min(initial=0), 0), max(v.max(initial=1), 1)])
    speed.plot(span, span * nominal, color=GREY, linewidth=1, label="commanded")
    speed.plot(v, [row["mjx"] for row in straight], "o", color=LEFT_COLOUR, markersize=6, label="simulated, MJX")
    speed.plot(v, [row["c"] for row in straight], "x", color=DARK, markersize=5, label="simulated, C MuJoCo")
    speed.plot([1], [literal["mjx"]], "D", color=RIGHT_COLOUR, markersize=5, label="simulated, paper's input")
    speed.set(xlabel="commanded v, both sides [0.05 m/s]", ylabel="forward speed [m/s]", title="walking straight")
    speed.legend(loc="upper left")
    turns = [row for row in sweep if row["velocity"][0] != row["velocity"][1]] + straight
    steer = [row["velocity"][1] - row["velocity"][0] for row in turns]
    turn.axhline(0, color=GREY, linewidth=0.7)
    turn.plot(steer, [row["yaw_rate_mjx"] for row in turns], "o", color=LEFT_COLOUR, markersize=6, label="MJX")
    turn.plot(steer, [row["yaw_rate_c"] for row in turns], "x", color=DARK, markersize=5, label="C MuJoCo")
    turn.set(xlabel="right minus left command [0.05 m/s]", ylabel="yaw rate, left + [rad/s]", title="turning")
    turn.legend(loc="upper left")
    return figure
