"""Rooms and scenes: the paper's training and testing rooms, its real scenes, and random rooms.

The paper's figure 10 shows its rooms without sizes; these are rooms of the same kind with our own sizes. The text of
sec. 5 gives the start of the testing room at (0, 2.5), the tube 1.25 m ahead in front of a white wall at 3 m, the box
1.2 m ahead with another to the right and a table to the left, the trees and bushes in front of a facade, and the
obstacles that move into the way from the left and then from the right.

In the rooms two obstacles touch or are at least `MIN_GAP` apart, so that a robot of 0.45 x 0.40 m clearly fits through
or clearly does not. The scenes do not follow this rule.

The geometry of rooms and scenes is fixed, and a key samples their textures. In `random_room` the key samples
everything. All functions can be traced and mapped with `vmap`.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from lgmdjax.geometry import rotate
from lgmdjax.world.arena import Arena, clearance, empty_room
from lgmdjax.world.obstacles import CAPACITY, Prisms, concatenate, inactive, is_inactive, make_prisms, raise_prisms

MIN_GAP = 0.8
"""Minimum gap between obstacles and around the start [m]: twice the width of the robot."""
INDOOR_FLOOR_CONTRAST, RANDOM_FLOOR_CONTRAST = 0.12, 0.5
"""Upper bound of the contrast of floors, in the paper's rooms and in random rooms."""
GAP_BOX = 0.25
"""Half the side of the boxes of `gap_scene` [m]."""
PLACEMENT_ATTEMPTS = 128
"""Number of positions that are tried for each obstacle of a random room."""
WALKING_SPEED = 0.06
"""Speed of a robot that nothing stands in the way of [m/s]; decides where `cross_path` meets it."""
HALF_ROBOT = 0.25
"""Half the length of the robot [m]."""

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
    """Build the training room: 7 x 7 m, twelve obstacles."""
    boxes, cylinders = _prisms_from_rows(_TRAINING_BOXES), _prisms_from_rows(_TRAINING_CYLINDERS)
    arena = empty_room((7.0, 7.0), boxes=boxes, cylinders=cylinders)
    return scale_contrast(with_random_textures(arena, key), contrast)


def testing_room(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build the testing room: 8 x 8 m, sixteen obstacles, start at (0, 2.5) facing them."""
    boxes, cylinders = _prisms_from_rows(_TESTING_BOXES), _prisms_from_rows(_TESTING_CYLINDERS)
    arena = empty_room((8.0, 8.0), boxes=boxes, cylinders=cylinders, start=(0.0, 2.5, -0.5 * jnp.pi))
    return scale_contrast(with_random_textures(arena, key), contrast)


def tube_scene(lateral: ArrayLike = 0.0, key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build fig. 10e: a poster tube at d_x = 1.25 m, d_y = `lateral` [m] in front of a plain white wall at 3 m."""
    centre = jnp.stack([jnp.asarray(1.25, dtype=float), jnp.asarray(lateral, dtype=float)])
    arena = with_random_textures(empty_room((6.0, 6.0), cylinders=make_prisms(centre[None], 0.06, 1.0)), key)
    white = jnp.asarray([235.0, 0.0, 0.0, 1.0], dtype=float)
    return scale_contrast(dataclasses.replace(arena, wall_texture=arena.wall_texture.at[1].set(white)), contrast)


def indoor_scene(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build fig. 10c: a box whose face is 1.2 m ahead, another box to the right, a table to the left."""
    boxes = _prisms_from_rows(((1.40, 0.00, 0.20, 0.20, 0.0, 0.6), (0.90, -1.35, 0.25, 0.20, 20.0, 0.5)), capacity=2)
    table_top = make_prisms([[1.10, 1.45]], [0.75, 0.45], 0.74, bottom=0.70, capacity=CAPACITY - 2)
    table_legs = make_prisms([[0.40, 1.05], [0.40, 1.85], [1.80, 1.05], [1.80, 1.85]], 0.025, 0.70)
    arena = empty_room((7.0, 6.0), boxes=concatenate(boxes, table_top), cylinders=table_legs)
    return scale_contrast(with_random_textures(arena, key), contrast)


def outdoor_scene(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build fig. 10d: grass, five trees with crowns, bushes and hedges, and the facade of a building behind them."""
    trees = [[1.9, 0.1], [3.3, 1.9], [3.0, -2.1], [1.2, 3.0], [0.6, -2.9]]
    trunks = make_prisms(trees, [[0.15], [0.20], [0.18], [0.22], [0.14]], 2.2, capacity=5)
    crowns = make_prisms(trees, [[0.8], [1.2], [1.0], [1.1], [0.9]], 4.0, bottom=1.9, capacity=5)
    bushes = make_prisms([[2.1, -1.2], [1.9, 1.5]], [[0.30], [0.35]], [0.6, 0.7], capacity=CAPACITY - 10)
    facade = (5.7, 0.0, 0.3, 7.0, 0.0, 7.0)
    hedges = (
        (4.4, 0.0, 0.3, 0.6, 10.0, 0.8),
        (-1.5, 2.3, 0.5, 0.25, 30.0, 0.7),
        (-1.8, -2.0, 0.3, 0.5, 0.0, 0.9),
    )
    cylinders = concatenate(concatenate(trunks, crowns), bushes)
    arena = empty_room((12.0, 14.0), boxes=_prisms_from_rows((facade, *hedges)), cylinders=cylinders, wall_height=1.0)
    grass, sky = jnp.asarray([95.0, 0.6, 0.0, 0.15], dtype=float), jnp.asarray(240.0, dtype=float)
    return scale_contrast(dataclasses.replace(with_random_textures(arena, key), floor_texture=grass, sky=sky), contrast)


def dynamic_scene(key: Array | None = None, *, departs: ArrayLike = (10.0, 24.0), contrast: ArrayLike = 1.0) -> Arena:
    """Build the third scene of sec. 5.3: boxes move into the way, one from the left and a later one from the right.

    Each moves for 2 s from its time in `departs` [s]. At v = 1.2 straight ahead, the robot is then 0.6 m from the
    first.
    """
    departs = jnp.asarray(departs, dtype=float)
    motion = {"goal": [[1.5, 0.1], [1.3, -1.2]], "departs": departs, "arrives": departs + 2.0}
    boxes = make_prisms([[1.5, 2.3], [1.3, -2.3]], 0.20, 0.8, **motion)
    return scale_contrast(with_random_textures(empty_room((7.0, 6.0), boxes=boxes), key), contrast)


def gap_scene(width: ArrayLike, key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build two boxes 1.2 m ahead, side by side with `width` [m] between them; straight ahead leads through the gap."""
    lateral = 0.5 * jnp.asarray(width, dtype=float) + GAP_BOX
    centres = jnp.stack([jnp.stack([1.2 + GAP_BOX, lateral]), jnp.stack([1.2 + GAP_BOX, -lateral])])
    room = empty_room((7.0, 6.0), boxes=make_prisms(centres, GAP_BOX, 0.8))
    return scale_contrast(with_random_textures(room, key), contrast)


def traverse_room(key: Array, *, contrast: ArrayLike = 1.0) -> Arena:
    """Sample a room of 12 x 6 m with 0.2 obstacles per square metre; the start faces the far wall, 11.2 m away."""
    y = 2.0 * _sample_uniform(jax.random.fold_in(key, 1), ()) - 1.0
    start = jnp.stack([jnp.full_like(y, -5.2), 1.5 * y, jnp.zeros_like(y)])
    return random_room(key, 0.2, size=(12.0, 6.0), start=start, contrast=contrast)


def pocket_scene(key: Array | None = None, *, contrast: ArrayLike = 1.0) -> Arena:
    """Build a U of three walls, 1.5 m wide and 1.5 m deep inside, around a start that faces its closed end."""
    walls = ((0.95, 0.0, 0.05, 0.85, 0.0, 0.8), (0.15, 0.8, 0.75, 0.05, 0.0, 0.8), (0.15, -0.8, 0.75, 0.05, 0.0, 0.8))
    room = empty_room((7.0, 6.0), boxes=_prisms_from_rows(walls))
    return scale_contrast(with_random_textures(room, key), contrast)


def random_room(
    key: Array,
    density: ArrayLike = 0.25,
    *,
    size: ArrayLike | None = None,
    start: ArrayLike | None = None,
    contrast: ArrayLike = 1.0,
    min_gap: float = MIN_GAP,
    max_boxes: int = CAPACITY,
    max_cylinders: int = CAPACITY,
) -> Arena:
    """Sample a room with `density` obstacles per square metre, boxes and cylinders in alternation.

    `size` is x, y [m], by default 6 to 8 m a side, and `start` a pose, by default a random one.
    Obstacles are at least `min_gap` [m] from each other and from the walls, and `MIN_GAP` from the start. The start is
    therefore free, and every other free place can be reached. An obstacle for which `PLACEMENT_ATTEMPTS` positions fail
    is left out: count the others with `obstacles.is_inactive`. Rooms are full at about 0.25 per square metre.
    `max_boxes` and `max_cylinders` are static.

    >>> room = random_room(jax.random.key(0), density=0.1)
    >>> int(jnp.sum(room.boxes.top > 0) + jnp.sum(room.cylinders.top > 0))
    4
    """
    room_key, texture_key = jax.random.split(key)
    rounds = max(max_boxes, max_cylinders)
    # One call for all; its last row is for the room itself. A call takes longer to compile than to run.
    samples = _sample_uniform(room_key, (rounds + 1, 2, 4 + 2 * PLACEMENT_ATTEMPTS))
    size = 6.0 + 2.0 * samples[-1, 0, :2] if size is None else jnp.asarray(size, dtype=float)
    if start is None:
        start = (2.0 * samples[-1, 1, :3] - 1.0) * jnp.append(0.5 * size - MIN_GAP, jnp.pi)
    arena = empty_room(size, boxes=inactive(max_boxes), cylinders=inactive(max_cylinders), start=start)
    wanted = jnp.asarray(density, dtype=float) * size[0] * size[1]

    def add_box_and_cylinder(arena: Arena, row: tuple[Array, Array]) -> tuple[Arena, None]:
        index, samples = row
        earlier = 2.0 * index.astype(wanted.dtype)
        box, fits = _sample_box(samples[0], arena, min_gap)
        arena = dataclasses.replace(arena, boxes=_set_row(arena.boxes, index, box, fits & (earlier < wanted)))
        cylinder, fits = _sample_cylinder(samples[1], arena, min_gap)
        fits = fits & (earlier + 1.0 < wanted)
        return dataclasses.replace(arena, cylinders=_set_row(arena.cylinders, index, cylinder, fits)), None

    arena, _ = jax.lax.scan(add_box_and_cylinder, arena, (jnp.arange(rounds), samples[:-1]))
    return scale_contrast(with_random_textures(arena, texture_key, RANDOM_FLOOR_CONTRAST), contrast)


def _sample_box(samples: Array, arena: Arena, min_gap: float) -> tuple[Prisms, Bool[Array, ""]]:
    """Return a box of random size and position, and whether a free position was found."""
    width, depth, turn, rise = samples[:4]
    half_size = 0.12 + 0.28 * jnp.stack([width, depth])
    yaw = jnp.pi * (turn - 0.5)
    signs = jnp.asarray([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], dtype=float)
    corners = rotate(signs * half_size, yaw)
    centre, fits = _first_free_position(samples[4:], arena, corners, jnp.zeros_like(yaw), min_gap)
    return make_prisms(centre, half_size, 0.5 + rise, yaw=yaw, capacity=1), fits


def _sample_cylinder(samples: Array, arena: Arena, min_gap: float) -> tuple[Prisms, Bool[Array, ""]]:
    """Return a cylinder of random size and position, and whether a free position was found."""
    thickness, rise = samples[:2]
    radius = 0.05 + 0.25 * thickness
    centre, fits = _first_free_position(samples[4:], arena, jnp.zeros((1, 2), dtype=float), radius, min_gap)
    return make_prisms(centre, radius, 0.5 + rise, capacity=1), fits


def _first_free_position(
    samples: Array, arena: Arena, corners: Float[Array, "n 2"], radius: Array, min_gap: float
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Return the first of `PLACEMENT_ATTEMPTS` positions with enough space, and whether there is one.

    The shape is a polygon with `corners` about its position, dilated by `radius`.
    """
    low, high = arena.bounds[0::2], arena.bounds[1::2]
    positions = low + samples.reshape(PLACEMENT_ATTEMPTS, 2) * (high - low)
    p = positions[:, None] + corners
    q = positions[:, None] + jnp.roll(corners, 1, axis=0)
    radii = jnp.broadcast_to(radius, (PLACEMENT_ATTEMPTS * len(corners),))
    gaps = clearance(arena, p.reshape(-1, 2), q.reshape(-1, 2), radii).reshape(PLACEMENT_ATTEMPTS, -1)
    outer_radius = radius + jnp.max(jnp.linalg.norm(corners, axis=-1))
    from_start = jnp.linalg.norm(positions - arena.start[:2], axis=-1) - outer_radius
    is_free = (jnp.min(gaps, axis=-1) >= min_gap) & (from_start >= MIN_GAP)
    return positions[jnp.argmax(is_free)], jnp.any(is_free)


def _set_row(prisms: Prisms, index: Array, prism: Prisms, is_set: Bool[Array, ""]) -> Prisms:
    """Replace row `index`, if it exists, by a single prism where `is_set`."""
    return jax.tree.map(lambda all, one: jnp.where(is_set, all.at[index].set(one[0]), all), prisms, prism)


def with_random_textures(
    arena: Arena, key: Array | None = None, max_floor_contrast: float = INDOOR_FLOOR_CONTRAST
) -> Arena:
    """Return the room with random textures; the contrast of the floor is between 0.05 and `max_floor_contrast`.

    All obstacles and walls have similar, high contrast. The LGMD estimates proximity from the amount of image motion,
    and can distinguish it from contrast only if contrasts are similar.

    The motion of the floor is equal in both eyes: it raises u and hardly changes the difference between the two.
    However, a controller trained only on plain floors responds to a lawn as to a wall on each side. Random rooms, in
    which the controller is trained, therefore have floors of all contrasts. The paper's rooms have floors of low
    contrast, as in a laboratory.
    """
    boxes, cylinders = arena.boxes, arena.cylinders
    first, second = boxes.yaw.size, boxes.yaw.size + cylinders.yaw.size
    samples = _sample_uniform(jax.random.key(0) if key is None else key, (second + 6, 4))

    def scale(samples: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Float[Array, "... 4"]:
        lower, upper = jnp.asarray(low, dtype=float), jnp.asarray(high, dtype=float)
        return lower + samples * (upper - lower)

    obstacles = scale(samples[:second], (100.0, 0.6, 0.0, 0.15), (160.0, 0.8, 2.0 * jnp.pi, 0.35))
    return dataclasses.replace(
        arena,
        boxes=dataclasses.replace(boxes, texture=obstacles[:first]),
        cylinders=dataclasses.replace(cylinders, texture=obstacles[first:]),
        wall_texture=scale(samples[second:-2], (120.0, 0.5, 0.0, 0.3), (170.0, 0.7, 2.0 * jnp.pi, 0.6)),
        floor_texture=scale(samples[-2], (110.0, 0.05, 0.0, 0.2), (150.0, max_floor_contrast, 2.0 * jnp.pi, 0.5)),
        sky=200.0 + 50.0 * samples[-1, 0],
    )


def raise_obstacles(arena: Arena, key: Array, share: Float[Array, ""] | float) -> Arena:
    """Return the room with a share of its obstacles raised overhead: the robot sees them and walks under them."""
    boxes, cylinders = len(arena.boxes.top), len(arena.cylinders.top)
    samples = _sample_uniform(key, (boxes + cylinders, 4))
    return dataclasses.replace(
        arena,
        boxes=raise_prisms(arena.boxes, samples[:boxes], share),
        cylinders=raise_prisms(arena.cylinders, samples[boxes:], share),
    )


def cross_path(arena: Arena, start: Float[Array, "3"], key: Array, share: Float[Array, ""] | float) -> Arena:
    """Return the room in which a box and a cylinder may move into the straight path of a robot that leaves `start`.

    Each does so with probability `share`. It comes from 1 to 2.5 m beside the path, departs 2 to 14 s after the robot,
    moves for 1.5 to 3 s, and stops with its centre within 0.1 m of the path and its front 0.2 to 0.7 m before a robot
    that has walked straight on at `WALKING_SPEED`. A motion that would begin or end outside the room is left out.

    Args:
        arena: the room, in which nothing moves yet.
        start: pose (x, y, yaw) of the robot at time 0 [m, m, rad].
        key: of the random numbers.
        share: probability of each of the two motions.
    """
    samples = _sample_uniform(key, (2, 6))
    boxes = _send_into_path(arena, arena.boxes, start, samples[0], share)
    return dataclasses.replace(
        arena, boxes=boxes, cylinders=_send_into_path(arena, arena.cylinders, start, samples[1], share)
    )


def _send_into_path(
    arena: Arena, prisms: Prisms, start: Float[Array, "3"], samples: Float[Array, "6"], share: Float[Array, ""] | float
) -> Prisms:
    """Let the first prism cross the path as `cross_path` says, with numbers 0 .. 1 in `samples`."""
    chosen, delay, pace, gap, aside, lateral = samples
    departs, duration = 2 + 12 * delay, 1.5 + 1.5 * pace
    ahead = WALKING_SPEED * (departs + duration) + HALF_ROBOT + 0.2 + 0.5 * gap + jnp.max(prisms.half_size[0])
    side = jnp.where(aside < 0.5, -1.0, 1.0)
    goal = start[:2] + rotate(jnp.stack([ahead, 0.2 * lateral - 0.1]), start[2])
    from_side = 1.0 + 1.5 * jnp.abs(2 * aside - 1)
    origin = goal + rotate(jnp.stack([jnp.zeros_like(side), side * from_side]), start[2])
    both = jnp.stack([origin, goal])
    is_inside = jnp.all((both > arena.bounds[0::2]) & (both < arena.bounds[1::2]))
    moves = (chosen < share) & is_inside & ~is_inactive(prisms)[0]
    motion = {"centre": origin, "goal": goal, "departs": departs, "arrives": departs + duration}
    changed = {name: getattr(prisms, name).at[0].set(value) for name, value in motion.items()}
    return jax.tree.map(lambda new, old: jnp.where(moves, new, old), dataclasses.replace(prisms, **changed), prisms)


def scale_contrast(arena: Arena, contrast: ArrayLike) -> Arena:
    """Return the room with the contrast of every texture multiplied by `contrast` and limited to 0 .. 1."""
    factor = jnp.asarray(contrast, dtype=arena.sky.dtype)

    def scale(texture: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
        return texture.at[..., 1].set(jnp.clip(texture[..., 1] * factor, 0.0, 1.0))

    return dataclasses.replace(
        arena,
        boxes=dataclasses.replace(arena.boxes, texture=scale(arena.boxes.texture)),
        cylinders=dataclasses.replace(arena.cylinders, texture=scale(arena.cylinders.texture)),
        wall_texture=scale(arena.wall_texture),
        floor_texture=scale(arena.floor_texture),
    )


def _prisms_from_rows(rows: tuple[tuple[float, ...], ...], capacity: int = CAPACITY) -> Prisms:
    """Make prisms from rows of x, y, half sizes, yaw in degrees, height."""
    table = jnp.asarray(rows, dtype=float)
    return make_prisms(table[:, :2], table[:, 2:4], table[:, 5], yaw=jnp.deg2rad(table[:, 4]), capacity=capacity)


def _sample_uniform(key: Array, shape: tuple[int, ...]) -> Array:
    """Sample from 0 .. 1 in float32 and cast, so that a key gives the same room in both precisions."""
    return jax.random.uniform(key, shape, dtype=jnp.float32).astype(float)
