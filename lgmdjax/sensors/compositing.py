"""Compositing: blend the surfaces in front of each pixel, nearest first, by coverage and grey level.

Everything here is elementwise over rays, so that XLA compiles it to one vectorised loop. Components of vectors are
separate arrays for the same reason.

| symbol | name                                      | unit | where          |
| ------ | ----------------------------------------- | ---- | -------------- |
| d      | direction of a ray in the world           | 1    | `antialiasing` |
| s      | surface as inverse depth, 1/t = s . d     | 1/m  | `silhouettes`  |
| a      | coverage: part of a pixel that is covered | 1    | `antialiasing` |
"""

import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from lgmdjax.minmax import maximum
from lgmdjax.sensors import antialiasing, fusion
from lgmdjax.sensors.antialiasing import PixelRays
from lgmdjax.sensors.fusion import Tree
from lgmdjax.sensors.silhouettes import MIN_DISTANCE, Pair, Silhouette
from lgmdjax.world import texture
from lgmdjax.world.arena import Arena
from lgmdjax.world.texture import Texture, Vector

_MAX_DEPTH = 1.0e3
"""What is farther away [m] is shaded as if it were at this distance."""
_UNBOUNDED = 1.0e4
"""A margin [px], or an inverse depth [1/m], that means no limit."""
_WALL_BIAS = 0.97
"""Factor on the inverse depth of walls, so that they do not cut off the edge pixels of what touches them."""


class Layer(NamedTuple):
    """A surface in front of each pixel."""

    inverse_depth: Array
    """1/t, by which layers are ordered; -1: no surface."""
    coverage: Array
    """a."""
    centroid: Pair
    """Columns and rows from the middle of the pixel to the middle of the covered part."""
    s: Vector
    texture_origin: Pair
    """Position of the texture's origin relative to the eye, in plan [m]."""
    texture: Texture


class _FlatLayer(NamedTuple):
    """A layer of uniform grey. The third layer needs no texture: it shows in few pixels."""

    inverse_depth: Array
    coverage: Array
    grey: Array


_Nearest = tuple[Layer, Layer, _FlatLayer]


@runtime_checkable
class _Materialise(Protocol):
    def __call__(self, arrays: Tree, /) -> Tree: ...


class _Strategy(NamedTuple):
    """How to evaluate the image: the loops over prisms and layers, and whether to write intermediates to memory."""

    fold: Callable[[Callable[[_Nearest, Silhouette], _Nearest], _Nearest, list[Silhouette]], _Nearest]
    map: Callable[[Callable[[Layer], Array], list[Layer]], Iterable[Array]]
    materialise: Callable[[Array], _Materialise]


@functools.partial(jax.custom_jvp, nondiff_argnums=(4,))
def composite(arena: Arena, eye: Array, rays: PixelRays, prisms: list[Silhouette], bands: int) -> Array:
    """Blend the two nearest layers of every pixel over the mean grey of the third and of what is behind it.

    Gradient: that of the same function evaluated with `lax.scan` and with materialised intermediates. Unrolled, the
    loops are a single expression that is fastest to evaluate, but its derivative would take minutes to compile. The
    image itself is always that of the unrolled loops.

    Args:
        arena: the room, of which walls, floor and sky are used.
        eye: position [m].
        rays: one per pixel, arrays of shape (tiles, pixels).
        prisms: the prisms of each tile, nearest first, arrays of shape (tiles, 1).
        bands: number of texture scales.
    """
    return _composite(_UNROLLED, arena, eye, rays, prisms, bands=bands)


@composite.defjvp
def _composite_jvp(bands: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    _, tangent = jax.jvp(functools.partial(_composite, _SCANNED, bands=bands), primals, tangents)
    return composite(*primals, bands), tangent


def _composite(
    strategy: _Strategy, arena: Arena, eye: Array, rays: PixelRays, prisms: list[Silhouette], *, bands: int
) -> Array:
    materialise = strategy.materialise(eye)
    rays = materialise(rays)
    room = _room_layers(arena, eye, rays, materialise)
    background = room.first.inverse_depth
    third = _FlatLayer(background, jnp.zeros_like(background), jnp.zeros_like(background))
    nearest = jax.tree.map(lambda a: jnp.broadcast_to(a, background.shape), (room.first, room.second, third))

    def insert(layers: _Nearest, prism: Silhouette) -> _Nearest:
        return _insert(_prism_layer(prism, rays, materialise), *layers)

    def shade(layer: Layer) -> Array:
        return _shade(arena.handedness, eye, rays, layer, bands)

    first, second, third = strategy.fold(insert, nearest, prisms)
    behind_two = jnp.where(second.inverse_depth > background, room.behind_two, room.behind_one)
    rest = jnp.where(third.inverse_depth > background, room.behind_three, behind_two)
    rest = rest + third.coverage * (third.grey - rest)
    # The middle of what the first layer leaves of a pixel is on the opposite side.
    opposite = fusion.fusible(-first.coverage / (1.001 - first.coverage))
    centroid = first.centroid[0] * opposite, first.centroid[1] * opposite
    nearer, farther = strategy.map(shade, [first, second._replace(centroid=centroid)])
    return rest + second.coverage * (1.0 - first.coverage) * (farther - rest) + first.coverage * (nearer - rest)


def _fold_unrolled(
    function: Callable[[_Nearest, Silhouette], _Nearest], layers: _Nearest, prisms: list[Silhouette]
) -> _Nearest:
    return functools.reduce(function, prisms, layers)


def _fold_scanned(
    function: Callable[[_Nearest, Silhouette], _Nearest], layers: _Nearest, prisms: list[Silhouette]
) -> _Nearest:
    """Fold by `lax.scan`, whose backward pass stores nothing but the layers before each prism."""
    body = jax.checkpoint(lambda layers, prism: (function(layers, prism), None))
    return lax.scan(body, layers, _stack(prisms))[0]


def _map_unrolled(function: Callable[[Layer], Array], layers: list[Layer]) -> Iterable[Array]:
    return [function(layer) for layer in layers]


def _map_scanned(function: Callable[[Layer], Array], layers: list[Layer]) -> Iterable[Array]:
    """Map by `lax.scan`, whose backward pass stores nothing."""
    return lax.scan(jax.checkpoint(lambda _, layer: (None, function(layer))), None, _stack(layers))[1]


def _stack(trees: list[Tree]) -> Tree:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _materialise_by(eye: Array) -> _Materialise:
    def materialise(arrays: Tree, /) -> Tree:
        return fusion.materialise(arrays, eye[0])

    return materialise


def _keep_lazy(eye: Array) -> _Materialise:
    def unchanged(arrays: Tree, /) -> Tree:
        return arrays

    return unchanged


_UNROLLED = _Strategy(_fold_unrolled, _map_unrolled, _keep_lazy)
_SCANNED = _Strategy(_fold_scanned, _map_scanned, _materialise_by)


def _insert(layer: Layer, first: Layer, second: Layer, third: _FlatLayer) -> _Nearest:
    """Return the three nearest of four layers, nearest first."""
    is_first, is_second = layer.inverse_depth > first.inverse_depth, layer.inverse_depth > second.inverse_depth
    is_third = layer.inverse_depth > third.inverse_depth
    old_second = tree_where(is_second, _flatten(second), _flatten(layer))
    old_first = tree_where(is_first, first, layer)
    return (
        tree_where(is_first, layer, first),
        tree_where(is_second, old_first, second),
        tree_where(is_third, old_second, third),
    )


def _flatten(layer: Layer) -> _FlatLayer:
    return _FlatLayer(layer.inverse_depth, layer.coverage, layer.texture.brightness)


def _prism_layer(prism: Silhouette, rays: PixelRays, materialise: _Materialise) -> Layer:
    """Return what a prism covers of each pixel, and the face by which it does so."""
    d, (scale_x, scale_y) = rays.d, rays.pixel_scale
    unbounded = (prism.wedge - 0.5) * _UNBOUNDED
    normals = prism.left_normal, prism.right_normal
    margins = materialise([n[0] * scale_x + n[1] * scale_y + unbounded for n in normals])
    left, right = (antialiasing.edge_coverage(margin, rays.upright) for margin in margins)
    by_side = 0.5 * (right - left)
    near, far = materialise(_side_faces(prism, rays, by_side))
    side = antialiasing.inverse_depth(near, rays)
    # From within its plan a prism can be entered by its cap only, and only the cap bounds it.
    within, capless = prism.wedge > 0.75, prism.inverse_cap_z == 0
    last = antialiasing.inverse_depth(tree_where(capless, near, far), rays)
    upward = jnp.where(prism.inverse_cap_z > 0, -1.0, 1.0).astype(prism.inverse_cap_z.dtype)
    cap_margin, cap_direction = antialiasing.margin_below(prism.cap_z, last, rays)
    opposite_margin, opposite_direction = antialiasing.margin_below(prism.opposite_z, side, rays)
    to_cap = antialiasing.linear_coverage(upward * cap_margin + jnp.where(within & capless, _UNBOUNDED, 0.0))
    to_opposite = antialiasing.linear_coverage(jnp.where(within, _UNBOUNDED, 0.0) - upward * opposite_margin)
    by_cap, by_opposite = 0.5 * upward * (1.0 - to_cap), 0.5 * upward * (to_opposite - 1.0)
    centroid_u, centroid_v = (
        by_cap * cap_direction[i] + by_opposite * opposite_direction[i] + by_side * rays.rightward[i] for i in (0, 1)
    )
    coverage = maximum(left + right - 1.0, 0.0) * maximum(to_cap + to_opposite - 1.0, 0.0)
    cap = prism.inverse_cap_z * d[2]
    on_cap = cap < side[0] + jnp.where(capless, -_UNBOUNDED, jnp.where(within, _UNBOUNDED, 0.0))
    s = (jnp.where(on_cap, 0.0, near[0]), jnp.where(on_cap, 0.0, near[1]), jnp.where(on_cap, prism.inverse_cap_z, 0.0))
    inverse_depth = jnp.where(coverage > 0, jnp.where(on_cap, cap, side[0]), -1.0)
    inverse_depth, coverage, centroid, s = materialise((inverse_depth, coverage, (centroid_u, centroid_v), s))
    return Layer(inverse_depth, coverage, centroid, s, prism.centre, prism.texture)


def _side_faces(prism: Silhouette, rays: PixelRays, shift: Array) -> tuple[Pair, Pair]:
    """Return s of the sides by which rays enter and leave a prism of unlimited height.

    The rays are those through the middle of the covered part of a pixel, which is `shift` to the right of its own.
    """
    x, y = rays.d[0] + shift * rays.rightward_d[0], rays.d[1] + shift * rays.rightward_d[1]
    c, s = prism.x_axis
    along, aside = c * x + s * y, c * y - s * x
    near_x, far_x, between_x = _slab_faces(prism.inverse_front[0], prism.inverse_back[0], along)
    near_y, far_y, between_y = _slab_faces(prism.inverse_front[1], prism.inverse_back[1], aside)
    # A ray enters a box by the last of its near faces and leaves it by the first of its far ones.
    no_face = jnp.where(between_x, _UNBOUNDED, 0.0) - jnp.where(between_y, _UNBOUNDED, 0.0)
    near = tree_where(near_x * along + no_face < near_y * aside, (near_x * c, near_x * s), (-near_y * s, near_y * c))
    far = tree_where(far_x * along > far_y * aside, (far_x * c, far_x * s), (-far_y * s, far_y * c))
    near_tangent, far_tangent = _tangent_planes(prism, x, y, rays.upright.p)
    is_cylinder = prism.radius_squared > 0
    return tree_where(is_cylinder, near_tangent, near), tree_where(is_cylinder, far_tangent, far)


def _slab_faces(front: Array, back: Array, along: Array) -> tuple[Array, Array, Array]:
    """Return 1/distance, along an axis, of a box's near and far face, and whether the eye is between the two.

    If it is, both faces count as far.
    """
    beyond_front, between = front < 0, (front > 0) & (back < 0)
    far = jnp.where(beyond_front, back, front)
    far_behind = jnp.where(between, back, far)
    return jnp.where(beyond_front, front, back), jnp.where(along > 0, far, far_behind), between


def _tangent_planes(prism: Silhouette, x: Array, y: Array, width: Array) -> tuple[Pair, Pair]:
    """Return s of the planes that touch a cylinder where a ray enters and leaves it: o/c +- ((d.o) o/c - d)/q.

    q^2 = (d.o)^2 - c d^2 is computed as r^2 d^2 - (o x d)^2, which is more accurate. At the outline q is zero and the
    side turns away without bound, so q^2 is at least its value a tenth of a pixel inside.
    """
    (o_x, o_y), inverse_power = prism.centre, prism.inverse_power
    p_x, p_y = o_x * inverse_power, o_y * inverse_power
    moment = o_x * y - o_y * x
    q_squared = prism.radius_squared * (x * x + y * y) - moment * moment
    inverse = lax.rsqrt(maximum(q_squared, 0.2 * prism.contour_scale * width + 1e-12))
    b = o_x * x + o_y * y
    e_x, e_y = (b * p_x - x) * inverse, (b * p_y - y) * inverse
    return (p_x + e_x, p_y + e_y), (p_x - e_x, p_y - e_y)


class _RoomLayers(NamedTuple):
    """Walls, floor and sky of every pixel: two layers, and what is behind them."""

    first: Layer
    second: Layer
    behind_one: Array
    """Grey behind both layers, with at most one prism in front of them."""
    behind_two: Array
    """Mean grey behind the first layer, with two prisms in front."""
    behind_three: Array
    """Mean grey of the room, with three prisms in front."""


def _room_layers(arena: Arena, eye: Array, rays: PixelRays, materialise: _Materialise) -> _RoomLayers:
    """Return the layers of the empty room: wall or floor, whichever covers more of the pixel, then its neighbour."""
    by_x, along_x, along_y = _wall_faces(arena, eye, rays.d)
    wall_s, other_s = materialise((tree_where(by_x, along_x, along_y), tree_where(by_x, along_y, along_x)))
    wall_depth = antialiasing.inverse_depth(wall_s, rays)
    part, corner_direction = _coverage_of_nearer(wall_s, other_s, rays)
    floor, floor_direction = antialiasing.coverage_below(-eye[2], wall_depth, rays)
    below_top, top_direction = antialiasing.coverage_below(arena.wall_height - eye[2], wall_depth, rays)
    sky = 1.0 - below_top
    wall = maximum(1.0 - floor - sky, 0.0)
    wall_row, other_row, floor_row = _room_textures(arena, rays.d, by_x)

    floor_first = floor > 0.5
    # Floor and sky occlude nothing.
    inverse_depth = jnp.where(floor_first | (sky > 0.5), 0.0, _WALL_BIAS * wall_depth[0])
    on_edge = floor > sky
    down, up = jnp.where(floor_first, 0.5 * (1.0 - floor), -0.5 * floor), 0.5 * sky
    aside = jnp.where(floor_first | on_edge, 0.0, 0.5 * (1.0 - part))
    directions = zip(floor_direction, top_direction, corner_direction, strict=True)
    centroid_u, centroid_v = (down * a + up * b + aside * c for a, b, c in directions)

    def layer(coverage: Array, s: Vector, row: Texture) -> Layer:
        return Layer(inverse_depth, coverage, (centroid_u, centroid_v), s, (-eye[0], -eye[1]), row)

    zero = jnp.zeros_like(part)
    as_floor = layer(jnp.where(floor_first, floor, 1.0), (zero, zero, -1.0 / maximum(eye[2], MIN_DISTANCE)), floor_row)
    as_wall = layer(jnp.where(floor_first, 1.0, jnp.where(on_edge, wall, wall * part)), (*wall_s, zero), wall_row)
    as_other = layer(wall * (1.0 - part) / maximum(1.0 - wall * part, 1e-3), (*other_s, zero), other_row)
    mean = floor * floor_row.brightness + wall * wall_row.brightness + sky * arena.sky
    beside = jnp.where(on_edge, floor_row.brightness, jnp.where(sky > 0, arena.sky, other_row.brightness))
    return _RoomLayers(
        first=tree_where(floor_first, as_floor, as_wall),
        second=tree_where(floor_first, as_wall, tree_where(on_edge, as_floor, as_other)),
        behind_one=arena.sky,
        behind_two=jnp.where(floor_first, wall_row.brightness, beside),
        behind_three=mean,
    )


def _wall_faces(arena: Arena, eye: Array, d: Vector) -> tuple[Array, Pair, Pair]:
    """Return whether a ray meets a wall in x before one in y, and s of both walls."""
    low, high = eye[:2] - arena.bounds[0::2], arena.bounds[1::2] - eye[:2]
    forward, backward = 1.0 / maximum(high, MIN_DISTANCE), -1.0 / maximum(low, MIN_DISTANCE)
    s_x, s_y = jnp.where(d[0] > 0, forward[0], backward[0]), jnp.where(d[1] > 0, forward[1], backward[1])
    zero = jnp.zeros_like(s_x)
    return s_x * d[0] > s_y * d[1], (s_x, zero), (zero, s_y)


def _coverage_of_nearer(wall: Pair, other: Pair, rays: PixelRays) -> tuple[Array, Pair]:
    """Return the part of a pixel that the nearer of two walls covers, and the direction in which it grows.

    The rest of the pixel is beyond the corner.
    """
    return antialiasing.edge_coverage_and_direction(
        antialiasing.inverse_depth((wall[0] - other[0], wall[1] - other[1]), rays)
    )


def _room_textures(arena: Arena, d: Vector, by_x: Array) -> tuple[Texture, Texture, Texture]:
    """Return the textures of the wall that a ray meets, of the other wall, and of the floor."""
    rows = texture.prepare(arena.wall_texture)
    x_row, y_row = (tree_where(d[i] > 0, _row(rows, 2 * i + 1), _row(rows, 2 * i)) for i in (0, 1))
    wall_row, other_row = tree_where(by_x, x_row, y_row), tree_where(by_x, y_row, x_row)
    return wall_row, other_row, texture.prepare(arena.floor_texture)


def _shade(handedness: Array, eye: Array, rays: PixelRays, layer: Layer, bands: int) -> Array:
    """Return the grey of a layer where the rays meet it, averaged over the pixel."""
    d, s = rays.d, layer.s
    t = fusion.fusible(1.0 / maximum(s[0] * d[0] + s[1] * d[1] + s[2] * d[2], 1.0 / _MAX_DEPTH))
    scaled = t * layer.texture.frequency

    def displacement(change: Vector) -> Vector:
        # The hit moves sideways with the ray, and along the ray by the inclination of the surface.
        inclination = (s[0] * change[0] + s[1] * change[1] + s[2] * change[2]) * t
        x, y, z = (scaled * (change[i] - d[i] * inclination) for i in range(3))
        return x, y * handedness, z

    origin_x, origin_y = layer.texture_origin
    f = layer.texture.frequency
    point = (d[0] * t - origin_x) * f, (d[1] * t - origin_y) * f * handedness, (d[2] * t + eye[2]) * f
    across, down = displacement(rays.d_u), displacement(rays.d_v)
    u, v = layer.centroid
    x, y, z = (p + u * a + v * b for p, a, b in zip(point, across, down, strict=True))
    width, height = 1.0 - 2.0 * jnp.abs(u), 1.0 - 2.0 * jnp.abs(v)
    return texture.grey_level(layer.texture, (x, y, z), _scale(width, across), _scale(height, down), bands)


def _scale(factor: Array, vector: Vector) -> Vector:
    return factor * vector[0], factor * vector[1], factor * vector[2]


def tree_where(condition: Array, a: Tree, b: Tree) -> Tree:
    """Apply `jnp.where` to every leaf of two trees of one structure."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _row(rows: Texture, i: int) -> Texture:
    return jax.tree.map(lambda a: a[i], rows)
