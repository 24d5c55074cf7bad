"""The world a robot walks in: a walled room with upright boxes and cylinders, all of it arrays.

Every obstacle is a prism that stands upright: a box turned about the vertical, or a cylinder. It may hang above
the floor (a table top, a tree's crown). Each kind is padded to a static number with prisms parked far away and
under the floor, so that every robot of a batch has a room of its own: `vmap` over a batched `Arena`.

World frame: x forward, y left, z up, floor at z = 0; metres, radians, seconds.

| symbol | name                           | unit          | where                                                  |
| ------ | ------------------------------ | ------------- | ------------------------------------------------------ |
| c(t)   | centre of a prism at time t    | m             | c + (goal - c) clip((t - departs)/(arrives - departs)) |
| a, b   | half_size in the prism's frame | m             | a cylinder has its radius twice                        |
| psi    | yaw of the prism               | rad           |                                                        |
| tau    | texture row                    | see `TEXTURE` | brightness, contrast, phase, scale                     |
| h      | handedness of all textures     | 1 or -1       | a pattern is a function of (x, h y, z) in the frame of |
|        |                                |               | its prism (walls and floor: of the world)              |

Source: sec. 5 of the paper (its figure 10 shows the rooms).
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import ArrayLike, Float

BOXES = CYLINDERS = 12
PARKED = 1.0e3
"""Where padding is parked: x = y = 1 km [m]."""
TEXTURE = ("brightness", "contrast", "phase", "scale")
"""Columns of a texture row: mean grey 0..255, contrast 0..1, pattern offset [rad], coarsest wavelength [m]."""
PLAIN = (128.0, 0.0, 0.0, 0.5)


@struct.dataclass(kw_only=True)
class Prisms:
    """A padded set of upright prisms of one kind."""

    centre: Float[Array, "n 2"]
    half_size: Float[Array, "n 2"]
    yaw: Float[Array, " n"]
    bottom: Float[Array, " n"]
    top: Float[Array, " n"]
    texture: Float[Array, "n 4"]
    goal: Float[Array, "n 2"]
    departs: Float[Array, " n"]
    arrives: Float[Array, " n"]


@struct.dataclass(kw_only=True)
class Arena:
    """A room: obstacles, four walls seen from inside, a floor, a sky (or ceiling) of one brightness."""

    boxes: Prisms
    cylinders: Prisms
    room: Float[Array, "4"]
    """x_min, x_max, y_min, y_max of the walls' inner faces."""
    wall_height: Float[Array, ""]
    wall_texture: Float[Array, "4 4"]
    """One row a wall, in the order of `room`."""
    floor_texture: Float[Array, "4"]
    sky: Float[Array, ""]
    """Grey 0..255 of whatever no ray hits."""
    start: Float[Array, "3"]
    """A free start pose: x, y, yaw."""
    handedness: Float[Array, ""]
    """1, or -1 in a mirrored room: textures take h y for y, so that their patterns are mirrored too."""


def place(
    centre: ArrayLike,
    half_size: ArrayLike,
    top: ArrayLike,
    *,
    yaw: ArrayLike = 0.0,
    bottom: ArrayLike = 0.0,
    texture: ArrayLike = PLAIN,
    goal: ArrayLike | None = None,
    departs: ArrayLike = 0.0,
    arrives: ArrayLike = 0.0,
    count: int = BOXES,
) -> Prisms:
    """Set up prisms at `centre` (n, 2), the rest broadcast to n rows, padded with parked ones to `count`."""
    centre = jnp.asarray(centre, dtype=float).reshape(-1, 2)
    rows = centre.shape[0]

    def fill(value: ArrayLike, *width: int) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype=float), (rows, *width))

    real = Prisms(
        centre=centre,
        half_size=fill(half_size, 2),
        yaw=fill(yaw),
        bottom=fill(bottom),
        top=fill(top),
        texture=fill(texture, 4),
        goal=centre if goal is None else fill(goal, 2),
        departs=fill(departs),
        arrives=fill(arrives),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), real, parked(count - rows))


def parked(count: int) -> Prisms:
    """Padding: `count` small plain prisms far away under the floor, where no ray and no robot meets them."""
    far = jnp.full((count, 2), PARKED, dtype=float)
    zero = jnp.zeros(count, dtype=float)
    return Prisms(
        centre=far,
        half_size=jnp.full((count, 2), 0.05, dtype=float),
        yaw=zero,
        bottom=zero - 0.2,
        top=zero - 0.1,
        texture=jnp.broadcast_to(jnp.asarray(PLAIN, dtype=float), (count, 4)),
        goal=far,
        departs=zero,
        arrives=zero,
    )


def empty_room(
    size: ArrayLike = (6.0, 6.0),
    *,
    boxes: Prisms | None = None,
    cylinders: Prisms | None = None,
    wall_height: ArrayLike = 2.0,
    wall_texture: ArrayLike = (170.0, 0.5, 0.0, 1.0),
    floor_texture: ArrayLike = (110.0, 0.4, 0.0, 0.5),
    sky: ArrayLike = 220.0,
    start: ArrayLike = (0.0, 0.0, 0.0),
) -> Arena:
    """Build a room of `size` (x, y) centred at the origin, with the prisms given and nothing else in it."""
    x, y = 0.5 * jnp.asarray(size, dtype=float)
    return Arena(
        boxes=parked(BOXES) if boxes is None else boxes,
        cylinders=parked(CYLINDERS) if cylinders is None else cylinders,
        room=jnp.stack([-x, x, -y, y]),
        wall_height=jnp.asarray(wall_height, dtype=float),
        wall_texture=jnp.broadcast_to(jnp.asarray(wall_texture, dtype=float), (4, 4)),
        floor_texture=jnp.asarray(floor_texture, dtype=float),
        sky=jnp.asarray(sky, dtype=float),
        start=jnp.asarray(start, dtype=float),
        handedness=jnp.asarray(1.0, dtype=float),
    )


def at(arena: Arena, time: ArrayLike) -> Arena:
    """Move the obstacles to where they are at `time` [s]; the result is a still room.

    c(t) = c + (goal - c) clip((t - departs)/(arrives - departs), 0, 1); with arrives = departs it jumps.
    """
    return arena.replace(boxes=_moved(arena.boxes, time), cylinders=_moved(arena.cylinders, time))


def _moved(prisms: Prisms, time: ArrayLike) -> Prisms:
    duration = prisms.arrives - prisms.departs
    moves = duration > 0
    late = jnp.asarray(time, dtype=duration.dtype) - prisms.departs
    fraction = jnp.clip(late / jnp.where(moves, duration, 1.0), 0.0, 1.0)
    fraction = jnp.where(moves, fraction, jnp.where(late >= 0, 1.0, 0.0))
    centre = prisms.centre + fraction[..., None] * (prisms.goal - prisms.centre)
    return prisms.replace(centre=centre, goal=centre)


def mirror(arena: Arena) -> Arena:
    """Reflect the room in its x axis: y -> -y, yaw -> -yaw, walls y_min and y_max swapped, textures too."""
    flip = jnp.asarray([1.0, -1.0], dtype=arena.room.dtype)

    def reflected(prisms: Prisms) -> Prisms:
        return prisms.replace(centre=prisms.centre * flip, goal=prisms.goal * flip, yaw=-prisms.yaw)

    order = jnp.asarray([0, 1, 3, 2])
    sign = jnp.asarray([1.0, 1.0, -1.0, -1.0], dtype=arena.room.dtype)
    return arena.replace(
        boxes=reflected(arena.boxes),
        cylinders=reflected(arena.cylinders),
        room=(arena.room * sign)[order],
        wall_texture=arena.wall_texture[order],
        start=arena.start * jnp.asarray([1.0, -1.0, -1.0], dtype=arena.room.dtype),
        handedness=-arena.handedness,
    )
