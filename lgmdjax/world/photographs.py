"""Photographs and noise as textures: brick, grass and gravel, and noise whose amplitude falls as 1/f.

The photographs come with scikit-image, in the extra `photographs`. Textures are repeated over a surface. Each
photograph is therefore mirrored at its right and lower edge, so that no seam is visible. Noise of amplitude 1/f (power
1/f^2) has the spectrum of natural scenes (Field 1987, J. Opt. Soc. Am. A 4, 2379); it is periodic and needs no
mirroring.
"""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from lgmdjax.errors import InputError

try:
    from skimage import data as photographs
except ImportError:  # the extra is not installed
    photographs = None

TextureName = Literal["brick", "grass", "gravel", "noise"]
NAMES: tuple[TextureName, ...] = get_args(TextureName)
SIZE = 512  # px, width of a texture; a photograph is averaged down to half of it and mirrored
MEAN, DEVIATION = 118.0, 32.0  # grey, of the noise: averages over the three photographs


def load(name: TextureName) -> UInt8[np.ndarray, "size size"]:
    """Return a texture that can be repeated, in grey levels.

    >>> load("noise").shape
    (512, 512)

    Raises InputError for a photograph if scikit-image is not installed.
    """
    if name == "noise":
        noise = pink_noise(np.random.default_rng(0), SIZE)
        return np.clip(np.round(MEAN + DEVIATION * noise), 0, 255).astype(np.uint8)
    if photographs is None:
        raise InputError(f"expected scikit-image for the photograph {name}, got none; pip install lgmdjax[photographs]")
    whole = np.asarray(getattr(photographs, name)(), float)
    half = SIZE // 2
    mean = whole.reshape(half, whole.shape[0] // half, half, -1).mean(axis=(1, 3)).round().astype(np.uint8)
    return np.block([[mean, mean[:, ::-1]], [mean[::-1], mean[::-1, ::-1]]])


def pink_noise(rng: np.random.Generator, size: int) -> Float[np.ndarray, "size size"]:
    """Return periodic noise of amplitude 1/f in both directions, with mean 0 and standard deviation 1."""
    f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    f[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) / f, s=(size, size))
    return noise / noise.std()
