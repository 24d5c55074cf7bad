"""Third-person view of a robot in its room through a pinhole camera, rendered without OpenGL.

Room and robot are ray cast separately, the robot only inside a window of the image and with four rays per pixel, and
are combined by depth. Surfaces have the textures that the robot's own eyes see, tinted by kind, under one light from
above. The robot casts a soft shadow straight down.

| symbol | name                                           | unit | where                          |
| ------ | ---------------------------------------------- | ---- | ------------------------------ |
| o, d   | camera position, direction of a ray (forward 1) | m, 1 | x = o + t d                    |
| t      | depth                                          | m    |                                |
| n      | surface normal                                 | 1    |                                |
| l      | direction to the light                         | 1    | grey (ambient + diffuse n . l) |

A prism between the camera and the robot becomes transparent, so that the robot is always in view.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.geometry import rotate
from lgmdjax.world import raycast, texture
from lgmdjax.world.arena import Arena
from lgmdjax.world.obstacles import Prisms, distance_to_boxes, distance_to_cylinders

LIGHT_DIRECTION = (0.36, 0.48, 0.80)
AMBIENT, DIFFUSE = 0.55, 0.55
GLASS_OPACITY, GLASS_COLOUR = 0.18, (0.80, 0.88, 0.95)  # of prisms that would hide the robot
GLASS_START, GLASS_END = 0.35, 0.10  # m from the line of sight, where a prism starts to be and is fully transparent
CLEAR_FRACTION = 0.55  # of the line of sight, from the camera on, along which prisms become transparent
ROOM_LIFT, FLOOR_LIFT = 0.15, 0.45  # how much paler the room is than in the eyes' images, so that the robot stands out
SHADOW_STRENGTH = 0.55  # fraction of the light that a foot on the floor blocks
TINTS = {
    "box": (0.80, 0.93, 1.0),
    "cylinder": (1.0, 0.90, 0.74),
    "wall": (0.97, 0.97, 1.0),
    "floor": (1.0, 0.97, 0.92),
}
SUPERSAMPLING = 2  # rays per pixel along each axis, for the robot
_NOTHING = 1.0e6


@struct.dataclass(kw_only=True)
class Params:
    """Parameters of the pinhole camera: size [px], focal length [px], and the window of the image with the robot."""

    width: int = struct.field(pytree_node=False, default=320)
    height: int = struct.field(pytree_node=False, default=200)
    focal: float = 250.0
    robot_rows: tuple[int, int] = struct.field(pytree_node=False, default=(60, 200))
    robot_columns: tuple[int, int] = struct.field(pytree_node=False, default=(76, 244))


class Viewpoint(NamedTuple):
    """Pose of the third-person camera; the columns of the rotation are its axes (x forward, y left, z up)."""

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]


class RobotCapsules(NamedTuple):
    """The robot as coloured capsules in world coordinates; a sphere has start = end."""

    starts: Float[Array, "n 3"]
    ends: Float[Array, "n 3"]
    radii: Float[Array, " n"]
    colours: Float[Array, "n 3"]  # 0..1


class _Hits(NamedTuple):
    """Depth and index of the first opaque surface along each ray; depth and opacity of the first transparent one."""

    depth: Array
    which: Array  # index: boxes, cylinders, the walls, the floor, in this order
    glass: Array
    opacity: Array


class _Surface(NamedTuple):
    """Depth and colour 0..1 of the surface that each ray hits, and whether it is the floor."""

    depth: Array
    colour: Array
    is_floor: Array


def render_view(
    params: Params, arena: Arena, view: Viewpoint, robot: RobotCapsules, target: Float[Array, "3"]
) -> Float[Array, "height width 3"]:
    """Render robot and room as RGB 0..1; `target` [m] is the point on the robot that nothing hides.

    Gradient: not useful, since edges are hard.
    """
    solid, glass = _cast_room(params, arena, view, target)
    rows, columns = slice(*params.robot_rows), slice(*params.robot_columns)
    window = _Surface(*(part[rows, columns] for part in solid))
    colour = solid.colour.at[rows, columns].set(_render_robot(params, view, robot, window))
    glass_colour = jnp.asarray(GLASS_COLOUR, dtype=colour.dtype)
    return jnp.clip(colour + glass[..., None] * (glass_colour - colour), 0.0, 1.0)


def ray_directions(
    params: Params, rotation: Float[Array, "3 3"], samples: int = 1, *, window: bool = False
) -> Float[Array, "rows columns 3"]:
    """Return the directions of the rays, `samples` x `samples` per pixel, of the image or of the robot's window."""
    rows, columns = (params.robot_rows, params.robot_columns) if window else ((0, params.height), (0, params.width))

    def offsets(low: int, high: int, size: int) -> Array:
        steps = jnp.arange(samples * (high - low), dtype=rotation.dtype)
        return (low + (steps + 0.5) / samples - size / 2) / params.focal

    down, across = offsets(*rows, params.height), offsets(*columns, params.width)
    return rotation[:, 0] - across[None, :, None] * rotation[:, 1] - down[:, None, None] * rotation[:, 2]


def _cast_room(params: Params, arena: Arena, view: Viewpoint, target: Array) -> tuple[_Surface, Array]:
    """Cast the room; return its opaque surface and the opacity of the nearest transparent prism before it (0: none)."""
    o, d = view.position, ray_directions(params, view.rotation)
    boxes, cylinders = arena.boxes.yaw.shape[0], arena.cylinders.yaw.shape[0]
    opacities = _prism_opacity(arena, o, target)
    rest = jnp.stack([raycast.to_walls(arena, o, d), raycast.to_floor(o, d)], axis=-1)
    hits = _Hits(
        depth=jnp.min(rest, axis=-1),
        which=boxes + cylinders + jnp.argmin(rest, axis=-1).astype(jnp.int32),
        glass=jnp.full_like(rest[..., 0], jnp.inf),
        opacity=jnp.zeros_like(rest[..., 0]),
    )
    kinds = (raycast.to_boxes, arena.boxes, 0), (raycast.to_cylinders, arena.cylinders, boxes)
    for cast, prisms, first in kinds:
        # One prism after another: if all were cast at once, XLA would repeat it for every use of the depths.
        def nearer(hits: _Hits, one: tuple[Prisms, Array, Array], cast=cast) -> tuple[_Hits, None]:
            prism, index, opacity = one
            t = cast(jax.tree.map(lambda leaf: leaf[None], prism), o, d)[..., 0]
            solid, glass = (opacity == 1) & (t < hits.depth), (opacity < 1) & (t < hits.glass)
            return _Hits(
                depth=jnp.where(solid, t, hits.depth),
                which=jnp.where(solid, index, hits.which),
                glass=jnp.where(glass, t, hits.glass),
                opacity=jnp.where(glass, opacity, hits.opacity),
            ), None

        indices = jnp.arange(first, first + prisms.yaw.shape[0], dtype=jnp.int32)
        hits, _ = jax.lax.scan(nearer, hits, (prisms, indices, opacities[indices]))
    surface = _shade(params, arena, view, d, hits)
    return surface, jnp.where(hits.glass < surface.depth, hits.opacity, 0.0)


def _prism_opacity(arena: Arena, o: Array, target: Array) -> Array:
    """Return the opacity of each prism: 1, but less near the line from the camera to the robot."""
    # The line ends before the robot: a prism beside the robot or behind it hides nothing.
    line = o[None, :2], (o + CLEAR_FRACTION * (target - o))[None, :2]
    near = jnp.concatenate([distance_to_boxes(arena.boxes, *line)[0], distance_to_cylinders(arena.cylinders, *line)[0]])
    fraction = jnp.clip((near - GLASS_END) / (GLASS_START - GLASS_END), 0.0, 1.0)
    return GLASS_OPACITY + (1 - GLASS_OPACITY) * fraction


def _shade(params: Params, arena: Arena, view: Viewpoint, d: Array, hits: _Hits) -> _Surface:
    """Shade the opaque surfaces that the rays hit."""
    is_hit, which = jnp.isfinite(hits.depth), hits.which
    depth = jnp.where(is_hit, hits.depth, _NOTHING)
    p = view.position + depth[..., None] * d
    prisms = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), arena.boxes, arena.cylinders)
    count, boxes = prisms.yaw.shape[0], arena.boxes.yaw.shape[0]
    normal, point, row = _faces(arena, prisms, p, which, boxes)
    across, down = (_hit_shift(step, d, normal, depth) for step in (-view.rotation[:, 1], -view.rotation[:, 2]))
    yaw = jnp.asarray(jnp.where(which < count, -prisms.yaw[jnp.minimum(which, count - 1)], 0.0))
    prepared = texture.prepare(row)
    vectors = (point, *(_rotate_xy(step / params.focal, yaw) for step in (across, down)))
    waves = (_components(vector * prepared.frequency[..., None], arena.handedness) for vector in vectors)
    grey = texture.grey_level(prepared, *waves, bands=len(texture.WAVES)) / 255.0
    kinds = ["box"] * boxes + ["cylinder"] * (count - boxes) + ["wall", "floor"]
    tints = jnp.asarray([TINTS[kind] for kind in kinds])
    light = AMBIENT + DIFFUSE * jnp.maximum(normal @ jnp.asarray(LIGHT_DIRECTION, dtype=d.dtype), 0.0)
    # Less light reaches the lower edge of a surface that stands on the floor.
    on_floor = which == count + 1
    corner = jnp.where(on_floor, 1.0, 1.0 - 0.35 * jnp.exp(-jnp.maximum(p[..., 2], 0.0) / 0.10))
    lift = jnp.where(on_floor, FLOOR_LIFT, ROOM_LIFT)
    colour = ((lift + (1 - lift) * grey) * light * corner)[..., None] * tints[which].astype(d.dtype)
    sky = (arena.sky / 255.0) * jnp.ones(3, dtype=d.dtype)
    return _Surface(depth, jnp.where(is_hit[..., None], colour, sky), is_hit & on_floor)


def _faces(arena: Arena, prisms: Prisms, p: Array, which: Array, boxes: int) -> tuple[Array, Array, Array]:
    """Return normals, points in the frames of the textures, and texture rows of the hits."""
    count = prisms.yaw.shape[0]
    index = jnp.minimum(which, count - 1)
    centre, half, yaw = prisms.centre[index], prisms.half_size[index], prisms.yaw[index]
    local = rotate(p[..., :2] - centre, -yaw)
    z_range = prisms.bottom[index], prisms.top[index]
    n_prism = _prism_normal(local, half, p[..., 2], z_range, index < boxes)
    n_prism = jnp.concatenate([rotate(n_prism[..., :2], yaw), n_prism[..., 2:]], axis=-1)
    x_min, x_max, y_min, y_max = arena.bounds
    gaps = jnp.stack([p[..., 0] - x_min, x_max - p[..., 0], p[..., 1] - y_min, y_max - p[..., 1]], axis=-1)
    wall = jnp.argmin(jnp.abs(gaps), axis=-1)
    inward = jnp.asarray([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]], dtype=p.dtype)
    is_prism, is_wall = (which < count)[..., None], (which == count)[..., None]
    up = jnp.asarray([0.0, 0.0, 1.0], dtype=p.dtype)
    normal = jnp.where(is_prism, n_prism, jnp.where(is_wall, inward[wall], up))
    point = jnp.where(is_prism, jnp.concatenate([local, p[..., 2:]], axis=-1), p)
    row = jnp.where(is_wall, arena.wall_texture[wall], arena.floor_texture)
    return normal, point, jnp.where(is_prism, prisms.texture[index], row)


def _prism_normal(local: Array, half: Array, z: Array, z_range: tuple[Array, Array], is_box: Array) -> Array:
    """Return the normal, in the prism's frame, of the face nearest to a point on the prism."""
    bottom, top = z_range
    radius = jnp.sqrt(jnp.maximum(jnp.sum(local * local, axis=-1), 1e-12))
    gap_x, gap_y = (jnp.abs(half[..., i] - jnp.abs(local[..., i])) for i in (0, 1))
    gap_side = jnp.where(is_box, jnp.minimum(gap_x, gap_y), jnp.abs(half[..., 0] - radius))
    on_lid = jnp.minimum(jnp.abs(z - top), jnp.abs(z - bottom)) < gap_side
    along_x, zero = (gap_x < gap_y)[..., None], jnp.zeros_like(z)
    side_x = jnp.stack([jnp.sign(local[..., 0]), zero], axis=-1)
    side_y = jnp.stack([zero, jnp.sign(local[..., 1])], axis=-1)
    side = jnp.where(is_box[..., None], jnp.where(along_x, side_x, side_y), local / radius[..., None])
    lid = jnp.where(jnp.abs(z - top) < jnp.abs(z - bottom), 1.0, -1.0)
    return jnp.concatenate([jnp.where(on_lid[..., None], 0.0, side), jnp.where(on_lid, lid, 0.0)[..., None]], axis=-1)


def _hit_shift(step: Array, d: Array, normal: Array, depth: Array) -> Array:
    """Return the shift of the point hit on a plane when the ray's direction changes by `step`."""
    facing = jnp.sum(normal * d, axis=-1)
    facing = jnp.where(jnp.abs(facing) < 1e-3, -1e-3, facing)
    slide = (normal @ step) / facing
    return depth[..., None] * (step - slide[..., None] * d)


def _rotate_xy(vector: Array, angle: Array) -> Array:
    return jnp.concatenate([rotate(vector[..., :2], angle), vector[..., 2:]], axis=-1)


def _components(vector: Array, handedness: Array) -> texture.Vector:
    return vector[..., 0], handedness * vector[..., 1], vector[..., 2]


def _render_robot(params: Params, view: Viewpoint, robot: RobotCapsules, background: _Surface) -> Array:
    """Render the robot over the background in its window, with its shadow on the floor."""
    base = ray_directions(params, view.rotation, window=True)
    light = 1.0 - SHADOW_STRENGTH * _shadow(view.position + background.depth[..., None] * base, robot)
    ground = background.colour * jnp.where(background.is_floor, light, 1.0)[..., None]
    d = ray_directions(params, view.rotation, SUPERSAMPLING, window=True)
    depth, which = _cast_robot(view.position, d, robot)
    is_robot = depth < _supersample(background.depth)
    p = view.position + jnp.where(is_robot, depth, 1.0)[..., None] * d
    start, axis = robot.starts[which], (robot.ends - robot.starts)[which]
    square = jnp.sum(axis * axis, axis=-1)
    fraction = jnp.sum((p - start) * axis, axis=-1) / jnp.where(square > 0, square, 1.0)
    outward = p - start - jnp.clip(fraction, 0.0, 1.0)[..., None] * axis
    n = outward / jnp.maximum(jnp.linalg.norm(outward, axis=-1, keepdims=True), 1e-6)
    colour = robot.colours[which] * _diffuse(n)[..., None] + _specular(n, d)[..., None]
    mixed = jnp.where(is_robot[..., None], colour, _supersample(ground))
    rows, columns = base.shape[:2]
    return jnp.mean(mixed.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3), axis=(1, 3))


def _cast_robot(o: Array, d: Array, robot: RobotCapsules) -> tuple[Array, Array]:
    """Return depth and index of the first capsule along each ray.

    One capsule after another: if all were cast at once, XLA would repeat it for every use of the depths.
    """

    def nearer(best: tuple[Array, Array], capsule: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
        depth, which = best
        index, *ends_and_radius = (leaf[None] for leaf in capsule)
        t = raycast.to_capsules(o, d, *ends_and_radius)[..., 0]
        return (jnp.minimum(t, depth), jnp.where(t < depth, index, which)), None

    none = jnp.full(d.shape[:-1], jnp.inf, dtype=d.dtype), jnp.zeros(d.shape[:-1], dtype=jnp.int32)
    capsules = jnp.arange(len(robot.radii), dtype=jnp.int32), robot.starts, robot.ends, robot.radii
    return jax.lax.scan(nearer, none, capsules)[0]


def _diffuse(n: Array) -> Array:
    """Return the light that a matt surface reflects: from the lamp, from the sky, and a little from the floor."""
    lamp = jnp.maximum(n @ jnp.asarray(LIGHT_DIRECTION, dtype=n.dtype), 0.0)
    return 0.42 + 0.68 * lamp + 0.18 * n[..., 2]


def _specular(n: Array, d: Array) -> Array:
    """Return the specular highlight (Blinn 1977), which makes the limbs look round."""
    view = -d / jnp.linalg.norm(d, axis=-1, keepdims=True)
    halfway = view + jnp.asarray(LIGHT_DIRECTION, dtype=n.dtype)
    halfway = halfway / jnp.linalg.norm(halfway, axis=-1, keepdims=True)
    return 0.22 * jnp.maximum(jnp.sum(n * halfway, axis=-1), 0.0) ** 24


def _shadow(floor: Array, robot: RobotCapsules) -> Array:
    """Return the fraction of the light that the robot blocks at points of the floor, less from higher parts."""
    p, q = robot.starts[:, :2], robot.ends[:, :2]
    axis = q - p
    square = jnp.sum(axis * axis, axis=-1)
    to = floor[..., None, :2] - p
    fraction = jnp.clip(jnp.sum(to * axis, axis=-1) / jnp.where(square > 0, square, 1.0), 0.0, 1.0)
    height = robot.starts[:, 2] + fraction * (robot.ends - robot.starts)[:, 2] - robot.radii
    gap = jnp.linalg.norm(to - fraction[..., None] * axis, axis=-1)
    blur = 0.02 + 0.35 * jnp.maximum(height, 0.0)
    dark = jnp.clip(1.0 - (gap - robot.radii + blur / 2) / blur, 0.0, 1.0)
    return jnp.max(dark * 0.025 / (0.025 + 0.3 * jnp.maximum(height, 0.0)), axis=-1)


def _supersample(pixels: Array) -> Array:
    return jnp.repeat(jnp.repeat(pixels, SUPERSAMPLING, axis=0), SUPERSAMPLING, axis=1)
