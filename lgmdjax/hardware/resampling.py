"""Resample pictures of a real camera to the eye with which the network was trained.

Each pixel of the eye, an equidistant fisheye, is the mean of the camera's picture over the pixel's solid angle. Rays
are cast through a grid of points in the pixel, which is finer than the camera's pixels, and each ray interpolates the
picture between its four nearest pixels. The result is linear in the picture: one sparse matrix, which is computed once.
Parts of the eye that the camera does not see have a constant grey, so that nothing moves there.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy import sparse

from lgmdjax.errors import InputError
from lgmdjax.hardware import lens
from lgmdjax.hardware.lens import Lens
from lgmdjax.sensors import camera

GREY = 128.0  # of pixels that the camera does not see
MAX_RAYS = 12  # along each side of a pixel
MIN_SEEN = 0.25  # fraction of the eye's picture


@dataclass(frozen=True)
class Resampler:
    """The matrix from the camera's pixels to the eye's, and the grey of those that the camera does not see."""

    weights: sparse.csr_array
    constant: Float[np.ndarray, "pixels"]
    source: tuple[int, int]  # px, width and height of the camera's pictures
    shape: tuple[int, int]  # rows and columns of the eye's picture
    seen: float  # fraction of the eye's picture that the camera sees

    def __call__(self, picture: UInt8[np.ndarray, "height width"]) -> UInt8[np.ndarray, "rows columns"]:
        """Return the eye's picture."""
        grey = self.weights @ picture.reshape(-1).astype(np.float32) + self.constant
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(self.shape)


def from_lens(calibrated: Lens, eye: camera.Params) -> Resampler:
    """Return the resampler from a calibrated camera to an eye.

    Raises InputError if the camera sees less than a quarter of the eye's picture.
    """
    n = _rays_a_side(calibrated, eye)
    v, u = (np.mgrid[: n * eye.height, : n * eye.width] + 0.5) / n
    directions, _, _ = camera.equidistant_directions(u - 0.5 * eye.width, v - 0.5 * eye.height, eye.width / eye.fov)
    forward, left, up = directions
    points, seen = lens.project(calibrated, np.stack([-left, -up, forward]))
    width, height = calibrated.size
    seen &= (points[0] >= -0.5) & (points[0] <= width - 0.5) & (points[1] >= -0.5) & (points[1] <= height - 0.5)
    pixels = np.arange(eye.height * eye.width).reshape(eye.height, eye.width).repeat(n, 0).repeat(n, 1)
    return _assemble(points[:, seen], pixels[seen], calibrated.size, eye)


def from_same_lens(size: tuple[int, int], eye: camera.Params) -> Resampler:
    """Return the resampler from a camera with the eye's own lens, whose pictures may be larger.

    Raises InputError for pictures of another aspect ratio.
    """
    width, height = size
    if width * eye.height != height * eye.width or width < eye.width:
        raise InputError(
            f"expected pictures of {eye.width} x {eye.height} px, or larger in this aspect ratio, got "
            f"{width} x {height} without a --calibration; calibrate the camera with `lgmdjax calibrate-camera`"
        )
    n = -(-width // eye.width)  # rays at the centres of the camera's pixels if the ratio is whole
    v, u = (np.mgrid[: n * eye.height, : n * eye.width] + 0.5) / n
    scale = width / eye.width
    points = np.stack([scale * u - 0.5, scale * v - 0.5]).reshape(2, -1)
    pixels = np.arange(eye.height * eye.width).reshape(eye.height, eye.width).repeat(n, 0).repeat(n, 1)
    return _assemble(points, pixels.reshape(-1), size, eye)


def _rays_a_side(calibrated: Lens, eye: camera.Params) -> int:
    """Return the number of rays along a side of a pixel that makes them denser than the camera's central pixels."""
    focal = max(calibrated.K[0, 0], calibrated.K[1, 1])
    return int(np.clip(np.ceil(focal * eye.fov / eye.width), 2, MAX_RAYS))


def _assemble(
    points: Float[np.ndarray, "2 rays"], pixels: np.ndarray, size: tuple[int, int], eye: camera.Params
) -> Resampler:
    """Return the resampler for rays that read the picture at `points`, each for one of the eye's pixels."""
    width, height = size
    corner = np.floor(points).astype(int)
    part = points - corner
    rows, columns, values = [], [], []
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = np.clip(corner[0] + dx, 0, width - 1), np.clip(corner[1] + dy, 0, height - 1)
        rows.append(pixels)
        columns.append(y * width + x)
        values.append((part[0] if dx else 1 - part[0]) * (part[1] if dy else 1 - part[1]))
    count = eye.width * eye.height
    rays = np.bincount(pixels, minlength=count)
    weights = np.concatenate(values) / np.maximum(rays, 1)[np.concatenate(rows)]
    matrix = sparse.csr_array(
        (weights.astype(np.float32), (np.concatenate(rows), np.concatenate(columns))), shape=(count, width * height)
    )
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    seen = float(np.mean(rays > 0))
    if seen < MIN_SEEN:
        raise InputError(
            f"expected a camera that sees a quarter of the eye's picture, got {100 * seen:.0f} %; use a wider lens"
        )
    return Resampler(matrix, np.where(rays > 0, 0.0, GREY), size, (eye.height, eye.width), seen)
