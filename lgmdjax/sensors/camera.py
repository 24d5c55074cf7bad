"""Two fisheye eyes: what the robot sees, every pixel integrated over its area.

One ray a pixel, and beside it how the ray turns from pixel to pixel. What a surface covers of a pixel follows from
the margin by which the ray is inside its outline: no sampling, and differentiable everywhere (`layers`). Prisms are
sorted out by image tile, each of which knows the `slots` nearest ones that may show in it.

| symbol   | name                                   | unit   | where                                        |
| -------- | -------------------------------------- | ------ | -------------------------------------------- |
| theta    | angle of a pixel from the optical axis | rad    | theta = rho/f (equidistant), rho in pixels   |
| f        | focal length                           | px/rad | width/fov                                    |
| u, v     | column and row from the middle         | px     | d = (cos theta, -u sin theta/rho, -v ../rho) |
| d        | direction of a pixel                   | 1      |                                              |
| d_u, d_v | its derivatives                        | 1/px   |                                              |

Site frames: x forward, y left, z up. Row 0 is the top, column 0 the left. Grey levels 0..255.
Source: sec. 3.1 and 4 of the paper for the cameras; the way of drawing is our own.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from lgmdjax.errors import InputError
from lgmdjax.sensors import antialiasing, compositing, hemifield, silhouettes
from lgmdjax.world.arena import Arena
from lgmdjax.world.texture import WAVES

Leaf = Array | np.ndarray

_TILE = (math.radians(4.3), math.radians(8.6))
"""About how high and wide a tile is: small ones hold few prisms, large ones are long loops."""
_COARSE = 25.0
"""Pictures of fewer pixels a radian have tiles of 2 x 4 pixels at least, others of 4 x 8, which are twice as fast."""


@struct.dataclass(kw_only=True, frozen=True)
class Params:
    """The camera's structure, all of it static. Raises InputError where it cannot be."""

    width: int = struct.field(pytree_node=False, default=320)
    height: int = struct.field(pytree_node=False, default=240)
    fov: float = struct.field(pytree_node=False, default=math.radians(170.0))
    """Over the whole width [rad]."""
    overlap: float = struct.field(pytree_node=False, default=1.0)
    """Part of the width that an eye draws, from its own side: 0.5 (its half) .. 1 (all)."""
    samples: int = struct.field(pytree_node=False, default=1)
    """Rays a pixel along each side; one is enough, since a ray stands for an area."""
    slots: int = struct.field(pytree_node=False, default=6)
    """Prisms that a tile can hold: the nearest (`crowding` tells how many there are)."""
    bands: int = struct.field(pytree_node=False, default=3)
    """Scales of the textures, each less than half of the one before."""

    def __post_init__(self) -> None:
        for name in ("width", "height", "samples", "slots", "bands"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(f"expected camera {name} as a whole number above 0, got {value!r}; change it")
        if self.bands > len(WAVES):
            raise InputError(f"expected at most {len(WAVES)} bands of texture, got {self.bands}; lower camera bands")
        if not 0.5 <= self.overlap <= 1.0:
            raise InputError(f"expected a camera overlap in 0.5..1, got {self.overlap!r}; change it")
        if not 0.0 < self.fov * math.hypot(1.0, self.height / self.width) < 2.0 * math.pi:
            raise InputError(
                f"expected a camera fov above 0 with corners less than pi rad from the middle, got {self.fov!r} rad "
                f"over {self.width} x {self.height} pixels; lower fov or height"
            )


def shape(params: Params) -> tuple[int, int, int]:
    """Return the shape of a stereo pair: eyes, rows, columns."""
    return 2, params.height, hemifield.columns(params.width, params.overlap)


def render(
    params: Params,
    arena: Arena,
    positions: Float[Leaf, "2 3"],
    rotations: Float[Leaf, "2 3 3"] | Float[Leaf, "3 3"],
) -> Float[Array, "2 height columns"]:
    """Draw what the left and the right eye see, in grey levels 0..255.

    `positions` [m] and `rotations` (from the eye's frame to the world; one for both will do) are the eyes' poses. The
    left eye draws its first columns, the right eye its last ones, as many as `shape` says.
    Gradient: through outlines, by what they cover, and through depths and textures; zero through which prisms a tile
    knows of.
    """
    grid, positions = _grid(params), jnp.asarray(positions)
    grey = jax.vmap(functools.partial(_eye, params, arena), in_axes=(0, 0, grid.eyes))(
        positions, jnp.broadcast_to(rotations, (2, 3, 3)), grid.fields(positions.dtype)
    )
    # XLA draws anew in every loop that reads the picture, but never repeats a division by what it does not know.
    one = 1.0 + 0.0 * lax.stop_gradient(positions[0, 0])
    return _assemble(params, grey) / one


def crowding(
    params: Params,
    arena: Arena,
    positions: Float[Leaf, "2 3"],
    rotations: Float[Leaf, "2 3 3"] | Float[Leaf, "3 3"],
) -> Int[Array, ""]:
    """Count the prisms that may show in the fullest tile of a stereo pair; with as many `slots` none is left out."""
    grid = _grid(params)
    shows = jax.vmap(lambda *eye: _look(arena, *eye)[1], in_axes=(0, 0, grid.eyes))(
        positions, jnp.broadcast_to(rotations, (2, 3, 3)), grid.fields(positions.dtype)
    )
    return jnp.max(jnp.sum(shows, axis=-1))


class _Field(NamedTuple):
    """The pixels of an eye in its own frame, (3, tiles, pixels), and cones about them.

    A tile is wider than high and has several cones, (tiles, cones) side by side: one about all of it would be high.
    """

    d: Array
    d_u: Array
    d_v: Array
    axes: Array
    radii: Array


class _Grid(NamedTuple):
    """The fields of both eyes on the host, stacked; of one if they are the same."""

    field: tuple[np.ndarray, ...]
    eyes: int | None

    def fields(self, dtype: jnp.dtype) -> _Field:
        return _Field(*(jnp.asarray(a, dtype) for a in self.field))


@functools.lru_cache(maxsize=32)
def _grid(params: Params) -> _Grid:
    columns = shape(params)[2]
    if columns == params.width:
        return _Grid(_field(params, 0), None)
    fields = _field(params, 0), _field(params, params.width - columns)
    return _Grid(tuple(np.stack(pair) for pair in zip(*fields, strict=True)), 0)


def _field(params: Params, first: int) -> tuple[np.ndarray, ...]:
    """Lay out the rays from column `first` on, a few beyond the picture where tiles do not fit into it."""
    n, f = params.samples, _focal_length(params)
    rows, across, high, wide = _tiles(params)
    v, u = np.mgrid[: rows * high, : across * wide] + 0.5
    pixels = equidistant(u + n * first - 0.5 * n * params.width, v - 0.5 * n * params.height, f)
    d, d_u, d_v = (np.swapaxes(a.reshape(3, rows, high, across, wide), 2, 3) for a in pixels)
    size = min(high, wide)
    parts = d[..., np.linspace(0, wide - size, -(-wide // size)).astype(int)[:, None] + np.arange(size)]
    axes = parts.sum(axis=(3, 5))
    axes /= np.linalg.norm(axes, axis=0)
    cosines = np.einsum("archpw,arcp->rchpw", parts, axes).min(axis=(2, 4))
    # A pixel reaches farther than its ray, by half a diagonal.
    radii = np.arccos(np.clip(cosines, -1.0, 1.0)) + 0.75 / f
    tiles = rows * across
    d, d_u, d_v = (a.reshape(3, tiles, -1) for a in (d, d_u, d_v))
    return d, d_u, d_v, np.moveaxis(axes, 0, -1).reshape(tiles, -1, 3), radii.reshape(tiles, -1)


def _focal_length(params: Params) -> float:
    """Give f in rays a radian."""
    return params.samples * params.width / params.fov


def _tiles(params: Params) -> tuple[int, int, int, int]:
    """Count the rows and columns of tiles, and the rows and columns of rays in each."""
    (_, height, columns), n, f = shape(params), params.samples, _focal_length(params)
    least = 2 if f < _COARSE else 4
    high, wide = tile(height * n, _TILE[0] * f, least), tile(columns * n, _TILE[1] * f, 2 * least)
    return -(-height * n // high), -(-columns * n // wide), high, wide


def tile(length: int, wanted: float, least: int) -> int:
    """Choose the size of tiles along a side of the picture: near the one wanted, and such that they fit into it."""
    wanted = max(least, round(wanted))
    sizes = [size for size in range(-(-wanted // 2), 2 * wanted + 1) if length % size == 0]
    return min(sizes, key=lambda size: abs(math.log(size / wanted)), default=wanted)


def equidistant(u: np.ndarray, v: np.ndarray, f: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions of the pixels (u, v) from the middle, and their derivatives by u and v."""
    rho = np.maximum(np.hypot(u, v), 1e-9)
    theta = rho / f
    spread = np.sin(theta) / rho
    change = (np.cos(theta) / f - spread) / rho**2
    d = np.stack([np.cos(theta), -spread * u, -spread * v])
    d_u = np.stack([-spread * u / f, -spread - change * u * u, -change * u * v])
    d_v = np.stack([-spread * v / f, -change * u * v, -spread - change * v * v])
    return d, d_u, d_v


def _look(arena: Arena, position: Array, rotation: Array, field: _Field) -> tuple[silhouettes.Silhouette, Array]:
    """See the prisms from an eye, and which of them may show in which tile."""
    prisms, bounds = silhouettes.look(arena, position)
    shows = silhouettes.may_show(prisms, bounds, field.axes @ rotation.T, field.radii)
    return prisms, jnp.any(shows, axis=1)


def _eye(params: Params, arena: Arena, position: Array, rotation: Array, field: _Field) -> Array:
    """Draw one eye: (tiles, pixels), each tile's pixels in a row, for which XLA's loops read its prisms once."""
    picked = silhouettes.pick(*_look(arena, position, rotation, field), params.slots)
    picked = jax.tree.map(lambda a: a[:, None], picked)

    def turned(rays: Array) -> tuple[Array, Array, Array]:
        x, y, z = (rotation[i, 0] * rays[0] + rotation[i, 1] * rays[1] + rotation[i, 2] * rays[2] for i in range(3))
        return x, y, z

    rays = antialiasing.rays(turned(field.d), turned(field.d_u), turned(field.d_v))
    return compositing.draw(arena, position, rays, picked, params.bands)


def _assemble(params: Params, grey: Array) -> Array:
    """Join the tiles, cut off what is beyond the picture, and average the samples of a pixel."""
    (eyes, height, columns), n = shape(params), params.samples
    rows, across, high, wide = _tiles(params)
    lines = jnp.swapaxes(grey.reshape(eyes, rows, across, high, wide), 2, 3)
    picture = lines.reshape(eyes, rows * high, across * wide)[:, : height * n, : columns * n]
    return picture if n == 1 else jnp.mean(picture.reshape(eyes, height, n, columns, n), axis=(2, 4))
