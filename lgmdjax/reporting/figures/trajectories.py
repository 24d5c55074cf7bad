"""TODO docstring."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy import ndarray

from lgmdjax.reporting.figures.style import ALARM, DRIVERS, INK, LEFT, OBSTACLE, PALETTE, QUIET, WIDTH, styled
from lgmdjax.world.arena import Arena, Prisms, is_overhead, is_parked

SURROUNDINGS = 2.5  # m, of the start of a trial that are drawn in any case


class Walks(NamedTuple):
    """What one driver's robots did in a room; axes (robot, frame)."""

    positions: Float[ndarray, "robots frames dimensions"]  # m, x and y first
    setbacks: Int[ndarray, "robots frames"]
    contact: Bool[ndarray, "robots frames"]


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
