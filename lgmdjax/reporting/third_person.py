"""The robot in its room, seen from outside through a pinhole: for films, on a machine without OpenGL.

Room and robot are cast separately, the robot only inside a window of the picture and with four rays a pixel,
and put together by depth. Surfaces wear the textures that the robot's own eyes see, tinted by kind, under one
light from above; the robot throws a soft shadow straight down.

| symbol | name                                                  | unit | where                          |
| ------ | ----------------------------------------------------- | ---- | ------------------------------ |
| o, d   | eye, direction of a ray (its forward part is 1)       | m, 1 | x = o + t d                    |
| t      | depth                                                 | m    |                                |
| n      | normal of what is hit                                 | 1    |                                |
| l      | direction to the light                                | 1    | grey (ambient + diffuse n . l) |

A prism that comes between the eye and the robot turns to glass, so that the robot is always in view.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.world import raycast, texture
from lgmdjax.world.arena import Arena
from lgmdjax.world.obstacles import Prisms, distance_to_boxes, distance_to_cylinders, turned

LIGHT = (0.36, 0.48, 0.80)
AMBIENT, DIFFUSE = 0.55, 0.55
GLASS, PANE = 0.18, (0.80, 0.88, 0.95)  # opacity and colour of what hides the robot
LIFT, LIFT_FLOOR = (
    0.15,
    0.45,
)  # how much paler than to the robot's eyes the room is drawn, for it to stand out
GLASS_FROM, GLASS_TO = 0.35, 0.10  # m from the line of sight, where it begins to and has become
CLEAR = 0.55  # share of the line of sight that is kept clear
SHADOW = 0.55  # of the light that a foot on the floor takes away
TINTS = {
    "box": (0.80, 0.93, 1.0),
    "cylinder": (1.0, 0.90, 0.74),
    "wall": (0.97, 0.97, 1.0),
    "floor": (1.0, 0.97, 0.92),
}
SAMPLES = 2  # rays a pixel in either direction, for the robot
_NOTHING = 1.0e6


@struct.dataclass(kw_only=True)
class Params:
    """The pinhole: size [px], focal length [px], and the rows and columns between which the robot may be."""

    width: int = struct.field(pytree_node=False, default=320)
    height: int = struct.field(pytree_node=False, default=200)
    focal: float = 250.0
    rows: tuple[int, int] = struct.field(pytree_node=False, default=(60, 200))
    columns: tuple[int, int] = struct.field(pytree_node=False, default=(76, 244))


class Body(NamedTuple):
    """The robot as coloured capsules in the world; a sphere has start = end."""

    starts: Float[Array, "n 3"]
    ends: Float[Array, "n 3"]
    radii: Float[Array, " n"]
    colours: Float[Array, "n 3"]  # 0..1


class _Hits(NamedTuple):
    """The first solid thing along each ray and which it is, and the first glass and how opaque that is."""

    depth: Array
    which: Array  # boxes, cylinders, the walls, the floor, counted in this order
    glass: Array
    opacity: Array


class _Surface(NamedTuple):
    """What each ray hits: depth, colour 0..1, and whether it is the floor."""

    depth: Array
    colour: Array
    floor: Array


def picture(
    params: Params,
    arena: Arena,
    eye: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    body: Body,
    target: Float[Array, "3"],
) -> Float[Array, "height width 3"]:
    """Draw robot and room in RGB 0..1 from an eye (x forward, y left, z up), with `target` always in view.

    Gradient: not meant for it; edges are hard.
    """
    solid, glass = _cast_room(params, arena, eye, rotation, target)
    rows, columns = slice(*params.rows), slice(*params.columns)
    inside = _Surface(*(part[rows, columns] for part in solid))
    robot = _draw_robot(params, eye, rotation, body, inside)
    colour = solid.colour.at[rows, columns].set(robot)
    pane = jnp.asarray(PANE, dtype=colour.dtype)
    return jnp.clip(colour + glass[..., None] * (pane - colour), 0.0, 1.0)


def directions(
    params: Params, rotation: Float[Array, "3 3"], samples: int = 1, *, window: bool = False
) -> Float[Array, "rows columns 3"]:
    """List the rays' directions, `samples` by `samples` a pixel, of the picture or of the robot's window."""
    rows, columns = (params.rows, params.columns) if window else ((0, params.height), (0, params.width))

    def offsets(low: int, high: int, size: int) -> Array:
        steps = jnp.arange(samples * (high - low), dtype=rotation.dtype)
        return (low + (steps + 0.5) / samples - size / 2) / params.focal

    down, across = offsets(*rows, params.height), offsets(*columns, params.width)
    return rotation[:, 0] - across[None, :, None] * rotation[:, 1] - down[:, None, None] * rotation[:, 2]


def _cast_room(params: Params, arena: Arena, eye: Array, rotation: Array, target: Array) -> tuple[_Surface, Array]:
    """Cast the room: its solid surface, and how opaque the nearest glass before it is (0: none)."""
    d = directions(params, rotation)
    boxes, cylinders = arena.boxes.yaw.shape[0], arena.cylinders.yaw.shape[0]
    glassy = _opacity(arena, eye, target)
    rest = jnp.stack([raycast.to_walls(arena, eye, d), raycast.to_floor(eye, d)], axis=-1)
    hits = _Hits(
        depth=jnp.min(rest, axis=-1),
        which=boxes + cylinders + jnp.argmin(rest, axis=-1).astype(jnp.int32),
        glass=jnp.full_like(rest[..., 0], jnp.inf),
        opacity=jnp.zeros_like(rest[..., 0]),
    )
    kinds = (raycast.to_boxes, arena.boxes, 0), (raycast.to_cylinders, arena.cylinders, boxes)
    for cast, prisms, first in kinds:
        # One prism after another: all at once, XLA would cast them again for every use of the depths.
        def nearer(hits: _Hits, one: tuple[Prisms, Array, Array], cast=cast) -> tuple[_Hits, None]:
            prism, index, opacity = one
            t = cast(jax.tree.map(lambda leaf: leaf[None], prism), eye, d)[..., 0]
            solid, glass = (opacity == 1) & (t < hits.depth), (opacity < 1) & (t < hits.glass)
            return _Hits(
                depth=jnp.where(solid, t, hits.depth),
                which=jnp.where(solid, index, hits.which),
                glass=jnp.where(glass, t, hits.glass),
                opacity=jnp.where(glass, opacity, hits.opacity),
            ), None

        indices = jnp.arange(first, first + prisms.yaw.shape[0], dtype=jnp.int32)
        hits, _ = jax.lax.scan(nearer, hits, (prisms, indices, glassy[indices]))
    surface = _shade(params, arena, eye, rotation, d, hits.depth, hits.which)
    return surface, jnp.where(hits.glass < surface.depth, hits.opacity, 0.0)


def _opacity(arena: Arena, eye: Array, target: Array) -> Array:
    """How solid each prism is drawn: 1, but less near the line from the eye to the robot."""
    # The line ends short of the robot: what stands beside or before it hides nothing.
    line = eye[None, :2], (eye + CLEAR * (target - eye))[None, :2]
    near = jnp.concatenate([distance_to_boxes(arena.boxes, *line)[0], distance_to_cylinders(arena.cylinders, *line)[0]])
    share = jnp.clip((near - GLASS_TO) / (GLASS_FROM - GLASS_TO), 0.0, 1.0)
    return GLASS + (1 - GLASS) * share


def _shade(params: Params, arena: Arena, eye: Array, rotation: Array, d: Array, depth: Array, which: Array) -> _Surface:
    """Colour what the rays hit."""
    hit = jnp.isfinite(depth)
    depth = jnp.where(hit, depth, _NOTHING)
    p = eye + depth[..., None] * d
    prisms = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), arena.boxes, arena.cylinders)
    count, boxes = prisms.yaw.shape[0], arena.boxes.yaw.shape[0]
    normal, point, row = _faces(arena, prisms, p, which, boxes)
    across, down = (_moved(step, d, normal, depth) for step in (-rotation[:, 1], -rotation[:, 2]))
    turn = jnp.asarray(jnp.where(which < count, -prisms.yaw[jnp.minimum(which, count - 1)], 0.0))
    worn = texture.prepare(row)
    where = (point, *(_turned_flat(step / params.focal, turn) for step in (across, down)))
    in_waves = (_components(vector * worn.frequency[..., None], arena.handedness) for vector in where)
    grey = texture.grey(worn, *in_waves, bands=len(texture.WAVES)) / 255.0
    kinds = ["box"] * boxes + ["cylinder"] * (count - boxes) + ["wall", "floor"]
    tints = jnp.asarray([TINTS[kind] for kind in kinds])
    light = AMBIENT + DIFFUSE * jnp.maximum(normal @ jnp.asarray(LIGHT, dtype=d.dtype), 0.0)
    # Where things meet the floor less light comes in.
    on_floor = which == count + 1
    corner = jnp.where(on_floor, 1.0, 1.0 - 0.35 * jnp.exp(-jnp.maximum(p[..., 2], 0.0) / 0.10))
    lift = jnp.where(on_floor, LIFT_FLOOR, LIFT)
    colour = ((lift + (1 - lift) * grey) * light * corner)[..., None] * tints[which].astype(d.dtype)
    sky = (arena.sky / 255.0) * jnp.ones(3, dtype=d.dtype)
    return _Surface(depth, jnp.where(hit[..., None], colour, sky), hit & on_floor)


def _faces(arena: Arena, prisms: Prisms, p: Array, which: Array, boxes: int) -> tuple[Array, Array, Array]:
    """Normals, points in the frames that textures live in, and texture rows of the hits."""
    count = prisms.yaw.shape[0]
    index = jnp.minimum(which, count - 1)
    centre, half, yaw = prisms.centre[index], prisms.half_size[index], prisms.yaw[index]
    local = turned(p[..., :2] - centre, -yaw)
    n_prism = _prism_normal(local, half, p[..., 2], prisms.bottom[index], prisms.top[index], index < boxes)
    n_prism = jnp.concatenate([turned(n_prism[..., :2], yaw), n_prism[..., 2:]], axis=-1)
    x_min, x_max, y_min, y_max = arena.room
    gaps = jnp.stack([p[..., 0] - x_min, x_max - p[..., 0], p[..., 1] - y_min, y_max - p[..., 1]], axis=-1)
    wall = jnp.argmin(jnp.abs(gaps), axis=-1)
    inward = jnp.asarray([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]], dtype=p.dtype)
    is_prism, is_wall = (which < count)[..., None], (which == count)[..., None]
    up = jnp.asarray([0.0, 0.0, 1.0], dtype=p.dtype)
    normal = jnp.where(is_prism, n_prism, jnp.where(is_wall, inward[wall], up))
    point = jnp.where(is_prism, jnp.concatenate([local, p[..., 2:]], axis=-1), p)
    row = jnp.where(is_wall, arena.wall_texture[wall], arena.floor_texture)
    return normal, point, jnp.where(is_prism, prisms.texture[index], row)


def _prism_normal(local: Array, half: Array, z: Array, bottom: Array, top: Array, box: Array) -> Array:
    """Normal, in the prism's frame, of the face that a point lies on: the nearest one."""
    radius = jnp.sqrt(jnp.maximum(jnp.sum(local * local, axis=-1), 1e-12))
    gap_x, gap_y = (jnp.abs(half[..., i] - jnp.abs(local[..., i])) for i in (0, 1))
    gap_side = jnp.where(box, jnp.minimum(gap_x, gap_y), jnp.abs(half[..., 0] - radius))
    on_lid = jnp.minimum(jnp.abs(z - top), jnp.abs(z - bottom)) < gap_side
    along_x, zero = (gap_x < gap_y)[..., None], jnp.zeros_like(z)
    side_x = jnp.stack([jnp.sign(local[..., 0]), zero], axis=-1)
    side_y = jnp.stack([zero, jnp.sign(local[..., 1])], axis=-1)
    side = jnp.where(box[..., None], jnp.where(along_x, side_x, side_y), local / radius[..., None])
    lid = jnp.where(jnp.abs(z - top) < jnp.abs(z - bottom), 1.0, -1.0)
    return jnp.concatenate([jnp.where(on_lid[..., None], 0.0, side), jnp.where(on_lid, lid, 0.0)[..., None]], axis=-1)


def _moved(step: Array, d: Array, normal: Array, depth: Array) -> Array:
    """How far the point seen on a plane moves when the ray's direction moves by `step`."""
    facing = jnp.sum(normal * d, axis=-1)
    facing = jnp.where(jnp.abs(facing) < 1e-3, -1e-3, facing)
    slide = (normal @ step) / facing
    return depth[..., None] * (step - slide[..., None] * d)


def _turned_flat(vector: Array, angle: Array) -> Array:
    return jnp.concatenate([turned(vector[..., :2], angle), vector[..., 2:]], axis=-1)


def _components(vector: Array, handedness: Array) -> texture.Vector:
    return vector[..., 0], handedness * vector[..., 1], vector[..., 2]


def _draw_robot(params: Params, eye: Array, rotation: Array, body: Body, behind: _Surface) -> Array:
    """Draw the robot over what is behind it in its window, with its shadow on the floor."""
    base = directions(params, rotation, window=True)
    shade = 1.0 - SHADOW * _shadow(eye + behind.depth[..., None] * base, body)
    ground = behind.colour * jnp.where(behind.floor, shade, 1.0)[..., None]
    d = directions(params, rotation, SAMPLES, window=True)
    depth, which = _cast_robot(eye, d, body)
    seen = depth < _repeat(behind.depth)
    p = eye + jnp.where(seen, depth, 1.0)[..., None] * d
    start, along = body.starts[which], (body.ends - body.starts)[which]
    square = jnp.sum(along * along, axis=-1)
    share = jnp.sum((p - start) * along, axis=-1) / jnp.where(square > 0, square, 1.0)
    outward = p - start - jnp.clip(share, 0.0, 1.0)[..., None] * along
    n = outward / jnp.maximum(jnp.linalg.norm(outward, axis=-1, keepdims=True), 1e-6)
    colour = body.colours[which] * _glow(n, d)[..., None] + _shine(n, d)[..., None]
    mixed = jnp.where(seen[..., None], colour, _repeat(ground))
    rows, columns = base.shape[:2]
    return jnp.mean(mixed.reshape(rows, SAMPLES, columns, SAMPLES, 3), axis=(1, 3))


def _cast_robot(eye: Array, d: Array, body: Body) -> tuple[Array, Array]:
    """Find the depth of the first capsule along each ray, and which it is.

    One capsule after another: all at once, XLA would cast them again for every use of the depths.
    """

    def nearer(best: tuple[Array, Array], capsule: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
        depth, which = best
        index, *ends_and_radius = (leaf[None] for leaf in capsule)
        t = raycast.to_capsules(eye, d, *ends_and_radius)[..., 0]
        return (jnp.minimum(t, depth), jnp.where(t < depth, index, which)), None

    none = jnp.full(d.shape[:-1], jnp.inf, dtype=d.dtype), jnp.zeros(d.shape[:-1], dtype=jnp.int32)
    capsules = jnp.arange(len(body.radii), dtype=jnp.int32), body.starts, body.ends, body.radii
    return jax.lax.scan(nearer, none, capsules)[0]


def _glow(n: Array, d: Array) -> Array:
    """Light that a matt surface gives back: from the lamp, from the sky, and a little from the floor."""
    lamp = jnp.maximum(n @ jnp.asarray(LIGHT, dtype=n.dtype), 0.0)
    return 0.42 + 0.68 * lamp + 0.18 * n[..., 2]


def _shine(n: Array, d: Array) -> Array:
    """A highlight (Blinn's), so that the limbs look round."""
    view = -d / jnp.linalg.norm(d, axis=-1, keepdims=True)
    halfway = view + jnp.asarray(LIGHT, dtype=n.dtype)
    halfway = halfway / jnp.linalg.norm(halfway, axis=-1, keepdims=True)
    return 0.22 * jnp.maximum(jnp.sum(n * halfway, axis=-1), 0.0) ** 24


def _shadow(floor: Array, body: Body) -> Array:
    """How much of the light the robot keeps off points of the floor, 0..1: less from higher parts."""
    p, q = body.starts[:, :2], body.ends[:, :2]
    along = q - p
    square = jnp.sum(along * along, axis=-1)
    to = floor[..., None, :2] - p
    share = jnp.clip(jnp.sum(to * along, axis=-1) / jnp.where(square > 0, square, 1.0), 0.0, 1.0)
    height = body.starts[:, 2] + share * (body.ends - body.starts)[:, 2] - body.radii
    gap = jnp.linalg.norm(to - share[..., None] * along, axis=-1)
    blur = 0.02 + 0.35 * jnp.maximum(height, 0.0)
    dark = jnp.clip(1.0 - (gap - body.radii + blur / 2) / blur, 0.0, 1.0)
    return jnp.max(dark * 0.025 / (0.025 + 0.3 * jnp.maximum(height, 0.0)), axis=-1)


def _repeat(pixels: Array) -> Array:
    return jnp.repeat(jnp.repeat(pixels, SAMPLES, axis=0), SAMPLES, axis=1)
