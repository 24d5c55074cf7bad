"""Laser scanner, 3 cm above the middle of the body. It serves the teacher, never the learned controller.

| symbol    | name                                                     | unit | default         |
| --------- | -------------------------------------------------------- | ---- | --------------- |
| phi_i     | bearing of ray i in the scanner's plane, left positive   | rad  | -85 .. 85 deg   |
| d_l, d_r  | smallest distance in the left and the right hemifield    | m    | limited to 5    |
| w         | half width of the corridor that the robot walks along    | m    | 0.15            |
| a         | slope of e with the distance beside the corridor         | 1    | 7               |
| e_l, e_r  | smallest corridor distance on either side                | m    | limited to 5    |

d is the distance of an obstacle, e how far the way ahead is free. A hit at (x, y), x ahead and y to the left, counts as
at the distance

    e(x, y) = x + a max(|y| - w, 0),

so that a wall beside the robot is near (d) but not in its way (e). The robot's feet are 0.2 m to its sides. With these
constants an obstacle directly beside the robot counts as nearer than 0.8 m, where the teacher begins to turn, if it is
within 0.26 m.

Source: secs. 3.1 and 4.2 of the paper: 170 degrees, two rays per degree, ranges limited to 5 m. The scanner is fixed to
the body, so that it measures the floor when the robot pitches, as a real one would.
"""

import math

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.body.robot_xml import Offset
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.minmax import amin, maximum, minimum
from lgmdjax.world import raycast
from lgmdjax.world.arena import Arena


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Number of rays, field of view [rad] and largest range [m] of the scanner (sec. 3.1), and the corridor (ours).

    The mount is where the scanner sits; where that of the package's robot does if None.
    """

    rays: int = struct.field(pytree_node=False, default=341)
    mount: Offset | None = struct.field(pytree_node=False, default=None)  # m, in the trunk's frame
    fov: float = math.radians(170.0)
    max_range: float = 5.0
    corridor_half_width: float = 0.15  # w, m
    corridor_slope: float = 7.0  # a


def check(params: Params) -> None:
    """Raise `InputError` for a scanner that cannot measure anything."""
    if params.rays < 2:
        raise InputError(f"laser rays: expected 2 or more, got {params.rays}; the paper has 341")
    for name, limit in (("fov", 2 * math.pi), ("max_range", math.inf)):
        if not 0 < (value := float(getattr(params, name))) <= limit or math.isinf(value):
            raise InputError(f"laser {name}: expected a positive number up to {limit:.3g}, got {value}; change it")
    for name in ("corridor_half_width", "corridor_slope"):
        if not 0 <= (value := float(getattr(params, name))) < math.inf:
            raise InputError(f"laser {name}: expected a finite number >= 0, got {value}; change it")


def bearings(params: Params) -> Float[Array, " rays"]:
    """Return the bearings of the rays [rad], from the rightmost (negative) to the leftmost.

    >>> bearings(Params(rays=3, fov=2.0)).tolist()
    [-1.0, 0.0, 1.0]
    """
    half = 0.5 * jnp.asarray(params.fov, dtype=float)
    return jnp.linspace(-1.0, 1.0, params.rays) * half


def scan(
    params: Params, arena: Arena, position: Float[Array, "3"], rotation: Float[Array, "3 3"]
) -> Float[Array, " rays"]:
    """Return the distance [m] to the nearest surface along each ray, at most `max_range`.

    Gradient: that of the surface hit; zero where the range is limited.

    Args:
        params: of the scanner.
        arena: the room.
        position: of the scanner [m].
        rotation: from the scanner's frame (x forward, z up) to the world frame.
    """
    phi = bearings(params).astype(rotation.dtype)
    # Not a matrix product, because on a GPU a float32 one may round to ten bits.
    directions = jnp.cos(phi)[:, None] * rotation[:, 0] + jnp.sin(phi)[:, None] * rotation[:, 1]
    return minimum(raycast.distance(arena, position, directions), params.max_range)


def hemifield_distances(ranges: Float[Array, "*batch rays"]) -> Float[Array, "*batch 2"]:
    """Return d_l and d_r [m], the smallest range on either side (for eq. 22); the middle ray belongs to both sides.

    >>> hemifield_distances(jnp.asarray([3.0, 2.0, 4.0, 1.0, 5.0])).tolist()
    [1.0, 2.0]
    """
    return _smallest_on_either_side(ranges)


def corridor_distances(params: Params, ranges: Float[Array, "*batch rays"]) -> Float[Array, "*batch 2"]:
    """Return e_l and e_r [m], how far the way ahead is free on either side, at most `max_range`.

    A hit 1 m ahead is in the way, one 1 m to the left is not:

    >>> scanner = Params(rays=3, fov=math.pi)
    >>> corridor_distances(scanner, jnp.asarray([5.0, 1.0, 1.0])).round(2).tolist()
    [1.0, 1.0]
    >>> corridor_distances(scanner, jnp.asarray([5.0, 5.0, 1.0])).round(2).tolist()
    [5.0, 5.0]
    """
    phi = bearings(params).astype(ranges.dtype)
    ahead, aside = ranges * jnp.cos(phi), ranges * jnp.abs(jnp.sin(phi))
    distances = ahead + params.corridor_slope * maximum(aside - params.corridor_half_width, 0.0)
    return _smallest_on_either_side(minimum(distances, params.max_range))


def _smallest_on_either_side(values: Float[Array, "*batch rays"]) -> Float[Array, "*batch 2"]:
    middle = values.shape[-1] // 2
    right = values[..., : values.shape[-1] - middle]
    return jnp.stack([amin(values[..., middle:], axis=-1), amin(right, axis=-1)], axis=-1)
