"""Stereo fisheye camera: images of the left and the right eye, each pixel integrated over its area.

The camera casts one ray per pixel and uses its change from pixel to pixel. The part of a pixel that a surface covers
follows from the margin by which the ray is inside the surface's outline. This needs no sampling and is differentiable
everywhere (`compositing`). Prisms are culled by image tile: each tile keeps the `tile_capacity` nearest ones that may
be visible in it.

| symbol   | name                                   | unit   | where                                        |
| -------- | -------------------------------------- | ------ | -------------------------------------------- |
| theta    | angle of a pixel from the optical axis | rad    | theta = rho/f (equidistant), rho in pixels   |
| f        | focal length                           | px/rad | width/fov                                    |
| u, v     | column and row from the middle         | px     | d = (cos theta, -u sin theta/rho, -v ../rho) |
| d        | direction of a pixel                   | 1      |                                              |
| d_u, d_v | its derivatives                        | 1/px   |                                              |

Frames of the eyes: x forward, y left, z up. Row 0 is the top, column 0 the left. Grey levels 0..255.
Source: sec. 3.1 and 4 of the paper for the cameras; the rendering method is our own.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from lgmdjax.body.robot_xml import Offset
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.sensors import antialiasing, compositing, hemifield, silhouettes
from lgmdjax.sensors.fusion import materialise
from lgmdjax.sensors.settings import check_field
from lgmdjax.world.arena import Arena
from lgmdjax.world.texture import WAVES

AnyArray = Array | np.ndarray

_TILE_SIZE = (math.radians(4.3), math.radians(8.6))
"""Approximate height and width of a tile [rad]: small tiles hold few prisms, large ones make long loops."""
_COARSE_RESOLUTION = 25.0
"""Below this resolution [px/rad] tiles are at least 2 x 4 pixels, above it 4 x 8, which are twice as fast."""


MAX_SIZE = 4096
"""Largest width and height of an image [px]: at the paper's field of view, a pair takes about half a gigabyte."""


@struct.dataclass(kw_only=True, frozen=True)
class Params(NotebookTable):
    """Structure of the camera, all of it static. Raises InputError for impossible values.

    >>> image_shape(Params(width=80, height=60, overlap=0.5))
    (2, 60, 40)
    """

    width: int = struct.field(pytree_node=False, default=320)
    height: int = struct.field(pytree_node=False, default=240)
    fov: float = struct.field(pytree_node=False, default=math.radians(170.0))
    """Field of view over the whole width [rad]."""
    overlap: float = struct.field(pytree_node=False, default=1.0)
    """Fraction of the width that each eye renders, from its own side: 0.5 (its half) .. 1 (all)."""
    ground: float = struct.field(pytree_node=False, default=0.0)
    """Fraction of the height, at the bottom, that no eye renders: 0 (none) .. less than 1."""
    samples: int = struct.field(pytree_node=False, default=1)
    """Rays per pixel along each side; one is enough, since a ray represents an area."""
    tile_capacity: int = struct.field(pytree_node=False, default=6)
    """Number of prisms that a tile holds, the nearest ones (`max_tile_occupancy` counts how many there are)."""
    bands: int = struct.field(pytree_node=False, default=3)
    """Number of texture scales, each less than half of the one before."""
    mounts: tuple[Offset, Offset] | None = struct.field(pytree_node=False, default=None)
    """Where the eyes sit in the trunk's frame [m], left first; where those of the package's robot do if None."""

    def __post_init__(self) -> None:
        for name in ("width", "height", "samples", "tile_capacity", "bands"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(f"expected camera {name} as a whole number above 0, got {value!r}; change it")
        if max(self.width, self.height) > MAX_SIZE:
            raise InputError(
                f"expected camera images of at most {MAX_SIZE} px each way, got {self.width} x {self.height}; "
                "choose a smaller width"
            )
        if self.bands > len(WAVES):
            raise InputError(f"expected at most {len(WAVES)} texture bands, got {self.bands}; lower camera bands")
        check_field(overlap=self.overlap, ground=self.ground)
        if not 0.0 < self.fov * math.hypot(1.0, self.height / self.width) < 2.0 * math.pi:
            raise InputError(
                f"expected a camera fov above 0 with corners less than pi rad from the middle, got {self.fov!r} rad "
                f"over {self.width} x {self.height} pixels; lower fov or height"
            )


def image_shape(params: Params) -> tuple[int, int, int]:
    """Return the shape of a stereo pair: eyes, rows, columns."""
    rows = hemifield.row_count(params.height, params.ground)
    return 2, rows, hemifield.column_count(params.width, params.overlap)


def render(
    params: Params,
    arena: Arena,
    positions: Float[AnyArray, "2 3"],
    rotations: Float[AnyArray, "2 3 3"] | Float[AnyArray, "3 3"],
) -> Float[Array, "2 height columns"]:
    """Render the images of the left and the right eye, in grey levels 0..255.

    Images have the columns of each eye's hemifield (`hemifield.crop`): with an `overlap` below 1 the left image has the
    first columns and the right image the last ones, and neither has the rows of the `ground`.

    Gradient: through the coverage of outlines and through depths and textures; zero through the choice of prisms that
    a tile holds.

    Args:
        params: of the camera.
        arena: the room.
        positions: of the left and the right eye [m].
        rotations: from each eye's frame to the world frame, or one for both eyes.
    """
    stereo, positions = _stereo_rays(params), jnp.asarray(positions)
    grey = jax.vmap(functools.partial(_render_eye, params, arena), in_axes=(0, 0, stereo.axis))(
        positions, jnp.broadcast_to(rotations, (2, 3, 3)), stereo.as_arrays(positions.dtype)
    )
    # Otherwise every loop that reads the image would render it again.
    return materialise(_assemble_images(params, grey), positions[0, 0])


def max_tile_occupancy(
    params: Params,
    arena: Arena,
    positions: Float[AnyArray, "2 3"],
    rotations: Float[AnyArray, "2 3 3"] | Float[AnyArray, "3 3"],
) -> Int[Array, ""]:
    """Count the prisms that may be visible in the fullest tile of a stereo pair.

    With a `tile_capacity` of at least this number, `render` leaves no prism out.
    """
    stereo = _stereo_rays(params)
    visible = jax.vmap(lambda *eye: _visible_prisms(arena, *eye)[1], in_axes=(0, 0, stereo.axis))(
        positions, jnp.broadcast_to(rotations, (2, 3, 3)), stereo.as_arrays(positions.dtype)
    )
    return jnp.max(jnp.sum(visible, axis=-1))


class _TiledRays(NamedTuple):
    """The rays of an eye in its own frame, (3, tiles, pixels), and cones that bound the tiles.

    A tile is wider than high, and several cones side by side bound it, (tiles, cones): a single cone would be too high.
    """

    d: Array
    d_u: Array
    d_v: Array
    axes: Array
    radii: Array


class _StereoRays(NamedTuple):
    """The rays of both eyes on the host, stacked along `axis` 0; not stacked (`axis` None) if they are the same."""

    rays: tuple[np.ndarray, ...]
    axis: int | None

    def as_arrays(self, dtype: jnp.dtype) -> _TiledRays:
        return _TiledRays(*(jnp.asarray(a, dtype) for a in self.rays))


@functools.lru_cache(maxsize=32)
def _stereo_rays(params: Params) -> _StereoRays:
    columns = image_shape(params)[2]
    if columns == params.width:
        return _StereoRays(_tiled_rays(params, 0), None)
    both = _tiled_rays(params, 0), _tiled_rays(params, params.width - columns)
    return _StereoRays(tuple(np.stack(pair) for pair in zip(*both, strict=True)), 0)


def _tiled_rays(params: Params, first_column: int) -> tuple[np.ndarray, ...]:
    """Return the fields of `_TiledRays` from a column on; where tiles do not fit, some rays are outside the image."""
    n, f = params.samples, _focal_length(params)
    rows, columns, high, wide = _tile_layout(params)
    v, u = np.mgrid[: rows * high, : columns * wide] + 0.5
    pixels = equidistant_directions(u + n * first_column - 0.5 * n * params.width, v - 0.5 * n * params.height, f)
    d, d_u, d_v = (np.swapaxes(a.reshape(3, rows, high, columns, wide), 2, 3) for a in pixels)
    size = min(high, wide)
    parts = d[..., np.linspace(0, wide - size, -(-wide // size)).astype(int)[:, None] + np.arange(size)]
    axes = parts.sum(axis=(3, 5))
    axes /= np.linalg.norm(axes, axis=0)
    cosines = np.einsum("archpw,arcp->rchpw", parts, axes).min(axis=(2, 4))
    # A pixel extends beyond its ray by half a diagonal.
    radii = np.arccos(np.clip(cosines, -1.0, 1.0)) + 0.75 / f
    tiles = rows * columns
    d, d_u, d_v = (a.reshape(3, tiles, -1) for a in (d, d_u, d_v))
    return d, d_u, d_v, np.moveaxis(axes, 0, -1).reshape(tiles, -1, 3), radii.reshape(tiles, -1)


def _focal_length(params: Params) -> float:
    """Return f in rays per radian."""
    return params.samples * params.width / params.fov


def _tile_layout(params: Params) -> tuple[int, int, int, int]:
    """Return the numbers of rows and columns of tiles, and of rows and columns of rays in each tile."""
    (_, height, columns), n, f = image_shape(params), params.samples, _focal_length(params)
    minimum = 2 if f < _COARSE_RESOLUTION else 4
    high = tile_size(height * n, _TILE_SIZE[0] * f, minimum)
    wide = tile_size(columns * n, _TILE_SIZE[1] * f, 2 * minimum)
    return -(-height * n // high), -(-columns * n // wide), high, wide


def tile_size(length: int, target: float, minimum: int) -> int:
    """Return the divisor of `length` [px] that is nearest to `target` or to `minimum`, whichever is larger.

    Where no divisor is within a factor of two, that size itself is returned, and the tiles extend beyond the image.

    >>> tile_size(240, 7.0, 4)
    8
    """
    target = max(minimum, round(target))
    sizes = [size for size in range(-(-target // 2), 2 * target + 1) if length % size == 0]
    return min(sizes, key=lambda size: abs(math.log(size / target)), default=target)


def equidistant_directions(u: np.ndarray, v: np.ndarray, f: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the directions of pixels (u, v) from the middle, and their derivatives by u and by v."""
    rho = np.maximum(np.hypot(u, v), 1e-9)
    theta = rho / f
    spread = np.sin(theta) / rho
    change = (np.cos(theta) / f - spread) / rho**2
    d = np.stack([np.cos(theta), -spread * u, -spread * v])
    d_u = np.stack([-spread * u / f, -spread - change * u * u, -change * u * v])
    d_v = np.stack([-spread * v / f, -change * u * v, -spread - change * v * v])
    return d, d_u, d_v


def _visible_prisms(
    arena: Arena, position: Array, rotation: Array, rays: _TiledRays
) -> tuple[silhouettes.Silhouette, Bool[Array, "tiles prisms"]]:
    """Return the silhouettes of all prisms, and which of them may be visible in which tile."""
    prisms, bounds = silhouettes.project_prisms(arena, position)
    visible = silhouettes.may_be_visible(prisms, bounds, rays.axes @ rotation.T, rays.radii)
    return prisms, jnp.any(visible, axis=1)


def _render_eye(
    params: Params, arena: Arena, position: Array, rotation: Array, rays: _TiledRays
) -> Float[Array, "tiles pixels"]:
    """Render one eye. Pixels of a tile are contiguous, so that XLA's loop over them reads the tile's prisms once."""
    prisms, visible = _visible_prisms(arena, position, rotation, rays)
    nearest = silhouettes.select_nearest(prisms, visible, params.tile_capacity)
    nearest = jax.tree.map(lambda a: a[:, None], nearest)

    def to_world(d: Array) -> tuple[Array, Array, Array]:
        x, y, z = (rotation[i, 0] * d[0] + rotation[i, 1] * d[1] + rotation[i, 2] * d[2] for i in range(3))
        return x, y, z

    pixels = antialiasing.pixel_rays(to_world(rays.d), to_world(rays.d_u), to_world(rays.d_v))
    return compositing.composite(arena, position, pixels, nearest, params.bands)


def _assemble_images(params: Params, grey: Array) -> Array:
    """Join the tiles of both eyes, crop them to the image, and average the samples of each pixel."""
    (eyes, height, columns), n = image_shape(params), params.samples
    tile_rows, tile_columns, high, wide = _tile_layout(params)
    lines = jnp.swapaxes(grey.reshape(eyes, tile_rows, tile_columns, high, wide), 2, 3)
    images = lines.reshape(eyes, tile_rows * high, tile_columns * wide)[:, : height * n, : columns * n]
    return images if n == 1 else jnp.mean(images.reshape(eyes, height, n, columns, n), axis=(2, 4))
