"""Two fisheye eyes: what the robot sees, every pixel integrated over its area.

One ray a pixel, and beside it how the ray turns from pixel to pixel. What a prism covers of a pixel is the margin by
which the ray is inside its outline, divided by the change of that margin over the pixel and clamped: no sampling, and
differentiable everywhere. The two nearest layers are kept and shaded, over the mean of what is behind.

| symbol   | name                                          | unit     | where                                            |
| -------- | --------------------------------------------- | -------- | ------------------------------------------------ |
| theta    | angle of a pixel from the optical axis        | rad      | theta = rho / f (equidistant), rho in pixels     |
| f        | focal length                                  | px/rad   | width / fov                                      |
| d        | direction of the ray in the world             | 1        |                                                  |
| d_u, d_v | its change from column to column, row to row  | 1/px     |                                                  |
| s        | surface as inverse depth: 1/t = s . d         | 1/m      | `silhouettes`                                    |
| m        | margin inside an outline                      |          |                                                  |
| a        | part of the pixel inside the outline          | 1        | clip(1/2 + m/w), w = max + min/2 of abs(dm/du), abs(dm/dv) |

Site frames: x forward, y left, z up. Row 0 is the top, column 0 the left. Grey levels 0..255.

Prisms are sorted out by image tile: each tile knows the `slots` nearest ones that may show in it.
Source: sec. 3.1 and 4 of the paper for the cameras; the way of drawing is our own.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from lgmdjax import silhouettes, texture
from lgmdjax.arena import Arena
from lgmdjax.errors import InputError
from lgmdjax.silhouettes import Bounds, Silhouette
from lgmdjax.texture import Texture, Vector


@struct.dataclass(kw_only=True)
class Params:
    """The camera's structure, all of it static. Raises InputError when it cannot be."""

    width: int = struct.field(pytree_node=False, default=320)
    height: int = struct.field(pytree_node=False, default=240)
    fov: float = struct.field(pytree_node=False, default=math.radians(170.0))
    """Over the whole width [rad]."""
    overlap: float = struct.field(pytree_node=False, default=1.0)
    """Part of the width that an eye draws, from its own side: 0.5 (its half) .. 1 (all)."""
    samples: int = struct.field(pytree_node=False, default=1)
    """Rays a pixel along each side; one is enough since a ray stands for an area."""
    slots: int = struct.field(pytree_node=False, default=6)
    """Prisms that a tile of the picture can hold; the nearest are kept (`crowding` tells how many it takes)."""

    def __post_init__(self) -> None:
        for name in ("width", "height", "samples", "slots"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise InputError(f"expected camera {name} as a whole number above 0, got {value!r}; change it")
        if not 0.0 < self.fov < 2.0 * math.pi:
            raise InputError(f"expected a camera fov in (0, 2 pi) rad, got {self.fov!r}; give radians")
        if not self.fov * math.hypot(1.0, self.height / self.width) < 2.0 * math.pi:
            raise InputError(
                f"expected corners of the picture within pi rad of its middle, got {self.width} x {self.height} "
                f"with fov {self.fov:.3f}; lower fov or height"
            )
        if not 0.5 <= self.overlap <= 1.0:
            raise InputError(f"expected a camera overlap in 0.5..1, got {self.overlap!r}; change it")


def shape(params: Params) -> tuple[int, int, int]:
    """Return the shape of a stereo pair: eyes, rows, columns."""
    return 2, params.height, round(params.overlap * params.width)


def render(
    params: Params,
    arena: Arena,
    positions: Float[Array, "2 3"],
    rotations: Float[Array, "2 3 3"] | Float[Array, "3 3"],
) -> Float[Array, "2 height columns"]:
    """Draw what the left and the right eye see, in grey levels 0..255.

    `positions` [m] and `rotations` (columns: the eye's x forward, y left, z up in the world; one for both will do) are
    the eyes' poses. The left eye draws its columns [0, overlap * width), the right one the last overlap * width.
    Gradient: through outlines (their coverage), depths and textures; zero through which prisms are kept.
    """
    rotations = jnp.broadcast_to(rotations, (2, 3, 3))
    # The right eye's picture is drawn mirrored, so that both hemifields have the same pixels.
    side = jnp.asarray([1.0, -1.0], dtype=positions.dtype)
    pictures = jax.vmap(functools.partial(_eye, params, arena))(positions, rotations, side)
    return jnp.stack([pictures[0], pictures[1, :, ::-1]])


def crowding(
    params: Params, arena: Arena, positions: Float[Array, "2 3"], rotations: Float[Array, "2 3 3"] | Float[Array, "3 3"]
) -> Array:
    """Count the prisms that may show in the fullest tile of the picture; with that many `slots` none is left out."""
    rotations = jnp.broadcast_to(rotations, (2, 3, 3))
    side = jnp.asarray([1.0, -1.0], dtype=positions.dtype)

    def fullest(position: Array, rotation: Array, mirrored: Array) -> Array:
        prisms, bounds = _look(arena, position)
        return jnp.max(jnp.sum(_may_show(_tiles(params), prisms, bounds, rotation, mirrored), axis=-1))

    return jnp.max(jax.vmap(fullest)(positions, rotations, side))


class _Tiles(NamedTuple):
    """The pixels of a picture, tile by tile, in the eye's frame."""

    rows: int
    columns: int
    size: int
    d: np.ndarray  # (3, tiles, pixels)
    d_u: np.ndarray
    d_v: np.ndarray
    middle: np.ndarray  # (tiles, 3)
    radius: np.ndarray  # (tiles,) rad


@functools.lru_cache(maxsize=32)
def _tiles(params: Params) -> _Tiles:
    """Lay out the rays of a left eye in square tiles of about eight degrees, a few beyond the edge if need be."""
    n = params.samples
    height, width = params.height * n, params.width * n
    f = width / params.fov
    size = max(8, 2 * round(0.5 * math.radians(8.5) * f))
    rows, columns = -(-height // size), -(-(shape(params)[2] * n) // size)
    v, u = np.mgrid[: rows * size, : columns * size].astype(float) + 0.5
    u, v = u - 0.5 * width, v - 0.5 * height
    d, d_u, d_v = (_tiled(a, rows, columns, size) for a in _equidistant(u, v, f))
    middle = d.sum(axis=2).T
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    nearest_cosine = np.einsum("ctp,tc->tp", d, middle).min(axis=1)
    radius = np.arccos(np.clip(nearest_cosine, -1.0, 1.0)) + 1.5 / f
    return _Tiles(rows, columns, size, d, d_u, d_v, middle, radius)


def _equidistant(u: np.ndarray, v: np.ndarray, f: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions of the pixels (u, v) from the middle, and their derivatives by u and v."""
    rho = np.maximum(np.hypot(u, v), 1e-9)
    theta = rho / f
    spread = np.sin(theta) / rho
    change = (np.cos(theta) / f - spread) / rho**2
    d = np.stack([np.cos(theta), -spread * u, -spread * v])
    d_u = np.stack([-spread * u / f, -spread - change * u * u, -change * u * v])
    d_v = np.stack([-spread * v / f, -change * u * v, -spread - change * v * v])
    return d, d_u, d_v


def _tiled(a: np.ndarray, rows: int, columns: int, size: int) -> np.ndarray:
    tiled = a.reshape(3, rows, size, columns, size).transpose(0, 1, 3, 2, 4)
    return tiled.reshape(3, rows * columns, size * size)


def _eye(params: Params, arena: Arena, position: Array, rotation: Array, side: Array) -> Array:
    """Draw one eye, the right one (side = -1) mirrored."""
    tiles = _tiles(params)
    prisms, bounds = _look(arena, position)
    picked = _pick(params, tiles, prisms, bounds, rotation, side)
    pixels = _pixels(tiles, rotation, side)
    grey = _draw(params, arena, position, pixels, picked)
    return _assemble(params, tiles, grey)


def _look(arena: Arena, position: Array) -> tuple[Silhouette, Bounds]:
    boxes = silhouettes.of_boxes(arena.boxes, position)
    cylinders = silhouettes.of_cylinders(arena.cylinders, position)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), boxes, cylinders)


def _may_show(tiles: _Tiles, prisms: Silhouette, bounds: Bounds, rotation: Array, side: Array) -> Array:
    """Tell which prisms (last axis) may show in which tiles: no limit of the outline is beyond the tile's cone."""
    dtype = rotation.dtype
    mirror = jnp.stack([jnp.ones_like(side), side, jnp.ones_like(side)])
    axis = (jnp.asarray(tiles.middle, dtype) * mirror) @ rotation.T
    radius = jnp.asarray(tiles.radius, dtype)[:, None]
    x, y = axis[:, :1], axis[:, 1:2]
    elevation = jnp.arcsin(jnp.clip(axis[:, 2:], -1.0, 1.0))
    slack = jnp.where(prisms.within > 0, 2.0, jnp.sin(jnp.minimum(radius, 0.5 * math.pi)))
    inside_left = prisms.left[0] * x + prisms.left[1] * y > -slack
    inside_right = prisms.right[0] * x + prisms.right[1] * y > -slack
    level = (elevation + radius > bounds.lowest) & (elevation - radius < bounds.highest)
    return inside_left & inside_right & level & (prisms.open > 0)


def _pick(
    params: Params, tiles: _Tiles, prisms: Silhouette, bounds: Bounds, rotation: Array, side: Array
) -> list[Silhouette]:
    """Give each tile the nearest prisms that may show in it: one silhouette (tiles, 1) a slot."""
    shows = _may_show(tiles, prisms, lax.stop_gradient(bounds), lax.stop_gradient(rotation), side)
    count = min(params.slots, bounds.nearest.shape[0])
    nearness, chosen = lax.top_k(jnp.where(shows, 1.0 / bounds.nearest, 0.0), count)
    leaves, structure = jax.tree.flatten(prisms)
    table = jnp.stack(leaves, axis=-1)[chosen]
    slots = []
    for k in range(count):
        silhouette = jax.tree.unflatten(structure, [table[:, k, i, None] for i in range(len(leaves))])
        shown = nearness[:, k, None] > 0
        limited = {name: tuple(jnp.where(shown, a, 0.0) for a in getattr(silhouette, name)) for name in ("left", "right")}
        slots.append(silhouette._replace(open=jnp.where(shown, silhouette.open, 0.0), **limited))
    return slots


class _Pixels(NamedTuple):
    """Rays in the world, (tiles, pixels) each."""

    d: Vector
    d_u: Vector
    d_v: Vector
    level_square: Array  # d_x^2 + d_y^2
    turn: tuple[Array, Array]  # d_x, d_y by the width of a pixel across an upright edge


def _pixels(tiles: _Tiles, rotation: Array, side: Array) -> _Pixels:
    def turned(rays: np.ndarray) -> Vector:
        x, y, z = (jnp.asarray(a, rotation.dtype) for a in rays)
        y = y * side
        r = rotation
        return tuple(r[i, 0] * x + r[i, 1] * y + r[i, 2] * z for i in range(3))  # pyright: ignore

    d, d_u, d_v = turned(tiles.d), turned(tiles.d_u), turned(tiles.d_v)
    level_square = d[0] * d[0] + d[1] * d[1] + 1e-12
    width = _width(d[0] * d_u[1] - d[1] * d_u[0], d[0] * d_v[1] - d[1] * d_v[0])
    per_pixel = jnp.sqrt(level_square) / width
    return _Pixels(d, d_u, d_v, level_square, (d[0] * per_pixel, d[1] * per_pixel))


class _Layer(NamedTuple):
    """A surface in front of a pixel."""

    nearness: Array  # 1/t by which layers are ordered
    cover: Array  # a
    s: Vector
    centre: tuple[Array, Array]
    axis: tuple[Array, Array]
    texture: Texture


def _draw(params: Params, arena: Arena, position: Array, pixels: _Pixels, slots: list[Silhouette]) -> Array:
    """Find the two nearest layers of every pixel, shade them, and blend them over what is left."""
    room = _room(arena, position, pixels)
    first, second = room.first, room.second
    background = room.first.nearness
    count = jnp.zeros_like(background)
    for slot in slots:
        layer = _prism_layer(slot, pixels)
        count = count + jnp.where(layer.nearness > background, 1.0, 0.0)
        first, second = _insert(layer, first, second)
    shade = functools.partial(_shade, arena.handedness, position, pixels)
    rest = jnp.where(count > 1.5, room.mean, jnp.where(count > 0.5, room.other, room.beyond))
    behind = second.cover * shade(second) + (1.0 - second.cover) * rest
    return first.cover * shade(first) + (1.0 - first.cover) * behind


def _insert(layer: _Layer, first: _Layer, second: _Layer) -> tuple[_Layer, _Layer]:
    """Keep the two nearest of three layers."""
    nearest = layer.nearness > first.nearness
    nearer = layer.nearness > second.nearness
    runner_up = _where(nearest, first, layer)
    return _where(nearest, layer, first), _where(nearer, runner_up, second)


def _where(condition: Array, a: _Layer, b: _Layer) -> _Layer:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _prism_layer(prism: Silhouette, pixels: _Pixels) -> _Layer:
    """Cover and surface of a prism."""
    d, (turn_x, turn_y) = pixels.d, pixels.turn
    left = _clip(prism.left[0] * turn_x + prism.left[1] * turn_y + prism.open)
    right = _clip(prism.right[0] * turn_x + prism.right[1] * turn_y + prism.open)
    enter, leave = _sides(prism, pixels)
    over_top = _rise(prism.top, _choose(prism.top < 0, leave, enter), pixels)
    over_bottom = _rise(prism.bottom, _choose(prism.bottom > 0, leave, enter), pixels)
    below_top = _clip(over_top + prism.unclosed_top + 0.5)
    above_bottom = _clip(prism.unclosed_bottom - over_bottom + 0.5)
    across = jnp.maximum(left + right - 1.0, 0.0)
    upright = jnp.maximum(below_top + above_bottom - 1.0, 0.0)
    cover = across * upright
    on_side = enter[0] * d[0] + enter[1] * d[1]
    on_lid = prism.lid * d[2]
    by_lid = (prism.lid != 0) & (on_lid < on_side + prism.within)
    s = (jnp.where(by_lid, 0.0, enter[0]), jnp.where(by_lid, 0.0, enter[1]), jnp.where(by_lid, prism.lid, 0.0))
    nearness = jnp.where(by_lid, on_lid, on_side)
    nearness = jnp.where(cover > 0, nearness, -1.0)
    return _Layer(nearness, cover, s, prism.centre, prism.axis, prism.texture)


def _sides(prism: Silhouette, pixels: _Pixels) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Inverse-depth vectors of the sides by which each ray would enter and leave, were the prism endless upward."""
    x, y, _ = pixels.d
    by_x = prism.near_x[0] * x + prism.near_x[1] * y < prism.near_y[0] * x + prism.near_y[1] * y
    near = _choose(by_x, prism.near_x, prism.near_y)
    c, s = prism.axis
    along, aside = c * x + s * y, c * y - s * x
    far_x = jnp.where(along > 0, jnp.maximum(*prism.far_x), jnp.minimum(*prism.far_x))
    far_y = jnp.where(aside > 0, jnp.maximum(*prism.far_y), jnp.minimum(*prism.far_y))
    far = _choose(far_x * along > far_y * aside, (far_x * c, far_x * s), (-far_y * s, far_y * c))
    near_round, far_round = _round_sides(prism, pixels)
    is_round = prism.round > 0
    return _choose(is_round, near_round, near), _choose(is_round, far_round, far)


def _round_sides(prism: Silhouette, pixels: _Pixels) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """The planes that touch a cylinder where a ray enters and leaves it: s = o/c +- ((d.o) o/c - d)/q.

    q^2 = (d.o)^2 - c d^2, taken as r^2 d^2 - (o x d)^2. Rays that miss get the plane through the limb.
    """
    x, y, _ = pixels.d
    (o_x, o_y), (p_x, p_y) = prism.centre, prism.polar
    moment = o_x * y - o_y * x
    discriminant = prism.radius_square * pixels.level_square - moment * moment
    least = 1e-4 * prism.radius_square * pixels.level_square
    meets = discriminant > least
    inverse = jnp.where(meets, lax.rsqrt(jnp.where(meets, discriminant, 1.0)), 0.0)
    b = o_x * x + o_y * y
    e_x, e_y = (b * p_x - x) * inverse, (b * p_y - y) * inverse
    return (p_x + e_x, p_y + e_y), (p_x - e_x, p_y - e_y)


def _rise(z: Array, s: tuple[Array, Array], pixels: _Pixels) -> Array:
    """Margin, in pixels, by which rays pass below the height z on the side s: m = z s . d - d_z."""
    e_x, e_y = z * s[0], z * s[1]
    d, u, v = pixels.d, pixels.d_u, pixels.d_v
    margin = e_x * d[0] + e_y * d[1] - d[2]
    width = _width(e_x * u[0] + e_y * u[1] - u[2], e_x * v[0] + e_y * v[1] - v[2])
    return margin / width


def _width(across: Array, down: Array) -> Array:
    """The width over which a box one pixel wide smears an edge whose margin changes so much a column and a row."""
    across, down = jnp.abs(across), jnp.abs(down)
    return jnp.maximum(across, down) + 0.5 * jnp.minimum(across, down) + 1e-9


class _Room(NamedTuple):
    """Walls, floor and sky of every pixel."""

    first: _Layer
    second: _Layer
    beyond: Array  # grey behind both
    other: Array  # mean grey behind the first alone
    mean: Array  # mean grey of all


def _room(arena: Arena, position: Array, pixels: _Pixels) -> _Room:
    """Draw the room without obstacles: a wall or the floor first, then what it shares the pixel with."""
    d = pixels.d
    by_x, along_x, along_y = _walls(arena, position, d)
    wall_s, other_s = _choose(by_x, along_x, along_y), _choose(by_x, along_y, along_x)
    nearness = wall_s[0] * d[0] + wall_s[1] * d[1]
    part = _clip(_corner(along_x, along_y, by_x, pixels) + 0.5)
    eye = position[2]
    floor = _clip(_rise(-eye, wall_s, pixels) + 0.5)
    sky = _clip(0.5 - _rise(arena.wall_height - eye, wall_s, pixels))
    wall = jnp.maximum(1.0 - floor - sky, 0.0)

    still = (jnp.ones_like(eye), jnp.zeros_like(eye))
    centre = (-position[0], -position[1])
    zero = jnp.zeros_like(nearness)
    rows = texture.prepare(arena.wall_texture)
    x_row = _choose(d[0] > 0, _row(rows, 1), _row(rows, 0))
    y_row = _choose(d[1] > 0, _row(rows, 3), _row(rows, 2))
    wall_row, other_row = _choose(by_x, x_row, y_row), _choose(by_x, y_row, x_row)
    floor_row = texture.prepare(arena.floor_texture)
    floor_first = floor > 0.5
    near = jnp.where(floor_first, 0.0, nearness)
    over_floor = floor > 0

    def layer(cover: Array, s: Vector, row: Texture) -> _Layer:
        return _Layer(near, cover, s, centre, still, jax.tree.map(lambda a: a + zero, row))

    floor_s = (zero, zero, zero - 1.0 / jnp.maximum(eye, 1e-4))
    one_wall, other_wall = (*wall_s, zero), (*other_s, zero)
    as_floor = layer(jnp.where(floor_first, floor, 1.0), floor_s, floor_row)
    as_wall = layer(jnp.where(over_floor, jnp.where(floor_first, 1.0, wall), wall * part), one_wall, wall_row)
    as_other = layer(wall * (1.0 - part) / jnp.maximum(1.0 - wall * part, 1e-3), other_wall, other_row)
    first = _where(floor_first, as_floor, as_wall)
    second = _where(floor_first, as_wall, _where(over_floor, as_floor, as_other))
    floor_grey = floor_row.brightness
    mean = floor * floor_grey + wall * wall_row.brightness + sky * arena.sky
    aside = jnp.where(sky > 0, arena.sky, floor_grey)
    aside = jnp.where(part < 1.0, other_row.brightness, aside)
    return _Room(first, second, arena.sky + zero, jnp.where(floor_first, wall_row.brightness, aside), mean)


def _walls(arena: Arena, position: Array, d: Vector) -> tuple[Array, tuple[Array, Array], tuple[Array, Array]]:
    """Inverse-depth vectors of the walls ahead in x and in y, and which of them is met first."""
    low, high = position[:2] - arena.room[0::2], arena.room[1::2] - position[:2]
    forth, back = 1.0 / jnp.maximum(high, 1e-3), -1.0 / jnp.maximum(low, 1e-3)
    s_x, s_y = jnp.where(d[0] > 0, forth[0], back[0]), jnp.where(d[1] > 0, forth[1], back[1])
    return s_x * d[0] > s_y * d[1], (s_x, jnp.zeros_like(s_x)), (jnp.zeros_like(s_y), s_y)


def _corner(along_x: tuple[Array, Array], along_y: tuple[Array, Array], by_x: Array, pixels: _Pixels) -> Array:
    """Margin, in pixels, from the upright edge between the wall that is met and its neighbour."""
    e_x, e_y = along_x[0], -along_y[1]
    d, u, v = pixels.d, pixels.d_u, pixels.d_v
    margin = e_x * d[0] + e_y * d[1]
    width = _width(e_x * u[0] + e_y * u[1], e_x * v[0] + e_y * v[1])
    return jnp.where(by_x, margin, -margin) / width


def _shade(handedness: Array, position: Array, pixels: _Pixels, layer: _Layer) -> Array:
    """Grey of a layer's surface where the ray meets it."""
    d, s = pixels.d, layer.s
    t = 1.0 / jnp.maximum(s[0] * d[0] + s[1] * d[1] + s[2] * d[2], 1e-3)
    cosine, sine = layer.axis

    def local(x: Array, y: Array, z: Array) -> Vector:
        return cosine * x + sine * y, (cosine * y - sine * x) * handedness, z

    def step(turn: Vector) -> Vector:
        # The hit moves sideways with the ray and along it with the surface's slant.
        slant = (s[0] * turn[0] + s[1] * turn[1] + s[2] * turn[2]) * t
        x, y, z = (t * (turn[i] - d[i] * slant) for i in range(3))
        return local(x, y, z)

    point = local(d[0] * t - layer.centre[0], d[1] * t - layer.centre[1], d[2] * t + position[2])
    return texture.grey(layer.texture, point, step(pixels.d_u), step(pixels.d_v))


def _assemble(params: Params, tiles: _Tiles, grey: Array) -> Array:
    """Put the tiles together, average the samples of a pixel, and cut off what is beyond the edge."""
    rows, columns, size, n = tiles.rows, tiles.columns, tiles.size, params.samples
    picture = grey.reshape(rows, columns, size, size).transpose(0, 2, 1, 3).reshape(rows * size, columns * size)
    _, height, width = shape(params)
    picture = picture[: height * n, : width * n]
    if n == 1:
        return picture
    return jnp.mean(picture.reshape(height, n, width, n), axis=(1, 3))


def _row(rows: Texture, i: int) -> Texture:
    return jax.tree.map(lambda a: a[i], rows)


def _choose(condition: Array, a, b):
    """`where` over a tuple of arrays."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _clip(x: Array) -> Array:
    return jnp.clip(x, 0.0, 1.0)
