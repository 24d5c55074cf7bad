"""The laser scanner, 3 cm above the middle of the body: the teacher's sense, never the learned controller's.

| symbol    | name                                                     | unit | default       |
| --------- | -------------------------------------------------------- | ---- | ------------- |
| phi_i     | bearing of ray i in the scanner's plane, left positive   | rad  | -85 .. 85 deg |
| d_l, d_r  | nearest thing in the left and the right hemifield        | m    | clipped at 5  |

Source: secs. 3.1 and 4.2 of the paper: 170 degrees, two rays a degree, clipped at 5 m. The scanner rides on
the body, so that a pitching robot sees the floor with it, as the real one would.
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
    """The scanner: field of view [rad] and clipping range [m] (sec. 3.1)."""

    rays: int = struct.field(pytree_node=False, default=341)
    field_of_view: float = math.radians(170.0)
    clip: float = 5.0


def check(params: Params) -> None:
    """Raise `InputError` for a scanner that sees nothing."""
    if params.rays < 2:
        raise InputError(f"laser rays: expected 2 or more, got {params.rays}; the paper has 341")
    for name, most in (("field_of_view", 2 * math.pi), ("clip", math.inf)):
        if not 0 < (value := float(getattr(params, name))) <= most or math.isinf(value):
            raise InputError(f"laser {name}: expected a positive number up to {most:.3g}, got {value}")


def bearings(params: Params) -> Float[Array, " rays"]:
    """List the rays' bearings [rad], from the rightmost (negative) to the leftmost."""
    half = 0.5 * jnp.asarray(params.field_of_view, dtype=float)
    return jnp.linspace(-1.0, 1.0, params.rays) * half


def scan(
    params: Params, arena: Arena, position: Float[Array, "3"], rotation: Float[Array, "3 3"]
) -> Float[Array, " rays"]:
    """Measure the distance [m] to the first thing each way, clipped; the site's x is forward, z up.

    Gradient: that of the surface hit; zero where clipped.
    """
    phi = bearings(params).astype(rotation.dtype)
    # Written out, because a float32 matrix product on a GPU may round to ten bits.
    directions = jnp.cos(phi)[:, None] * rotation[:, 0] + jnp.sin(phi)[:, None] * rotation[:, 1]
    return minimum(raycast.distance(arena, position, directions), params.clip)


def hemifields(ranges: Float[Array, "*batch rays"]) -> Float[Array, "*batch 2"]:
    """Find d_l and d_r [m], the nearest on either side (for eq. 22); the middle ray belongs to both."""
    middle = ranges.shape[-1] // 2
    right = ranges[..., : ranges.shape[-1] - middle]
    return jnp.stack([amin(ranges[..., middle:], axis=-1), amin(right, axis=-1)], axis=-1)
