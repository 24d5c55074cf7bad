"""Laser scanner, 3 cm above the middle of the body. It serves the teacher, never the learned controller.

| symbol    | name                                                     | unit | default         |
| --------- | -------------------------------------------------------- | ---- | --------------- |
| phi_i     | bearing of ray i in the scanner's plane, left positive   | rad  | -85 .. 85 deg   |
| d_l, d_r  | smallest distance in the left and the right hemifield    | m    | limited to 5    |

Source: secs. 3.1 and 4.2 of the paper: 170 degrees, two rays per degree, ranges limited to 5 m. The scanner is fixed to
the body, so that it measures the floor when the robot pitches, as a real one would.
"""

import math

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.errors import InputError
from lgmdjax.minmax import amin, minimum
from lgmdjax.world import raycast
from lgmdjax.world.arena import Arena


@struct.dataclass(kw_only=True)
class Params:
    """Number of rays, field of view [rad] and largest range [m] of the scanner (sec. 3.1)."""

    rays: int = struct.field(pytree_node=False, default=341)
    fov: float = math.radians(170.0)
    max_range: float = 5.0


def check(params: Params) -> None:
    """Raise `InputError` for a scanner that cannot measure anything."""
    if params.rays < 2:
        raise InputError(f"laser rays: expected 2 or more, got {params.rays}; the paper has 341")
    for name, limit in (("fov", 2 * math.pi), ("max_range", math.inf)):
        if not 0 < (value := float(getattr(params, name))) <= limit or math.isinf(value):
            raise InputError(f"laser {name}: expected a positive number up to {limit:.3g}, got {value}; change it")


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
    middle = ranges.shape[-1] // 2
    right = ranges[..., : ranges.shape[-1] - middle]
    return jnp.stack([amin(ranges[..., middle:], axis=-1), amin(right, axis=-1)], axis=-1)
