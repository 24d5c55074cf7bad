"""A room seen from above, as SVG: walls, obstacles, start, and paths of robots.

Obstacles overhead are dashed outlines. Moving obstacles are drawn at their initial position. x is to the right, y up.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float
from numpy import ndarray

from lgmdjax.world.obstacles import Prisms, is_inactive, is_overhead

AnyArray = Array | ndarray
WIDTH = 220  # px of the picture
MARGIN = 0.04  # of the longer side
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
WALL, OBSTACLE, RED = "#222222", "#c9c5bd", "#c1121f"
Path = Float[ndarray, "_ _"]
"""Points of a path [m], one a row, x and y first."""


@runtime_checkable
class Room(Protocol):
    """The fields of a room that are drawn; `arena.Arena` has them."""

    @property
    def bounds(self) -> AnyArray: ...

    @property
    def boxes(self) -> Prisms: ...

    @property
    def cylinders(self) -> Prisms: ...

    @property
    def start(self) -> AnyArray: ...


def svg(arena: Room | None, robots: Sequence[Sequence[Path]] = (), marks: Sequence[Path] = ()) -> str:
    """Return a picture of a room, with paths of robots [m] and crosses at points; without a room, of the paths alone.

    >>> svg(None, [[np.array([[0.0, 0.0], [1.0, 1.0]])]]).count("<polyline")
    1

    Args:
        arena: a single room.
        robots: the pieces of each robot's path.
        marks: points, such as those of collisions.
    """
    low, high = _extent(arena, [path for paths in robots for path in paths])
    pixel = float((high - low).max()) / WIDTH
    parts = [] if arena is None else _room(arena, pixel)
    for index, paths in enumerate(robots):
        parts += [_path(path, COLOURS[index % len(COLOURS)], pixel) for path in paths]
        parts += [_ring(paths[0][0], pixel)] if paths else []
    parts += [_cross(point, pixel) for points in marks for point in points]
    width, height = high - low
    box = f"{low[0]:.3f} {-high[1]:.3f} {width:.3f} {height:.3f}"
    size = f'width="{width / pixel:.0f}" height="{height / pixel:.0f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="{box}" role="img">'
        f'<g transform="scale(1,-1)">{"".join(parts)}</g></svg>'
    )


def _path(path: Path, colour: str, pixel: float) -> str:
    line = " ".join(f"{x:.3f},{y:.3f}" for x, y in path[:, :2])
    return f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="{1.5 * pixel:.4f}"/>'


def _ring(point: Float[ndarray, " _"], pixel: float) -> str:
    look = f'r="{3 * pixel:.4f}" fill="white" stroke="{WALL}" stroke-width="{pixel:.4f}"'
    return f'<circle cx="{point[0]:.3f}" cy="{point[1]:.3f}" {look}/>'


def _cross(point: Float[ndarray, " _"], pixel: float) -> str:
    (x, y), arm = point[:2], 4 * pixel
    strokes = (f"M{x - arm:.3f} {y + sign * arm:.3f}l{2 * arm:.3f} {-2 * sign * arm:.3f}" for sign in (-1, 1))
    line = " ".join(strokes)
    return f'<path d="{line}" stroke="{RED}" stroke-width="{2 * pixel:.4f}"/>'


def _extent(arena: Room | None, paths: Sequence[Path]) -> tuple[ndarray, ndarray]:
    """Return the lower left and the upper right corner of what is shown [m]."""
    if arena is None:
        points = np.concatenate([path[:, :2] for path in paths])
        low, high = points.min(axis=0), points.max(axis=0)
    else:
        x_min, x_max, y_min, y_max = np.asarray(arena.bounds, float)
        low, high = np.array([x_min, y_min]), np.array([x_max, y_max])
    longer = max(float((high - low).max()), 0.1)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 0.2 * longer) + MARGIN * longer
    return middle - half, middle + half


def _room(arena: Room, pixel: float) -> list[str]:
    x_min, x_max, y_min, y_max = np.asarray(arena.bounds, float)
    size = f'width="{x_max - x_min:.3f}" height="{y_max - y_min:.3f}"'
    parts = [
        f'<rect x="{x_min:.3f}" y="{y_min:.3f}" {size} fill="white" stroke="{WALL}" stroke-width="{2 * pixel:.4f}"/>'
    ]
    for prisms, shape in ((arena.boxes, _box), (arena.cylinders, _disc)):
        for index in np.flatnonzero(~np.asarray(is_inactive(prisms))):
            overhead = bool(is_overhead(prisms)[index])
            look = f'fill="{"none" if overhead else OBSTACLE}" stroke="#767676" stroke-width="{pixel:.4f}"'
            dashes = f' stroke-dasharray="{4 * pixel:.4f}"' if overhead else ""
            parts.append(f"<{shape(prisms, int(index))} {look}{dashes}/>")
    x, y, yaw = np.asarray(arena.start, float)
    tip, left, right = ((r * np.cos(yaw + a), r * np.sin(yaw + a)) for r, a in ((9, 0), (6, 2.5), (6, -2.5)))
    corners = " ".join(f"{x + dx * pixel:.3f},{y + dy * pixel:.3f}" for dx, dy in (tip, left, right))
    return [*parts, f'<polygon points="{corners}" fill="{WALL}"/>']


def _box(prisms: Prisms, index: int) -> str:
    (x, y), (a, b) = np.asarray(prisms.centre[index], float), np.asarray(prisms.half_size[index], float)
    turn = np.degrees(float(prisms.yaw[index]))
    where = f'x="{x - a:.3f}" y="{y - b:.3f}" width="{2 * a:.3f}" height="{2 * b:.3f}"'
    return f'rect {where} transform="rotate({turn:.2f} {x:.3f} {y:.3f})"'


def _disc(prisms: Prisms, index: int) -> str:
    x, y = np.asarray(prisms.centre[index], float)
    return f'circle cx="{x:.3f}" cy="{y:.3f}" r="{float(prisms.half_size[index, 0]):.3f}"'
