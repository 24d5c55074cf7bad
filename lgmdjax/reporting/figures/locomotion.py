"""TODO docstring."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray

from lgmdjax.reporting.figures.style import INK, LEFT, PALETTE, QUIET, RIGHT, WIDTH, styled

LEGS = ("left front", "left middle", "left rear", "right rear", "right middle", "right front")


@styled
def rhythm(
    time: Float[ndarray, " steps"],
    outputs: Float[ndarray, "steps 6"],
    period: float,
    transient_cycles: float,
) -> Figure:
    """Draw the six CPG outputs from a random start (fig. 5b), one tripod a panel, the transient shaded.

    Args:
        time: seconds.
        outputs: eq. 6, u_e - u_f of each unit.
        period: settled cycle [s].
        transient_cycles: cycles until the tripod stands.
    """
    figure = Figure(figsize=(WIDTH, 3.1))
    rows = figure.subplots(2, 1, sharex=True, sharey=True)
    for tripod, axes in enumerate(rows):
        axes.axvspan(time[0], time[0] + transient_cycles * period, color="#f1efe9", linewidth=0)
        for leg, style in zip(range(tripod, 6, 2), ("-", (0, (5, 2)), (0, (1.5, 1.5))), strict=True):
            axes.plot(time, outputs[:, leg], color=PALETTE[tripod], linestyle=style, label=LEGS[leg])
        axes.set_ylabel("CPG output [1]")
        axes.legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 0.98), borderaxespad=0)
        axes.set_title(f"tripod {tripod + 1}" + ("" if tripod else ", transient shaded"))
        axes.margins(x=0)
    rows[1].set_xlabel("time [s]")
    return figure


@styled
def foot_paths(
    velocities: Float[ndarray, " speeds"],
    commanded: Float[ndarray, "speeds steps 3"],
    simulated: Float[ndarray, "speeds steps 3"],
    literal: Float[ndarray, "steps 3"],
) -> Figure:
    """Draw the path of leg 1's foot in the body frame from the side (fig. 5c), also with the literal input.

    Args:
        velocities: v of each path, in multiples of 0.05 m/s.
        commanded: where the joint targets put the foot [m].
        simulated: where it went in the simulated robot [m].
        literal: where it went at v = 1 when the shaping had the paper's one input [m].
    """
    count = len(velocities)
    figure = Figure(figsize=(WIDTH, 2.5))
    panels = figure.subplots(1, count + 1, sharex=True, sharey=True)
    for axes, v, asked, walked in zip(panels, velocities, commanded, simulated, strict=False):
        _side_view(axes, walked, color=LEFT, label="simulated foot")
        _side_view(axes, asked, color=INK, linewidth=1.0, linestyle=(0, (3, 2)), label="commanded")
        axes.set_title(f"v = {v:g}")
    _side_view(panels[-1], literal, color=RIGHT, label="simulated foot, with the paper's input")
    panels[-1].set_title("v = 1, paper's input")
    for axes in panels:
        axes.set_xlabel("forward x [mm]")
    panels[0].set_ylabel("height z [mm]")
    handles = panels[0].get_legend_handles_labels()[0] + panels[-1].get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside upper left", ncols=3)
    return figure


def _side_view(axes: Axes, path: Float[ndarray, "steps 3"], **style: Any) -> None:
    """Plot one foot path from the robot's left side reversed: forward to the right, up is up, in mm."""
    axes.plot(1000 * path[:, 0], 1000 * path[:, 2], **style)


@styled
def gait_sweep(sweep: Sequence[Mapping[str, Any]], literal: Mapping[str, float], nominal: float) -> Figure:
    """Draw the speed asked for beside the speeds walked, and the turning rate over v_r - v_l.

    Args:
        sweep: rows with velocity [l, r], asked, mjx, c [m/s], yaw_rate_mjx, yaw_rate_c [rad/s].
        literal: the speed with the printed input at v = (1, 1), "mjx" and "c" [m/s].
        nominal: speed at v = 1 [m/s].
    """
    figure = Figure(figsize=(WIDTH, 2.9))
    speed, turn = figure.subplots(1, 2)
    straight = [row for row in sweep if row["velocity"][0] == row["velocity"][1]]
    v = np.array([row["velocity"][0] for row in straight])
    span = np.array([min(v.min(initial=0), 0), max(v.max(initial=1), 1)])
    speed.plot(span, span * nominal, color=QUIET, linewidth=1, label="asked")
    speed.plot(v, [row["mjx"] for row in straight], "o", color=LEFT, markersize=6, label="walked, MJX")
    speed.plot(v, [row["c"] for row in straight], "x", color=INK, markersize=5, label="walked, C MuJoCo")
    speed.plot([1], [literal["mjx"]], "D", color=RIGHT, markersize=5, label="walked, paper's input")
    speed.set(xlabel="commanded v, both sides [0.05 m/s]", ylabel="forward speed [m/s]", title="straight on")
    speed.legend(loc="upper left")
    turns = [row for row in sweep if row["velocity"][0] != row["velocity"][1]] + straight
    steer = [row["velocity"][1] - row["velocity"][0] for row in turns]
    turn.axhline(0, color=QUIET, linewidth=0.7)
    turn.plot(steer, [row["yaw_rate_mjx"] for row in turns], "o", color=LEFT, markersize=6, label="MJX")
    turn.plot(steer, [row["yaw_rate_c"] for row in turns], "x", color=INK, markersize=5, label="C MuJoCo")
    turn.set(xlabel="right minus left command [0.05 m/s]", ylabel="yaw rate, left + [rad/s]", title="turning")
    turn.legend(loc="upper left")
    return figure
