"""What covers a pixel: the surfaces in front of it, nearest first, by how much each covers and what grey it has.

Everything here is elementwise over rays, so that XLA makes one vectorised loop of it. Components of vectors are
arrays of their own for the same reason.

| symbol | name                                      | unit | where         |
| ------ | ----------------------------------------- | ---- | ------------- |
| d      | direction of a ray in the world           | 1    | `edges`       |
| s      | surface as inverse depth, 1/t = s . d     | 1/m  | `silhouettes` |
| a      | part of a pixel that a surface covers     | 1    | `edges`       |
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from lgmdjax.minmax import maximum
from lgmdjax.sensors import antialiasing
from lgmdjax.sensors.silhouettes import NEAR, Pair, Silhouette
from lgmdjax.world import texture
from lgmdjax.world.arena import Arena
from lgmdjax.world.texture import Texture, Vector

Arrays = TypeVar("Arrays")
Keep = Callable[[Any], Any]

_FAR = 1.0e3
"""What is farther away [m] is shaded as if it were here."""


_OPEN = 1.0e4
"""A margin [px], or an inverse depth [1/m], that stands for no limit at all."""
_BACK = 0.97
"""Walls count as farther away, so that what touches them is not cut by them within a pixel of its outline."""


class Layer(NamedTuple):
    """A surface in front of each pixel."""

    nearness: Array
    """1/t, by which layers are ordered; -1: not there."""
    cover: Array
    """a."""
    shift: Pair
    """Columns and rows from the middle of the pixel to that of the part that is covered."""
    s: Vector
    centre: Pair
    """Where the texture's origin is, from the eye [m]."""
    texture: Texture


@functools.partial(jax.custom_jvp, nondiff_argnums=(4,))
def draw(arena: Arena, eye: Array, pixels: antialiasing.Rays, prisms: list[Silhouette], bands: int) -> Array:
    """Blend the two nearest layers of every pixel over the mean grey of the third and of what is behind that.

    Arrays of pixels are (tiles, pixels), those of prisms (tiles, 1).

    Gradient: that of the same drawing with its loops as `lax.scan`, and with what many loops read written down.
    Unrolled they are one expression, the fastest to evaluate, but its derivative would take minutes to compile. The
    picture itself is the fast drawing's, with a derivative or without.
    """
    return _draw(_AT_ONCE, arena, eye, pixels, prisms, bands)


@draw.defjvp
def _draw_jvp(bands: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    _, slope = jax.jvp(functools.partial(_draw, _IN_STEPS, bands=bands), primals, tangents)
    return draw(*primals, bands), slope


class _Way(NamedTuple):
    """How to draw: what goes over prisms and layers, and what is done to arrays that much hangs on."""

    scan: Callable[[Callable, Any, list], tuple[Any, Any]]
    keep: Callable[[Any, Array], Any]


def _draw(
    way: _Way, arena: Arena, eye: Array, pixels: antialiasing.Rays, prisms: list[Silhouette], bands: int
) -> Array:
    def keep(arrays: Arrays) -> Arrays:
        return way.keep(arrays, eye)

    pixels = keep(pixels)
    room = _room(arena, eye, pixels, keep)
    background = room.first.nearness
    third = _Plain(background, jnp.zeros_like(background), jnp.zeros_like(background))
    nearest = jax.tree.map(lambda a: jnp.broadcast_to(a, background.shape), (room.first, room.second, third))

    def insert(layers: tuple[Layer, Layer, _Plain], prism: Silhouette) -> tuple[tuple[Layer, Layer, _Plain], None]:
        return _insert(_prism(prism, pixels, keep), *layers), None

    def shade(carry: None, layer: Layer) -> tuple[None, Array]:
        return carry, _shade(arena.handedness, eye, pixels, layer, bands)

    (first, second, third), _ = way.scan(insert, nearest, prisms)
    behind_two = jnp.where(second.nearness > background, room.behind_two, room.behind_one)
    rest = jnp.where(third.nearness > background, room.behind_three, behind_two)
    rest = rest + third.cover * (third.grey - rest)
    # What the first layer leaves of a pixel has its middle opposite.
    opposite = antialiasing.once(-first.cover / (1.001 - first.cover))
    shift = first.shift[0] * opposite, first.shift[1] * opposite
    _, (nearer, farther) = way.scan(shade, None, [first, second._replace(shift=shift)])
    return rest + second.cover * (1.0 - first.cover) * (farther - rest) + first.cover * (nearer - rest)


def _unrolled(body: Callable, carry: Any, inputs: list) -> tuple[Any, list]:
    """`lax.scan` over a list, written out."""
    outputs = []
    for one in inputs:
        carry, output = body(carry, one)
        outputs.append(output)
    return carry, outputs


def _scanned(body: Callable, carry: Any, inputs: list) -> tuple[Any, Any]:
    """`lax.scan` over a list, whose reverse mode remembers nothing but the carries."""
    return lax.scan(jax.checkpoint(body), carry, jax.tree.map(lambda *leaves: jnp.stack(leaves), *inputs))


def _written(arrays: Any, eye: Array) -> Any:
    """Have XLA write arrays to memory, and on the way back what it knows of them.

    Each of the many loops that read one would else compute it anew, with all that it comes from. A division is never
    repeated, and that this one is by 1 is not known before the eye is.
    """
    one = 1.0 + 0.0 * lax.stop_gradient(eye[0])
    return jax.tree.map(lambda a: a / one, arrays)


_AT_ONCE = _Way(_unrolled, lambda arrays, _: arrays)
_IN_STEPS = _Way(_scanned, _written)


class _Plain(NamedTuple):
    """A layer without its texture: the third counts in few pixels."""

    nearness: Array
    cover: Array
    grey: Array


def _insert(layer: Layer, first: Layer, second: Layer, third: _Plain) -> tuple[Layer, Layer, _Plain]:
    """Keep the three nearest of four layers."""
    is_first, is_second = layer.nearness > first.nearness, layer.nearness > second.nearness
    is_third = layer.nearness > third.nearness
    loser = choose(is_second, _plain(second), _plain(layer))
    runner_up = choose(is_first, first, layer)
    return choose(is_first, layer, first), choose(is_second, runner_up, second), choose(is_third, loser, third)


def _plain(layer: Layer) -> _Plain:
    return _Plain(layer.nearness, layer.cover, layer.texture.brightness)


def _prism(prism: Silhouette, pixels: antialiasing.Rays, keep: Keep) -> Layer:
    """What a prism covers of each pixel, and with which face."""
    d, (across_x, across_y) = pixels.d, pixels.across
    beyond = (prism.open - 0.5) * _OPEN
    margins = keep([n[0] * across_x + n[1] * across_y + beyond for n in (prism.left, prism.right)])
    left, right = (antialiasing.part(margin, pixels.slant) for margin in margins)
    by_side = 0.5 * (right - left)
    near, far = keep(_sides(prism, pixels, by_side))
    side = antialiasing.slopes(near, pixels)
    # From within its wedge a prism can be entered by its lid only, and only the lid ends.
    within, lidless = prism.open > 0.75, prism.lid == 0
    last = antialiasing.slopes(choose(lidless, near, far), pixels)
    upward = jnp.where(prism.lid > 0, -1.0, 1.0).astype(prism.lid.dtype)
    lid_rise, lid_shift = antialiasing.rise(prism.lid_end, last, pixels)
    other_rise, other_shift = antialiasing.rise(prism.other_end, side, pixels)
    to_lid = antialiasing.ramp(upward * lid_rise + jnp.where(within & lidless, _OPEN, 0.0))
    to_other = antialiasing.ramp(jnp.where(within, _OPEN, 0.0) - upward * other_rise)
    by_lid_end, by_other_end = 0.5 * upward * (1.0 - to_lid), 0.5 * upward * (to_other - 1.0)
    shift_u, shift_v = (
        by_lid_end * lid_shift[i] + by_other_end * other_shift[i] + by_side * pixels.rightward[i] for i in (0, 1)
    )
    cover = maximum(left + right - 1.0, 0.0) * maximum(to_lid + to_other - 1.0, 0.0)
    on_lid = prism.lid * d[2]
    by_lid = on_lid < side[0] + jnp.where(lidless, -_OPEN, jnp.where(within, _OPEN, 0.0))
    s = (jnp.where(by_lid, 0.0, near[0]), jnp.where(by_lid, 0.0, near[1]), jnp.where(by_lid, prism.lid, 0.0))
    nearness = jnp.where(cover > 0, jnp.where(by_lid, on_lid, side[0]), -1.0)
    nearness, cover, shift, s = keep((nearness, cover, (shift_u, shift_v), s))
    return Layer(nearness, cover, shift, s, prism.centre, prism.texture)


def _sides(prism: Silhouette, pixels: antialiasing.Rays, shift: Array) -> tuple[Pair, Pair]:
    """s of the sides by which rays enter and leave, were the prism endless upward and downward.

    The rays are those through the middle of what is covered of a pixel, `shift` to the right of its own.
    """
    x, y = pixels.d[0] + shift * pixels.turn[0], pixels.d[1] + shift * pixels.turn[1]
    c, s = prism.axis
    along, aside = c * x + s * y, c * y - s * x
    near_x, far_x, between_x = _faces(prism.ahead[0], prism.behind[0], along)
    near_y, far_y, between_y = _faces(prism.ahead[1], prism.behind[1], aside)
    # A box is entered by the last of its near faces and left by the first of its far ones.
    none = jnp.where(between_x, _OPEN, 0.0) - jnp.where(between_y, _OPEN, 0.0)
    near = choose(near_x * along + none < near_y * aside, (near_x * c, near_x * s), (-near_y * s, near_y * c))
    far = choose(far_x * along > far_y * aside, (far_x * c, far_x * s), (-far_y * s, far_y * c))
    near_round, far_round = _round_sides(prism, x, y, pixels.slant.p)
    is_round = prism.radius_square > 0
    return choose(is_round, near_round, near), choose(is_round, far_round, far)


def _faces(ahead: Array, behind: Array, along: Array) -> tuple[Array, Array, Array]:
    """1/distance, along an axis, of a box's near and far face, and whether the eye is between: then both are far."""
    beyond_ahead, between = ahead < 0, (ahead > 0) & (behind < 0)
    far = jnp.where(beyond_ahead, behind, ahead)
    far_behind = jnp.where(between, behind, far)
    return jnp.where(beyond_ahead, ahead, behind), jnp.where(along > 0, far, far_behind), between


def _round_sides(prism: Silhouette, x: Array, y: Array, width: Array) -> tuple[Pair, Pair]:
    """s of the planes that touch a cylinder where a ray enters and leaves it: o/c +- ((d.o) o/c - d)/q.

    q^2 = (d.o)^2 - c d^2, taken as r^2 d^2 - (o x d)^2, which keeps its digits, and not let below what it is a tenth
    of a pixel inside the limb, where the side turns away without end.
    """
    (o_x, o_y), power = prism.centre, prism.power
    p_x, p_y = o_x * power, o_y * power
    moment = o_x * y - o_y * x
    q_square = prism.radius_square * (x * x + y * y) - moment * moment
    inverse = lax.rsqrt(maximum(q_square, 0.2 * prism.limb * width + 1e-12))
    b = o_x * x + o_y * y
    e_x, e_y = (b * p_x - x) * inverse, (b * p_y - y) * inverse
    return (p_x + e_x, p_y + e_y), (p_x - e_x, p_y - e_y)


class _Room(NamedTuple):
    """Walls, floor and sky of every pixel: two layers, and what is behind."""

    first: Layer
    second: Layer
    behind_one: Array
    """Grey behind both layers, where at most one prism is before them."""
    behind_two: Array
    """Mean grey behind the first layer, if two prisms are."""
    behind_three: Array
    """Mean grey of the room, if three are."""


def _room(arena: Arena, eye: Array, pixels: antialiasing.Rays, keep: Keep) -> _Room:
    """Draw the room without obstacles: wall or floor, whichever has more of the pixel, then what it shares it with."""
    by_x, along_x, along_y = _walls(arena, eye, pixels.d)
    wall_s, other_s = keep((choose(by_x, along_x, along_y), choose(by_x, along_y, along_x)))
    slopes = antialiasing.slopes(wall_s, pixels)
    part, corner_shift = _part_of_nearer(wall_s, other_s, pixels)
    floor, floor_shift = antialiasing.part_below(-eye[2], slopes, pixels)
    below_top, top_shift = antialiasing.part_below(arena.wall_height - eye[2], slopes, pixels)
    sky = 1.0 - below_top
    wall = maximum(1.0 - floor - sky, 0.0)

    rows = texture.prepare(arena.wall_texture)
    x_row, y_row = (choose(pixels.d[i] > 0, _row(rows, 2 * i + 1), _row(rows, 2 * i)) for i in (0, 1))
    wall_row, other_row = choose(by_x, x_row, y_row), choose(by_x, y_row, x_row)
    floor_row = texture.prepare(arena.floor_texture)
    floor_first = floor > 0.5
    # Floor and sky hide nothing.
    nearness = jnp.where(floor_first | (sky > 0.5), 0.0, _BACK * slopes[0])
    on_edge = floor > sky

    down, up = jnp.where(floor_first, 0.5 * (1.0 - floor), -0.5 * floor), 0.5 * sky
    aside = jnp.where(floor_first | on_edge, 0.0, 0.5 * (1.0 - part))
    shift_u, shift_v = (
        down * a + up * b + aside * c for a, b, c in zip(floor_shift, top_shift, corner_shift, strict=True)
    )

    def layer(cover: Array, s: Vector, row: Texture) -> Layer:
        return Layer(nearness, cover, (shift_u, shift_v), s, (-eye[0], -eye[1]), row)

    zero = jnp.zeros_like(part)
    as_floor = layer(jnp.where(floor_first, floor, 1.0), (zero, zero, -1.0 / maximum(eye[2], NEAR)), floor_row)
    as_wall = layer(jnp.where(floor_first, 1.0, jnp.where(on_edge, wall, wall * part)), (*wall_s, zero), wall_row)
    as_other = layer(wall * (1.0 - part) / maximum(1.0 - wall * part, 1e-3), (*other_s, zero), other_row)
    mean = floor * floor_row.brightness + wall * wall_row.brightness + sky * arena.sky
    beside = jnp.where(on_edge, floor_row.brightness, jnp.where(sky > 0, arena.sky, other_row.brightness))
    return _Room(
        first=choose(floor_first, as_floor, as_wall),
        second=choose(floor_first, as_wall, choose(on_edge, as_floor, as_other)),
        behind_one=arena.sky,
        behind_two=jnp.where(floor_first, wall_row.brightness, beside),
        behind_three=mean,
    )


def _walls(arena: Arena, eye: Array, d: Vector) -> tuple[Array, Pair, Pair]:
    """Tell whether a wall in x is met before one in y, and s of both."""
    low, high = eye[:2] - arena.room[0::2], arena.room[1::2] - eye[:2]
    forth, back = 1.0 / maximum(high, NEAR), -1.0 / maximum(low, NEAR)
    s_x, s_y = jnp.where(d[0] > 0, forth[0], back[0]), jnp.where(d[1] > 0, forth[1], back[1])
    zero = jnp.zeros_like(s_x)
    return s_x * d[0] > s_y * d[1], (s_x, zero), (zero, s_y)


def _part_of_nearer(wall: Pair, other: Pair, pixels: antialiasing.Rays) -> tuple[Array, Pair]:
    """Part of a pixel that the nearer of two walls has, the rest being round the corner, and the way to more of it."""
    return antialiasing.part_and_way(antialiasing.slopes((wall[0] - other[0], wall[1] - other[1]), pixels))


def _shade(handedness: Array, eye: Array, pixels: antialiasing.Rays, layer: Layer, bands: int) -> Array:
    """Grey of a layer where the rays meet it, averaged over the pixel."""
    d, s = pixels.d, layer.s
    t = antialiasing.once(1.0 / maximum(s[0] * d[0] + s[1] * d[1] + s[2] * d[2], 1.0 / _FAR))
    scaled = t * layer.texture.frequency

    def step(change: Vector) -> Vector:
        # The hit moves aside with the ray, and along it by the slant of the surface.
        slant = (s[0] * change[0] + s[1] * change[1] + s[2] * change[2]) * t
        x, y, z = (scaled * (change[i] - d[i] * slant) for i in range(3))
        return x, y * handedness, z

    centre_x, centre_y = layer.centre
    f = layer.texture.frequency
    point = (d[0] * t - centre_x) * f, (d[1] * t - centre_y) * f * handedness, (d[2] * t + eye[2]) * f
    across, down = step(pixels.d_u), step(pixels.d_v)
    u, v = layer.shift
    x, y, z = (p + u * a + v * b for p, a, b in zip(point, across, down, strict=True))
    width, height = 1.0 - 2.0 * jnp.abs(u), 1.0 - 2.0 * jnp.abs(v)
    return texture.grey(layer.texture, (x, y, z), _times(width, across), _times(height, down), bands)


def _times(factor: Array, vector: Vector) -> Vector:
    return factor * vector[0], factor * vector[1], factor * vector[2]


def choose(condition: Array, a: Arrays, b: Arrays) -> Arrays:
    """`where` over tuples of arrays."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _row(rows: Texture, i: int) -> Texture:
    return jax.tree.map(lambda a: a[i], rows)
