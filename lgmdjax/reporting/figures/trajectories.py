"""Plots of walks seen from above."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy import ndarray

from lgmdjax.reporting.figures.style import (
    DARK,
    GREY,
    LEFT_COLOUR,
    OBSTACLE_COLOUR,
    PALETTE,
    POLICY_COLOURS,
    RED,
    WIDTH,
    styled,
)
from lgmdjax.simulation.closed_loop import Record, Room
from lgmdjax.world.arena import Arena, Prisms, is_inactive, is_overhead

START_SURROUNDINGS = 2.5  # m; obstacles nearer to the start are always inside the plot
POINT_STRIDE = 8  # frames between two points of a path: a quarter of a second, which keeps the file small


class Paths(NamedTuple):
    """Paths of robots in one room; axes (robot, frame)."""

    positions: Float[ndarray, "robots frames dimensions"]  # m, x and y first
    resets: Int[ndarray, "robots frames"]
    contact: Bool[ndarray, "robots frames"]


@styled
def plot_walks(record: Record, rooms: Room | Arena | None = None) -> Figure:
    """Plot recorded walks seen from above, with starts and collisions marked; a reset interrupts the line.

    Args:
        record: recorded walks, axes (robot, frame), or one walk, axis (frame,).
        rooms: a batch of rooms gives one panel per robot; a single room, one panel with all robots; None, paths alone.

    ```python
    import jax
    import lgmdjax as lj

    rooms = lj.random_rooms(jax.random.key(0), 4)
    record = lj.rollout(lj.load_robot(), rooms, seconds=30)
    lj.plot_walks(record, rooms)
    ```
    """
    series = record.position, record.resets, record.contact
    paths = Paths(*(np.asarray(leaf)[None] if np.ndim(record.time) == 1 else np.asarray(leaf) for leaf in series))
    arena = rooms.arena if isinstance(rooms, Room) else rooms
    if arena is None or np.ndim(arena.bounds) == 1:
        figure = _plot_panels([arena], [paths])
    else:
        arenas = [jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], arena) for k in range(len(paths.positions))]
        figure = _plot_panels(arenas, [Paths(*(leaf[[k]] for leaf in paths)) for k in range(len(arenas))])
    if len(figure.axes) == 1:
        figure.set_size_inches(WIDTH, 5.6)
    lower_left = figure.axes[(len(figure.axes) - 1) // 3 * 3]
    lower_left.set(xlabel="x [m]", ylabel="y [m]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
    return figure


@styled
def plot_rooms(arenas: Sequence[Arena], paths: Sequence[Paths]) -> Figure:
    """Plot the walks in several rooms seen from above, one panel per room, with collisions marked."""
    return _plot_panels(arenas, paths)


def _plot_panels(arenas: Sequence[Arena | None], paths: Sequence[Paths]) -> Figure:
    rows = (len(arenas) + 2) // 3
    figure = Figure(figsize=(WIDTH, 0.3 + 2.4 * rows))
    panels = np.asarray(figure.subplots(rows, min(len(arenas), 3), squeeze=False)).ravel()
    for axes, arena, own in zip(panels, arenas, paths, strict=False):
        if arena is not None:
            add_room(axes, arena)
        add_paths(axes, own, colours=PALETTE)
        axes.set_aspect("equal")
        axes.grid(False)
    for axes in panels[len(arenas) :]:
        axes.remove()
    return figure


@styled
def plot_trajectories(arena: Arena | None, paths: Mapping[str, Paths], main: str = "learned") -> Figure:
    """Plot the walks of every policy in one room seen from above (fig. 13), with collisions marked.

    Args:
        arena: the room; None plots the paths alone.
        paths: of each policy, by its name. A reset interrupts the line.
        main: name of the policy in the large panel.
    """
    others = [name for name in paths if name != main]
    figure = Figure(figsize=(WIDTH, 3.9 if others else 5.6))
    rows = max((len(others) + 1) // 2, 1)
    if others:
        large, small = np.asarray(figure.subfigures(1, 2, width_ratios=(1.15, 1)))
        panels = {main: large.subplots(), **dict(zip(others, small.subplots(rows, 2).ravel(), strict=False))}
    else:
        panels = {main: figure.subplots()}
    for name, axes in panels.items():
        if arena is not None:
            add_room(axes, arena)
        add_paths(axes, paths[name], colours=PALETTE if name == main else (POLICY_COLOURS.get(name, GREY),))
        axes.set_title(name)
        axes.set_aspect("equal")
        axes.grid(False)
        if name != main:
            axes.tick_params(labelleft=False, labelbottom=False, length=0)
            axes.spines[:].set_visible(False)
    panels[main].set(xlabel="x [m]", ylabel="y [m]")
    panels[main].legend(loc="upper left", bbox_to_anchor=(0, -0.13), ncols=2, borderaxespad=0)
    return figure


@styled
def plot_passages(
    arenas: Sequence[Arena],
    paths: Sequence[Float[ndarray, "_ 2"]],
    touched: Bool[ndarray, " robots"],
    clearance: Float[ndarray, " robots"],
    lateral_offsets: Float[ndarray, " robots"] | None = None,
) -> Figure:
    """Plot paths past an obstacle seen from above (figs. 14 and 16); those with a contact are red.

    Args:
        arenas: a room per robot.
        paths: of each robot until the end of its trial [m].
        touched: whether the robot touched something.
        clearance: smallest clearance until the end [m].
        lateral_offsets: of the obstacle from the robot's heading [m]; a second panel plots the clearance over them.
    """
    figure = Figure(figsize=(WIDTH, 4.2 if lateral_offsets is None else 6.4))
    axes = (
        figure.subplots()
        if lateral_offsets is None
        else _add_clearance_panel(figure, touched, clearance, lateral_offsets)
    )
    for arena in arenas:
        add_room(axes, arena)
    for path, bad in zip(paths, touched, strict=True):
        axes.plot(*path[::POINT_STRIDE].T, color=RED if bad else LEFT_COLOUR, linewidth=0.9, alpha=0.7, zorder=3)
        axes.plot(*path[-1], "X" if bad else "o", color=RED if bad else LEFT_COLOUR, markersize=4, zorder=4)
    centres = np.concatenate([np.asarray(prisms.centre) for prisms in (arenas[0].boxes, arenas[0].cylinders)])
    near = centres[np.linalg.norm(centres - paths[0][0], axis=1) < START_SURROUNDINGS]
    shown = np.concatenate([*paths, near])
    low, high = shown.min(axis=0), shown.max(axis=0)
    axes.set(xlim=(low[0] - 0.4, high[0] + 0.8), ylim=(low[1] - 0.8, high[1] + 0.8))
    title = f"{np.sum(~touched)} of {len(paths)} without contact"
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title, aspect="equal")
    axes.grid(False)
    return figure


def _add_clearance_panel(
    figure: Figure,
    touched: Bool[ndarray, " n"],
    clearance: Float[ndarray, " n"],
    lateral_offsets: Float[ndarray, " n"],
) -> Axes:
    """Plot the clearance over the lateral offset in the lower third; return the axes above."""
    above, below = figure.subplots(2, height_ratios=(2.0, 1.0))
    for bad, colour, marker in ((False, LEFT_COLOUR, "o"), (True, RED, "X")):
        x, y = lateral_offsets[touched == bad], 100 * np.maximum(clearance[touched == bad], 0)
        below.plot(x, y, color=colour, marker=marker, linestyle="none", markersize=4)
    below.set(xlabel="lateral offset of the obstacle, d_y [m]", ylabel="smallest clearance [cm]")
    below.set_ylim(bottom=0)
    return above


def add_room(axes: Axes, arena: Arena) -> None:
    """Add walls and obstacles seen from above: overhead obstacles as dashed outlines, paths of moving ones dotted."""
    x_min, x_max, y_min, y_max = np.asarray(arena.bounds)
    axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, fill=False, edgecolor=DARK, linewidth=1.6))
    for prisms, make_patch in ((arena.boxes, _box), (arena.cylinders, _disc)):
        for index in np.flatnonzero(~np.asarray(is_inactive(prisms))):
            overhead = bool(is_overhead(prisms)[index])
            patch = make_patch(prisms, index)
            patch.set(facecolor="none" if overhead else OBSTACLE_COLOUR, linestyle="--" if overhead else "-")
            patch.set(edgecolor=GREY, linewidth=0.6)
            axes.add_patch(patch)
            way = np.stack([prisms.centre[index], prisms.goal[index]])
            axes.plot(*way.T, color=GREY, linestyle=":", linewidth=0.8)
    margin = 0.03 * max(x_max - x_min, y_max - y_min)
    axes.set(xlim=(x_min - margin, x_max + margin), ylim=(y_min - margin, y_max + margin))


def _box(prisms: Prisms, index: int | np.intp) -> Polygon:
    a, b = np.asarray(prisms.half_size[index])
    cosine, sine = np.cos(prisms.yaw[index]), np.sin(prisms.yaw[index])
    corners = np.array([[a, b], [-a, b], [-a, -b], [a, -b]]) @ np.array([[cosine, sine], [-sine, cosine]])
    return Polygon(corners + np.asarray(prisms.centre[index]))


def _disc(prisms: Prisms, index: int | np.intp) -> Circle:
    return Circle(tuple(np.asarray(prisms.centre[index])), float(prisms.half_size[index, 0]))


def add_paths(axes: Axes, paths: Paths, colours: Sequence[str]) -> None:
    """Add a path per robot, interrupted at resets, with a ring at its start and a cross at each collision."""
    start = {"marker": "o", "color": DARK, "markerfacecolor": "white", "markersize": 4, "linestyle": "none"}
    collision = {"marker": "X", "color": RED, "markeredgecolor": "white", "markersize": 5, "linestyle": "none"}
    for robot, (positions, resets, contact) in enumerate(zip(*paths, strict=True)):
        for segment in np.split(positions[:, :2], np.flatnonzero(np.diff(resets)) + 1):
            points = np.concatenate([segment[::POINT_STRIDE], segment[-1:]])
            axes.plot(*points.T, color=colours[robot % len(colours)], linewidth=0.9, alpha=0.85, zorder=3)
        axes.plot(*positions[contact.astype(bool), :2].T, **collision, zorder=5)
        axes.plot(*positions[0, :2], **start, zorder=4)
    axes.plot([], [], **start, label="start")
    axes.plot([], [], **collision, label="collision, robot reset")
