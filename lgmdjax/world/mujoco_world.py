"""A room in C MuJoCo: obstacles, walls and floor as geoms of an `MjSpec`, with lights and textures.

| group | geoms                                                                  |
| ----- | ---------------------------------------------------------------------- |
| 0     | visual and collision: floor, walls, and obstacles of other shapes      |
| 1     | collision only: the exact box, cylinder or sphere of an obstacle       |
| 4     | visual only: its mesh, which has texture coordinates                   |

Collision geoms have contype `WORLD` and conaffinity `ROBOT`. An obstacle that moves is a mocap body, and
`place_obstacles` sets its position.

In a style with `shapes`, an obstacle that is wide enough (`MIN_HALF_WIDTH`) may become a sphere, a chair of capsules or
a convex rock. The new shape is within the outline of the prism, so that a start that is free in our rooms is free here
too. Walls and obstacles without contrast, as in the trials with a white wall, stay plain.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Array

from lgmdjax.world import arena, meshes, photographs
from lgmdjax.world.arena import Arena
from lgmdjax.world.meshes import Mesh

ROBOT, WORLD = 1, 2  # bits of contype and conaffinity
MIN_HALF_WIDTH = 0.175  # m; a sphere of this radius is as high as the robot (`arena.ROBOT_HEIGHT`)
SEAT_HEIGHT, SLAT_RADIUS, SLAT_SPACING = 0.45, 0.018, 0.09  # m, of a chair
TILES = (0.7, 1.4)  # m, range of the widths of a texture
LAMP, FILL, AMBIENT = 0.5, 0.3, 0.6  # grey of a white surface that faces the lamp, or the light without shadows
SHADOW_MAP = 256  # px over the room; twice as many take twice as long to render
LAMP_DIRECTION, FILL_DIRECTION = (0.45, 0.3, -1.0), (-0.6, -0.5, -0.7)


@dataclass(frozen=True, kw_only=True)
class Style:
    """Appearance of a room, and shapes of its obstacles."""

    photographs: bool = True  # otherwise plain, each surface with its mean grey
    shadows: bool = True  # two lamps, one of which casts shadows; otherwise every surface is equally bright
    shapes: bool = True  # spheres, chairs and rocks among the prisms


PHOTOGRAPHIC = Style()
PLAIN = Style(photographs=False, shadows=False, shapes=False)


class Obstacle(NamedTuple):
    """A prism of a room, as numbers."""

    index: int  # counted over boxes, then cylinders, padding included
    is_box: bool
    centre: np.ndarray
    half_size: np.ndarray
    yaw: float
    bottom: float
    top: float
    texture: np.ndarray  # as in `obstacles.TEXTURE_COLUMNS`
    moves: bool


def add_room(spec: mujoco.MjSpec, room: Arena, style: Style = PHOTOGRAPHIC, seed: int = 0) -> None:
    """Add a room to a model whose floor is the geom "floor"; `seed` chooses textures and shapes."""
    rng = np.random.default_rng(seed)
    room = _on_host(room)
    _light(spec, room, style)
    if style.photographs:
        for name in photographs.NAMES:
            _add_texture(spec, name)
    _add_bounds(spec, room, rng)
    for obstacle in obstacles(room):
        _add_obstacle(spec, obstacle, style, rng)


def obstacles(room: Arena) -> Iterator[Obstacle]:
    """Yield the obstacles of a single room, without padding."""
    index = 0
    for is_box, prisms in ((True, room.boxes), (False, room.cylinders)):
        for row in range(len(prisms.top)):
            if prisms.top[row] > 0:
                moves = bool(np.any(np.asarray(prisms.goal[row]) != np.asarray(prisms.centre[row])))
                yield Obstacle(
                    index, is_box, np.asarray(prisms.centre[row], float), np.asarray(prisms.half_size[row], float),
                    float(prisms.yaw[row]), float(prisms.bottom[row]), float(prisms.top[row]),
                    np.asarray(prisms.texture[row], float), moves,
                )  # fmt: skip
            index += 1


def place_obstacles(model: mujoco.MjModel, data: mujoco.MjData, room: Arena, time: float) -> None:
    """Move each moving obstacle to its position at a time [s]."""
    if model.nmocap:
        for obstacle in obstacles(arena.at_time(room, time)):
            body = model.body(f"obstacle_{obstacle.index}")
            if body.mocapid[0] >= 0:
                data.mocap_pos[body.mocapid[0], :2] = obstacle.centre


def touchable(model: mujoco.MjModel) -> np.ndarray:
    """Return a mask of the geoms of obstacles and walls: everything that the robot can touch except the floor."""
    is_world = (model.geom_contype & WORLD) > 0
    is_world[model.geom("floor").id] = False
    return is_world


def _on_host(room: Arena) -> Arena:
    return jax.tree.map(np.asarray, room)


def _light(spec: mujoco.MjSpec, room: Arena, style: Style) -> None:
    """Set ambient light, lamps, and a sky of uniform grey."""
    for light in list(spec.lights):
        spec.delete(light)
    head, half = spec.visual.headlight, 0.5 * float(np.hypot(*(room.bounds[1::2] - room.bounds[0::2])))
    head.ambient, head.diffuse, head.specular = [AMBIENT if style.shadows else 1.0] * 3, [0.0] * 3, [0.0] * 3
    spec.stat.extent, spec.stat.center = 1.0, [0.0, 0.0, 0.0]
    spec.visual.map.znear, spec.visual.map.zfar, spec.visual.map.shadowclip = 0.004, 60.0, half + 1.0
    quality = spec.visual.quality
    quality.shadowsize, quality.offsamples, quality.numslices, quality.numstacks = SHADOW_MAP, 0, 8, 4
    if style.shadows:
        lamps = ((LAMP_DIRECTION, LAMP, True), (FILL_DIRECTION, FILL, False))
        for direction, grey, casts in lamps:
            middle = -4.0 * np.asarray(direction)
            light = spec.worldbody.add_light(pos=middle, dir=direction, castshadow=casts, diffuse=[grey] * 3)
            light.type, light.ambient, light.specular = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, [0.0] * 3, [0.0] * 3
    grey = [float(room.sky) / 255] * 3
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        width=8, height=48, rgb1=grey, rgb2=grey,
    )  # fmt: skip


def _add_texture(spec: mujoco.MjSpec, name: photographs.TextureName) -> None:
    picture = photographs.load(name)
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    texture.height, texture.width = picture.shape
    texture.data = np.repeat(picture[..., None], 3, axis=-1).tobytes()


def _add_material(
    spec: mujoco.MjSpec, name: str, texture: np.ndarray | Array, rng: np.random.Generator, *, repeat: float = 1.0
) -> None:
    """Add a random photograph as a material, or plain grey if `texture` has no contrast or the style no photographs."""
    brightness, contrast = float(texture[0]), float(texture[1])
    material = spec.add_material(name=name, specular=0.0, shininess=0.0)
    chosen = photographs.NAMES[rng.integers(len(photographs.NAMES))]
    if contrast > 0 and any(each.name == chosen for each in spec.textures):
        names = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
        names[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = chosen
        material.textures, material.texrepeat, material.texuniform = names, [repeat, repeat], repeat != 1
    else:
        material.rgba = [brightness / 255] * 3 + [1.0]


def _add_bounds(spec: mujoco.MjSpec, room: Arena, rng: np.random.Generator) -> None:
    """Add the walls, and give the floor its size and material; planes are seen from inside."""
    x_min, x_max, y_min, y_max = (float(bound) for bound in room.bounds)
    middle, half = (0.5 * (x_min + x_max), 0.5 * (y_min + y_max)), (0.5 * (x_max - x_min), 0.5 * (y_max - y_min))
    floor, height = spec.geom("floor"), 0.5 * float(room.wall_height)
    floor.pos, floor.size, floor.material, floor.group = [*middle, 0.0], [*half, 1.0], "floor", 0
    floor.contype, floor.conaffinity = WORLD, ROBOT
    floor.rgba = spec.default.geom.rgba  # any other colour would replace the material's
    _add_material(spec, "floor", room.floor_texture, rng, repeat=1 / rng.uniform(*TILES))
    walls = (
        ((x_min, middle[1]), half[1], 0.0), ((x_max, middle[1]), half[1], np.pi),
        ((middle[0], y_min), half[0], np.pi / 2), ((middle[0], y_max), half[0], -np.pi / 2),
    )  # fmt: skip
    for index, (position, length, yaw) in enumerate(walls):
        _add_material(spec, f"wall_{index}", room.wall_texture[index], rng, repeat=1 / rng.uniform(*TILES))
        # The plane's own axes: x along the wall, y upward, z into the room.
        inward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        axes = np.column_stack([np.cross([0.0, 0.0, 1.0], inward), [0.0, 0.0, 1.0], inward])
        spec.worldbody.add_geom(
            name=f"wall_{index}", type=mujoco.mjtGeom.mjGEOM_PLANE, pos=[*position, height], quat=_quaternion(axes),
            size=[length, height, 1.0], material=f"wall_{index}", group=0, contype=WORLD, conaffinity=ROBOT,
        )  # fmt: skip


def _add_obstacle(spec: mujoco.MjSpec, obstacle: Obstacle, style: Style, rng: np.random.Generator) -> None:
    """Add one obstacle as a body with its visual and collision geoms."""
    name, tile = f"obstacle_{obstacle.index}", rng.uniform(*TILES)
    half = [np.cos(obstacle.yaw / 2), 0.0, 0.0, np.sin(obstacle.yaw / 2)]
    body = spec.worldbody.add_body(name=name, pos=[*obstacle.centre, 0.0], quat=half, mocap=obstacle.moves)
    _add_material(spec, name, obstacle.texture, rng)
    may_vary = style.shapes and not obstacle.moves and obstacle.bottom <= 0
    if not may_vary or obstacle.half_size.min() < MIN_HALF_WIDTH:
        return _add_prism(spec, body, obstacle, tile, rng)
    SHAPES[rng.integers(len(SHAPES))](spec, body, obstacle, tile, rng)


def _add_prism(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, obstacle: Obstacle, tile: float, _: np.random.Generator
) -> None:
    (a, b), bottom, top = obstacle.half_size, obstacle.bottom, obstacle.top
    middle, half = 0.5 * (bottom + top), 0.5 * (top - bottom)
    if obstacle.is_box:
        kind, size, mesh = mujoco.mjtGeom.mjGEOM_BOX, [a, b, half], meshes.box(obstacle.half_size, bottom, top, tile)
    else:
        kind, size, mesh = mujoco.mjtGeom.mjGEOM_CYLINDER, [a, half, 0.0], meshes.cylinder(a, bottom, top, tile)
    body.add_geom(name=body.name, type=kind, size=size, pos=[0, 0, middle], group=1, contype=WORLD, conaffinity=ROBOT)
    _add_mesh(spec, body, mesh)


def _add_sphere(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, obstacle: Obstacle, tile: float, _: np.random.Generator
) -> None:
    radius = min(float(obstacle.half_size.min()), 0.4)
    sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0, 0], "pos": [0, 0, radius]}
    body.add_geom(name=body.name, group=1, contype=WORLD, conaffinity=ROBOT, **sphere)
    _add_mesh(spec, body, meshes.sphere(radius, tile))


def _add_rock(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, obstacle: Obstacle, tile: float, rng: np.random.Generator
) -> None:
    mesh = meshes.rock(obstacle.half_size, obstacle.top, tile, rng)
    geom = _add_mesh(spec, body, mesh)
    geom.name, geom.group, geom.contype, geom.conaffinity = body.name, 0, WORLD, ROBOT


def _add_chair(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, obstacle: Obstacle, _: float, __: np.random.Generator
) -> None:
    """Add four legs, a seat and a back, all plain capsules."""
    a, b = np.minimum(obstacle.half_size, 0.25) - SLAT_RADIUS
    back = SEAT_HEIGHT + 0.4
    legs = [((x, y, SLAT_RADIUS), (x, y, SEAT_HEIGHT if x > 0 else back)) for x in (-a, a) for y in (-b, b)]
    count = int(2 * a / SLAT_SPACING) + 1
    seat = [((x, -b, SEAT_HEIGHT), (x, b, SEAT_HEIGHT)) for x in np.linspace(-a, a, count)]
    rails = [((-a, -b, z), (-a, b, z)) for z in (back - 0.2, back)]
    grey = [obstacle.texture[0] / 255] * 3 + [1.0]
    for index, (start, end) in enumerate((*legs, *seat, *rails)):
        body.add_geom(
            name=body.name if index == 0 else f"{body.name}_{index}", type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*start, *end], size=[SLAT_RADIUS, 0, 0], rgba=grey, group=0, contype=WORLD, conaffinity=ROBOT,
        )  # fmt: skip


SHAPES: tuple[Callable[[mujoco.MjSpec, mujoco.MjsBody, Obstacle, float, np.random.Generator], None], ...] = (
    _add_prism,
    _add_sphere,
    _add_chair,
    _add_rock,
)


def _add_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, mesh: Mesh) -> mujoco.MjsGeom:
    """Add a mesh as a visual geom, without contacts."""
    spec.add_mesh(
        name=body.name, uservert=mesh.vertices.ravel(), usernormal=mesh.normals.ravel(),
        usertexcoord=mesh.texture.ravel(), userface=mesh.triangles.ravel(),
    )  # fmt: skip
    return body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=body.name, material=body.name, group=4, contype=0, conaffinity=0
    )


def _quaternion(axes: np.ndarray) -> np.ndarray:
    """Return the quaternion of a rotation matrix whose columns are the new axes."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    return quaternion
