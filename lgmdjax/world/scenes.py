"""Rooms to walk in: the paper's training and testing rooms, its real scenes, and random ones without end.

The paper's figure 10 shows its rooms without sizes; these are ours, of the same kind. What sec. 5 says in
words is the paper's: the testing start at (0, 2.5), the tube 1.25 m ahead before a white wall at 3 m, the box
1.2 m ahead with another to the right and a table to the left, trees and bushes before a facade, and obstacles
put in the way from the left and then from the right.

In the rooms two things touch or are at least `GAP` apart, so that there is no doubt whether a robot of
0.45 x 0.40 m fits through; in the scenes they stand as they stand.
Geometry is fixed; a key draws the textures, and in `random_room` everything. All can be traced and mapped.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from lgmdjax.world.arena import Arena, clearance, empty_room
from lgmdjax.world.obstacles import COUNT, Prisms, join, parked, place, turned

GAP = 0.8
"""Least way between obstacles, and about a start [m]: twice the robot's width."""
INDOORS, ANY = 0.12, 0.5
"""Greatest contrast of a floor: in the paper's rooms, and in random ones."""
DRAWS = 128
"""Places that an obstacle of a random room is tried at."""

# x, y, half sizes (a cylinder: radius twice) [m], yaw [deg], height [m].
_TRAINING_BOXES = (
    (2.05, 1.95, 0.30, 0.20, 30.0, 0.8),
    (-2.05, 2.05, 0.25, 0.25, 10.0, 0.6),
    (-2.00, -2.00, 0.35, 0.20, -40.0, 1.0),
    (2.00, -2.05, 0.25, 0.30, 15.0, 0.7),
    (3.30, 0.10, 0.20, 0.50, 0.0, 1.6),
    (0.00, -3.25, 0.60, 0.25, 0.0, 1.2),
    (-0.60, 1.35, 0.20, 0.20, 45.0, 0.5),
)
_TRAINING_CYLINDERS = (
    (0.45, 2.50, 0.15, 0.15, 0.0, 1.2),
    (-0.45, -1.40, 0.20, 0.20, 0.0, 0.9),
    (1.55, -0.35, 0.18, 0.18, 0.0, 0.7),
    (-2.40, 0.15, 0.20, 0.20, 0.0, 1.4),
    (0.72, -1.55, 0.10, 0.10, 0.0, 0.6),
)
_TESTING_BOXES = (
    (2.60, 2.55, 0.25, 0.35, 20.0, 0.9),
    (-2.65, 2.50, 0.30, 0.20, -25.0, 0.7),
    (-2.70, -2.60, 0.25, 0.25, 40.0, 1.1),
    (2.55, -2.65, 0.40, 0.20, 10.0, 0.6),
    (0.10, 0.15, 0.25, 0.20, 35.0, 0.8),
    (3.75, 0.00, 0.25, 0.60, 0.0, 1.7),
    (-3.80, -0.20, 0.20, 0.50, 0.0, 1.5),
    (0.30, -3.80, 0.70, 0.20, 0.0, 1.2),
)
_TESTING_CYLINDERS = (
    (1.50, 1.25, 0.15, 0.15, 0.0, 1.0),
    (-1.45, 1.30, 0.20, 0.20, 0.0, 0.8),
    (-1.40, -0.90, 0.15, 0.15, 0.0, 1.3),
    (1.60, -1.00, 0.20, 0.20, 0.0, 0.6),
    (0.10, -2.05, 0.18, 0.18, 0.0, 0.9),
    (-1.30, -3.00, 0.12, 0.12, 0.0, 1.2),
    (-2.55, 0.20, 0.12, 0.12, 0.0, 0.7),
    (1.25, 2.90, 0.12, 0.12, 0.0, 1.1),
)


def training_room(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build the room to learn in: 7 x 7 m, twelve obstacles."""
    boxes, cylinders = _prisms(_TRAINING_BOXES), _prisms(_TRAINING_CYLINDERS)
    return faded(textured(empty_room((7.0, 7.0), boxes=boxes, cylinders=cylinders), key), contrast)


def testing_room(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build the room to be tested in: 8 x 8 m, sixteen obstacles, start at (0, 2.5) facing them."""
    boxes, cylinders = _prisms(_TESTING_BOXES), _prisms(_TESTING_CYLINDERS)
    arena = empty_room((8.0, 8.0), boxes=boxes, cylinders=cylinders, start=(0.0, 2.5, -0.5 * jnp.pi))
    return faded(textured(arena, key), contrast)


def tube_scene(lateral: ArrayLike = 0.0, key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build fig. 10e: a poster tube at d_x = 1.25 m, d_y = `lateral` [m] before a plain white wall at 3 m."""
    centre = jnp.stack([jnp.asarray(1.25, dtype=float), jnp.asarray(lateral, dtype=float)])
    arena = textured(empty_room((6.0, 6.0), cylinders=place(centre[None], 0.06, 1.0)), key)
    white = jnp.asarray([235.0, 0.0, 0.0, 1.0], dtype=float)
    return faded(dataclasses.replace(arena, wall_texture=arena.wall_texture.at[1].set(white)), contrast)


def indoor_scene(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build fig. 10c: a box whose face is 1.2 m ahead, one to the right, a table to the left."""
    boxes = _prisms(((1.40, 0.00, 0.20, 0.20, 0.0, 0.6), (0.90, -1.35, 0.25, 0.20, 20.0, 0.5)), count=2)
    table = place([[1.10, 1.45]], [0.75, 0.45], 0.74, bottom=0.70, count=COUNT - 2)
    legs = place([[0.40, 1.05], [0.40, 1.85], [1.80, 1.05], [1.80, 1.85]], 0.025, 0.70)
    return faded(textured(empty_room((7.0, 6.0), boxes=join(boxes, table), cylinders=legs), key), contrast)


def outdoor_scene(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build fig. 10d: grass, five trees with crowns, bushes and hedges, the facade of a building behind."""
    trees = [[1.9, 0.1], [3.3, 1.9], [3.0, -2.1], [1.2, 3.0], [0.6, -2.9]]
    trunks = place(trees, [[0.15], [0.20], [0.18], [0.22], [0.14]], 2.2, count=5)
    crowns = place(trees, [[0.8], [1.2], [1.0], [1.1], [0.9]], 4.0, bottom=1.9, count=5)
    bushes = place([[2.1, -1.2], [1.9, 1.5]], [[0.30], [0.35]], [0.6, 0.7], count=COUNT - 10)
    facade = (5.7, 0.0, 0.3, 7.0, 0.0, 7.0)
    hedges = (
        (4.4, 0.0, 0.3, 0.6, 10.0, 0.8),
        (-1.5, 2.3, 0.5, 0.25, 30.0, 0.7),
        (-1.8, -2.0, 0.3, 0.5, 0.0, 0.9),
    )
    cylinders = join(join(trunks, crowns), bushes)
    arena = empty_room((12.0, 14.0), boxes=_prisms((facade, *hedges)), cylinders=cylinders, wall_height=1.0)
    grass, sky = jnp.asarray([95.0, 0.6, 0.0, 0.15], dtype=float), jnp.asarray(240.0, dtype=float)
    return faded(dataclasses.replace(textured(arena, key), floor_texture=grass, sky=sky), contrast)


def dynamic_scene(key: Array | None = None, *, departs: ArrayLike = (10.0, 24.0), contrast: ArrayLike = 1.0) -> Arena:
    """Build the third scene of sec. 5.3: boxes are put in the way from the left, then from the right.

    Each takes 2 s from its `departs` [s]. Walking straight at v = 1.2, the robot has 0.6 m left to the first.
    """
    departs = jnp.asarray(departs, dtype=float)
    ends = {"goal": [[1.5, 0.1], [1.3, -1.2]], "departs": departs, "arrives": departs + 2.0}
    boxes = place([[1.5, 2.3], [1.3, -2.3]], 0.20, 0.8, **ends)
    return faded(textured(empty_room((7.0, 6.0), boxes=boxes), key), contrast)


def random_room(
    key: Array,
    density: ArrayLike = 0.25,
    *,
    contrast: ArrayLike = 1.0,
    gap: float = GAP,
    boxes: int = COUNT,
    cylinders: int = COUNT,
) -> Arena:
    """Draw a room of 6 to 8 m a side with `density` obstacles a square metre, boxes and cylinders in turn.

    They stand at least `gap` [m] apart and from the walls, and `GAP` from the start, so that it is free and
    every other place can be reached. Each is tried at `DRAWS` places or stays parked, and there are at most
    `boxes` and `cylinders` (static): count what stands with `prisms.is_parked`. Rooms fill up at about 0.25.
    """
    room_key, texture_key = jax.random.split(key)
    rounds = max(boxes, cylinders)
    # One call for all, the last row for the room itself: compiling a call takes longer than making it.
    draws = _uniform(room_key, (rounds + 1, 2, 4 + 2 * DRAWS))
    size = 6.0 + 2.0 * draws[-1, 0, :2]
    start = (2.0 * draws[-1, 1, :3] - 1.0) * jnp.append(0.5 * size - GAP, jnp.pi)
    arena = empty_room(size, boxes=parked(boxes), cylinders=parked(cylinders), start=start)
    wanted = jnp.asarray(density, dtype=float) * size[0] * size[1]

    def turn(arena: Arena, row: tuple[Array, Array]) -> tuple[Arena, None]:
        index, draws = row
        before = 2.0 * index.astype(wanted.dtype)
        box, fits = _random_box(draws[0], arena, gap)
        arena = dataclasses.replace(arena, boxes=_put(arena.boxes, index, box, fits & (before < wanted)))
        cylinder, fits = _random_cylinder(draws[1], arena, gap)
        fits = fits & (before + 1.0 < wanted)
        return dataclasses.replace(arena, cylinders=_put(arena.cylinders, index, cylinder, fits)), None

    arena, _ = jax.lax.scan(turn, arena, (jnp.arange(rounds), draws[:-1]))
    return faded(textured(arena, texture_key, floor=ANY), contrast)


def _random_box(draws: Array, arena: Arena, gap: float) -> tuple[Prisms, Bool[Array, ""]]:
    """Make a box and find a place for it; is there one?"""
    width, depth, turn, rise = draws[:4]
    half_size = 0.12 + 0.28 * jnp.stack([width, depth])
    yaw = jnp.pi * (turn - 0.5)
    signs = jnp.asarray([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], dtype=float)
    corners = turned(signs * half_size, yaw)
    centre, fits = _find_place(draws[4:], arena, corners, jnp.zeros_like(yaw), gap)
    return place(centre, half_size, 0.5 + rise, yaw=yaw, count=1), fits


def _random_cylinder(draws: Array, arena: Arena, gap: float) -> tuple[Prisms, Bool[Array, ""]]:
    """Make a cylinder and find a place for it; is there one?"""
    thickness, rise = draws[:2]
    radius = 0.05 + 0.25 * thickness
    centre, fits = _find_place(draws[4:], arena, jnp.zeros((1, 2), dtype=float), radius, gap)
    return place(centre, radius, 0.5 + rise, count=1), fits


def _find_place(
    draws: Array, arena: Arena, corners: Float[Array, "n 2"], radius: Array, gap: float
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Find the first of `DRAWS` places at which a polygon, rounded by `radius`, clears all; is there one?"""
    low, high = arena.room[0::2], arena.room[1::2]
    places = low + draws.reshape(DRAWS, 2) * (high - low)
    p = places[:, None] + corners
    q = places[:, None] + jnp.roll(corners, 1, axis=0)
    radii = jnp.broadcast_to(radius, (DRAWS * len(corners),))
    space = clearance(arena, p.reshape(-1, 2), q.reshape(-1, 2), radii).reshape(DRAWS, -1)
    reach = radius + jnp.max(jnp.linalg.norm(corners, axis=-1))
    from_start = jnp.linalg.norm(places - arena.start[:2], axis=-1) - reach
    free = (jnp.min(space, axis=-1) >= gap) & (from_start >= GAP)
    return places[jnp.argmax(free)], jnp.any(free)


def _put(prisms: Prisms, index: Array, prism: Prisms, stands: Bool[Array, ""]) -> Prisms:
    """Replace row `index`, if there is one, by a single prism if it stands."""
    return jax.tree.map(lambda all, one: jnp.where(stands, all.at[index].set(one[0]), all), prisms, prism)


def textured(arena: Arena, key: Array | None = None, floor: float = INDOORS) -> Arena:
    """Draw textures for everything in a room: busy obstacles and walls, a floor of contrast 0.05 to `floor`.

    The LGMD takes nearness from how much moves, so it is told apart from contrast only where things are about equally
    busy. A floor moves in both eyes alike: it raises u, and hardly touches the difference of the two; but a controller
    that has met plain floors only takes a lawn for a wall on either side. So the random rooms, in which it learns, have
    floors of all kinds, the paper's have those of a laboratory.
    """
    boxes, cylinders = arena.boxes, arena.cylinders
    first, second = boxes.yaw.size, boxes.yaw.size + cylinders.yaw.size
    draws = _uniform(jax.random.key(0) if key is None else key, (second + 6, 4))

    def between(draws: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Float[Array, "... 4"]:
        least, most = jnp.asarray(low, dtype=float), jnp.asarray(high, dtype=float)
        return least + draws * (most - least)

    things = between(draws[:second], (100.0, 0.6, 0.0, 0.15), (160.0, 0.8, 2.0 * jnp.pi, 0.35))
    return dataclasses.replace(
        arena,
        boxes=dataclasses.replace(boxes, texture=things[:first]),
        cylinders=dataclasses.replace(cylinders, texture=things[first:]),
        wall_texture=between(draws[second:-2], (120.0, 0.5, 0.0, 0.3), (170.0, 0.7, 2.0 * jnp.pi, 0.6)),
        floor_texture=between(draws[-2], (110.0, 0.05, 0.0, 0.2), (150.0, floor, 2.0 * jnp.pi, 0.5)),
        sky=200.0 + 50.0 * draws[-1, 0],
    )


def faded(arena: Arena, contrast: ArrayLike) -> Arena:
    """Scale the contrast of every texture in a room: 0 is plain, 1 as it is; clipped to 0..1."""
    factor = jnp.asarray(contrast, dtype=arena.sky.dtype)

    def fade(texture: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
        return texture.at[..., 1].set(jnp.clip(texture[..., 1] * factor, 0.0, 1.0))

    return dataclasses.replace(
        arena,
        boxes=dataclasses.replace(arena.boxes, texture=fade(arena.boxes.texture)),
        cylinders=dataclasses.replace(arena.cylinders, texture=fade(arena.cylinders.texture)),
        wall_texture=fade(arena.wall_texture),
        floor_texture=fade(arena.floor_texture),
    )


def _prisms(rows: tuple[tuple[float, ...], ...], count: int = COUNT) -> Prisms:
    """Set up prisms from rows of x, y, half sizes, yaw in degrees, height."""
    table = jnp.asarray(rows, dtype=float)
    return place(table[:, :2], table[:, 2:4], table[:, 5], yaw=jnp.deg2rad(table[:, 4]), count=count)


def _uniform(key: Array, shape: tuple[int, ...]) -> Array:
    """Draw from 0..1 in float32 and cast, so that a key means the same room at any precision."""
    return jax.random.uniform(key, shape, dtype=jnp.float32).astype(float)
