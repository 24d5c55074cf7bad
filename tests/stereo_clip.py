"""Stereo pictures for tests: a textured world that drifts past, flickers, and holds a disc that looms."""

import numpy as np
from scipy import ndimage


def record(frames: int, width: int, height: int, seed: int) -> np.ndarray:
    """Return 8-bit pictures (frames, 2, height, width); every 75 frames a disc approaches, now left, now right."""
    rng = np.random.default_rng(seed)
    texture = ndimage.gaussian_filter(rng.normal(0, 1, (height, width + frames + 20)), 2.0)
    texture *= 25 / texture.std()
    row, column = np.mgrid[:height, :width]
    pictures = np.empty((frames, 2, height, width))
    for frame in range(frames):
        distance = 2.0 - 1.7 * (frame % 75) / 75
        centre = width * (0.3 if frame // 75 % 2 else 0.7)
        disc = np.hypot(column - centre, row - height / 2) < 0.12 * width / distance
        for eye in (0, 1):
            drift = frame // 2 + 12 * eye
            pictures[frame, eye] = np.where(disc, 60, 130 + texture[:, drift : drift + width])
    pictures += rng.normal(0, 1.0, pictures.shape)
    return np.clip(np.round(pictures), 0, 255).astype(np.uint8)
