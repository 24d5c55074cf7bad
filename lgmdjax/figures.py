"""The figures of the report: numbers in, a matplotlib `Figure` out, nothing read and nothing kept.

Every function draws one figure for a page about 18 cm wide, on the Agg canvas and without pyplot, so that no
window system and no global figure is involved. Left is blue and right is orange throughout, in the palette of
Okabe & Ito, which stays apart for colour-blind eyes. The file is long because it is eleven times the same kind of
thing: the functions share a style and nothing else.

| figure here    | of the paper | shows                                                   |
| -------------- | ------------ | ------------------------------------------------------- |
| `rhythm`       | 5b           | outputs of the six CPG units from a random start        |
| `foot_paths`   | 5c           | path of leg 1's foot, commanded and simulated           |
| `gait_sweep`   | -            | speed and turning asked for and walked                  |
| `layers`       | 6b           | picture, E, I and S of one eye                          |
| `calibration`  | -            | score of the candidates for T_s and W_I                 |
| `losses`       | 11           | training and test error of every learner                |
| `stretch`      | 12           | u, d, the rule's v and the learner's v side by side     |
| `trajectories` | 13           | walks in a room, with its obstacles                     |
| `rooms`        | -            | walks in several rooms                                  |
| `passages`     | 14, 16       | ways past what stands in the way                        |
| `drivers`      | -            | collisions per 100 m of every driver, with intervals    |
"""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from cycler import cycler
from jaxtyping import Bool, Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy import ndarray

from lgmdjax.arena import Arena, Prisms, is_overhead, is_parked

WIDTH = 7.2  # inches, the width of the report's column
SURROUNDINGS = 2.5  # m, of the start of a trial that are drawn in any case
LEFT, RIGHT = "#0072B2", "#D55E00"
INK, QUIET, FAINT, OBSTACLE, ALARM = "#222222", "#767676", "#dddddd", "#c9c5bd", "#c1121f"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DRIVERS = {
    "teacher": "#009E73",
    "learned": "#0072B2",
    "blind": "#555555",
    "direct": "#CC79A7",
    "random": "#E69F00",
}
LEGS = ("left front", "left middle", "left rear", "right rear", "right middle", "right front")
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=PALETTE),
    "grid.color": "#ececec",
    "grid.linewidth": 0.7,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "butt",
    "text.color": INK,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "lgmdjax",
}


class Walks(NamedTuple):
    """What one driver's robots did in a room; axes (robot, frame)."""

    positions: Float[ndarray, "robots frames dimensions"]  # m, x and y first
    setbacks: Int[ndarray, "robots frames"]
    contact: Bool[ndarray, "robots frames"]


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Draw under the report's style, and leave matplotlib's settings as they were."""

    @wraps(draw)
    def wrapper(*args: Any, **kwargs: Any) -> Figure:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return wrapper


def to_svg(figure: Figure) -> bytes:
    """Write a figure as SVG with text as outlines, the same bytes for the same figure."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def to_png(figure: Figure, dpi: float = 150.0) -> bytes:
    """Write a figure as PNG."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


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


@styled
def layers(
    picture: Float[ndarray, "height width"],
    excitation: Float[ndarray, "height width"],
    inhibition: Float[ndarray, "height width"],
    summation: Float[ndarray, "height width"],
) -> Figure:
    """Draw what one eye sees and what its LGMD's three layers make of it (fig. 6b), in grey levels.

    E, I and S share one scale, whose top is the 99.5th percentile of E, so that they can be compared.
    """
    height, width = picture.shape
    figure = Figure(figsize=(WIDTH, 2 * 0.44 * WIDTH * height / width + 0.75))
    panels = figure.subplots(2, 2).ravel()
    top = max(float(np.percentile(np.abs(excitation), 99.5)), 1e-6)
    shown = (picture, np.abs(excitation), np.abs(inhibition), summation)
    titles = ("1  picture L", "2  excitation E", "3  inhibition |I|", "4  summation S = E - W_I |I|")
    images = []
    for axes, layer, title in zip(panels, shown, titles, strict=True):
        seen = layer is picture
        limits = {"vmin": 0, "vmax": 255} if seen else {"vmin": 0, "vmax": top}
        images.append(axes.imshow(layer, cmap="gray" if seen else "inferno", interpolation="nearest", **limits))
        axes.set_title(title)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    figure.colorbar(images[0], ax=panels[:2].tolist(), shrink=0.9, label="grey level [0..255]", pad=0.01)
    figure.colorbar(
        images[1], ax=panels[2:].tolist(), shrink=0.9, label="E, |I|, S [grey levels]", pad=0.01, extend="max"
    )
    return figure


@styled
def calibration(table: Sequence[Mapping[str, float]], chosen: Mapping[str, float]) -> Figure:
    """Draw the score of every candidate against its threshold T_s, a line for each weight W_I.

    Args:
        table: rows with "threshold" [grey], "inhibition" and "score".
        chosen: the settings that were kept, "threshold" among them.
    """
    figure = Figure(figsize=(WIDTH, 2.7))
    axes = figure.subplots()
    weights: dict[float, list[Mapping[str, float]]] = {}
    for row in sorted(table, key=lambda row: row["threshold"]):
        weights.setdefault(row["inhibition"], []).append(row)
    shades = colormaps["viridis"](np.linspace(0, 0.9, len(weights)))
    for shade, (weight, rows) in zip(shades, weights.items(), strict=True):
        thresholds, scores = zip(*((row["threshold"], row["score"]) for row in rows), strict=True)
        axes.plot(thresholds, scores, color=shade, marker="o", markersize=4, label=f"W_I = {weight:.3g}")
    axes.axvline(chosen["threshold"], color=ALARM, linewidth=1.2, linestyle="--", label="chosen T_s")
    axes.set(xlabel="threshold T_s [grey levels]", ylabel="correlation [1]")
    if min(row["threshold"] for row in table) > 0:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


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


@styled
def trajectories(arena: Arena | None, walks: Mapping[str, Walks], first: str = "learned") -> Figure:
    """Draw the walks of every driver in one room seen from above (fig. 13), `first` large, touches marked.

    Without an arena only the paths are drawn. A set-back breaks the line.
    """
    others = [name for name in walks if name != first]
    figure = Figure(figsize=(WIDTH, 3.9 if others else 5.6))
    rows = max((len(others) + 1) // 2, 1)
    if others:
        large, small = np.asarray(figure.subfigures(1, 2, width_ratios=(1.15, 1)))
        panels = {first: large.subplots(), **dict(zip(others, small.subplots(rows, 2).ravel(), strict=False))}
    else:
        panels = {first: figure.subplots()}
    for name, axes in panels.items():
        if arena is not None:
            draw_room(axes, arena)
        draw_walks(axes, walks[name], colours=PALETTE if name == first else (DRIVERS.get(name, QUIET),))
        axes.set_title(name)
        axes.set_aspect("equal")
        axes.grid(False)
        if name != first:
            axes.tick_params(labelleft=False, labelbottom=False, length=0)
            axes.spines[:].set_visible(False)
    panels[first].set(xlabel="x [m]", ylabel="y [m]")
    panels[first].legend(loc="upper left", bbox_to_anchor=(0, -0.13), ncols=2, borderaxespad=0)
    return figure


@styled
def rooms(arenas: Sequence[Arena], walks: Sequence[Walks]) -> Figure:
    """Draw what was walked in some rooms seen from above, side by side, touches marked."""
    rows = (len(arenas) + 2) // 3
    figure = Figure(figsize=(WIDTH, 0.3 + 2.4 * rows))
    panels = np.asarray(figure.subplots(rows, min(len(arenas), 3), squeeze=False)).ravel()
    for axes, arena, walk in zip(panels, arenas, walks, strict=False):
        draw_room(axes, arena)
        draw_walks(axes, walk, colours=PALETTE)
        axes.set_aspect("equal")
        axes.grid(False)
    for axes in panels[len(arenas) :]:
        axes.remove()
    return figure


@styled
def passages(
    arenas: Sequence[Arena],
    paths: Sequence[Float[ndarray, "_ 2"]],
    touched: Bool[ndarray, " robots"],
    clearance: Float[ndarray, " robots"],
    across: Float[ndarray, " robots"] | None = None,
) -> Figure:
    """Draw how robots passed what stood in their way (figs. 14 and 16), seen from above; those that touched it red.

    Args:
        arenas: a room a robot. paths: until its end. touched: something.
        clearance: the least until the end [m].
        across: how far beside the robot's way the obstacle stood [m]; the clearance is then drawn against it.
    """
    figure = Figure(figsize=(WIDTH, 4.2 if across is None else 6.4))
    axes = figure.subplots() if across is None else _beside(figure, touched, clearance, across)
    for arena in arenas:
        draw_room(axes, arena)
    for path, bad in zip(paths, touched, strict=True):
        axes.plot(*path[::8].T, color=ALARM if bad else LEFT, linewidth=0.9, alpha=0.7, zorder=3)
        axes.plot(*path[-1], "X" if bad else "o", color=ALARM if bad else LEFT, markersize=4, zorder=4)
    things = np.concatenate([np.asarray(prisms.centre) for prisms in (arenas[0].boxes, arenas[0].cylinders)])
    near = things[np.linalg.norm(things - paths[0][0], axis=1) < SURROUNDINGS]
    shown = np.concatenate([*paths, near])
    least, most = shown.min(axis=0), shown.max(axis=0)
    axes.set(xlim=(least[0] - 0.4, most[0] + 0.8), ylim=(least[1] - 0.8, most[1] + 0.8))
    axes.set(xlabel="x [m]", ylabel="y [m]", title=f"{np.sum(~touched)} of {len(paths)} untouched", aspect="equal")
    axes.grid(False)
    return figure


def _beside(
    figure: Figure, touched: Bool[ndarray, " n"], clearance: Float[ndarray, " n"], across: Float[ndarray, " n"]
) -> Axes:
    """Draw the clearance against where the obstacle stood in the lower third; give the axes above."""
    above, below = figure.subplots(2, height_ratios=(2.0, 1.0))
    for bad, style in ((False, {"color": LEFT, "marker": "o"}), (True, {"color": ALARM, "marker": "X"})):
        some = touched == bad
        below.plot(across[some], 100 * np.maximum(clearance[some], 0), linestyle="none", markersize=4, **style)
    below.set(xlabel="obstacle beside the robot's way, d_y [m]", ylabel="least clearance [cm]")
    below.set_ylim(bottom=0)
    return above


def draw_room(axes: Axes, arena: Arena) -> None:
    """Draw walls and obstacles from above: what hangs overhead in outline, ways of what moves dotted."""
    x_min, x_max, y_min, y_max = np.asarray(arena.room)
    axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, fill=False, edgecolor=INK, linewidth=1.6))
    for prisms, outline in ((arena.boxes, _box), (arena.cylinders, _disc)):
        for index in np.flatnonzero(~np.asarray(is_parked(prisms))):
            overhead = bool(is_overhead(prisms)[index])
            style = {"facecolor": "none" if overhead else OBSTACLE, "linestyle": "--" if overhead else "-"}
            axes.add_patch(outline(prisms, index, edgecolor=QUIET, linewidth=0.6, **style))
            way = np.stack([prisms.centre[index], prisms.goal[index]])
            axes.plot(*way.T, color=QUIET, linestyle=":", linewidth=0.8)
    margin = 0.03 * max(x_max - x_min, y_max - y_min)
    axes.set(xlim=(x_min - margin, x_max + margin), ylim=(y_min - margin, y_max + margin))


def _box(prisms: Prisms, index: int | np.intp, **style: Any) -> Polygon:
    a, b = np.asarray(prisms.half_size[index])
    cosine, sine = np.cos(prisms.yaw[index]), np.sin(prisms.yaw[index])
    corners = np.array([[a, b], [-a, b], [-a, -b], [a, -b]]) @ np.array([[cosine, sine], [-sine, cosine]])
    return Polygon(corners + np.asarray(prisms.centre[index]), **style)


def _disc(prisms: Prisms, index: int | np.intp, **style: Any) -> Circle:
    return Circle(tuple(np.asarray(prisms.centre[index])), float(prisms.half_size[index, 0]), **style)


def draw_walks(axes: Axes, walks: Walks, colours: Sequence[str]) -> None:
    """Draw a path a robot, broken where it was set back, a ring at its start and a cross at each touch."""
    start = {"marker": "o", "color": INK, "markerfacecolor": "white", "markersize": 4, "linestyle": "none"}
    touch = {"marker": "X", "color": ALARM, "markeredgecolor": "white", "markersize": 5, "linestyle": "none"}
    for robot, (positions, setbacks, contact) in enumerate(zip(*walks, strict=True)):
        cuts = np.flatnonzero(np.diff(setbacks)) + 1
        for piece in np.split(positions[:, :2], cuts):
            # A point a quarter of a second is enough for the eye, and keeps the file small.
            thin = np.concatenate([piece[::8], piece[-1:]])
            axes.plot(*thin.T, color=colours[robot % len(colours)], linewidth=0.9, alpha=0.85, zorder=3)
        touched = positions[contact.astype(bool), :2]
        axes.plot(*touched.T, **touch, zorder=5)
        axes.plot(*positions[0, :2], **start, zorder=4)
    axes.plot([], [], **start, label="start")
    axes.plot([], [], **touch, label="touched something, set back")


@styled
def drivers(places: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Figure:
    """Draw collisions per 100 m of every driver in every place, with 95 % intervals.

    Args:
        places: place -> driver -> score, whose "per_100_m" has value, low, high.
    """
    figure = Figure(figsize=(WIDTH, 0.85 + 0.27 * max(len(scores) for scores in places.values())))
    panels = np.atleast_1d(figure.subplots(1, len(places)))
    for axes, (place, scores) in zip(panels, places.items(), strict=True):
        for row, (name, score) in enumerate(scores.items()):
            rate, colour = score["per_100_m"], DRIVERS.get(name, QUIET)
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
        axes.set_yticks(range(len(scores)), list(scores))
        axes.set(title=place, xlabel="collisions per 100 m", ylim=(len(scores) - 0.5, -0.5))
        axes.set_xlim(0, 1.14 * axes.get_xlim()[1])
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0)
    return figure
