"""Statistics of features, with which LeRobot normalises: extremes, mean, standard deviation, quantiles, count."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int, Shaped, UInt8

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
LEVELS = 256  # grey levels of a picture

Statistics = Mapping[str, np.ndarray]
"""Arrays by the names of the statistics: min, max, mean, std, count, q01 .. q99."""


def of_values(values: Shaped[np.ndarray, "frames size"]) -> Statistics:
    """Return the statistics of each component over the frames.

    >>> {name: value.tolist() for name, value in of_values(np.array([[0.0], [1.0], [2.0]])).items()}["mean"]
    [1.0]
    """
    values = np.asarray(values, float)
    quantiles = np.quantile(values, QUANTILES, axis=0)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)]),
        **{f"q{round(100 * q):02d}": value for q, value in zip(QUANTILES, quantiles, strict=True)},
    }


def histogram(pictures: UInt8[np.ndarray, "frames height width"]) -> Int[np.ndarray, " levels"]:
    """Count the pixels of each grey level."""
    return np.bincount(pictures.ravel(), minlength=LEVELS)


def of_pictures(counts: Int[np.ndarray, " levels"], frames: int) -> Statistics:
    """Return the statistics of a histogram's pixels, scaled to 0..1, of three equal channels: shape (3, 1, 1).

    >>> of_pictures(np.bincount([0, 255], minlength=LEVELS), frames=1)["mean"].ravel().tolist()
    [0.5, 0.5, 0.5]
    """
    levels = np.arange(LEVELS) / (LEVELS - 1)
    present, total = np.flatnonzero(counts), counts.sum()
    mean = float(levels @ counts) / total
    below = np.cumsum(counts) / total
    found = {
        "min": levels[present[0]],
        "max": levels[present[-1]],
        "mean": mean,
        "std": np.sqrt(float((levels - mean) ** 2 @ counts) / total),
        **{f"q{round(100 * q):02d}": levels[np.searchsorted(below, q)] for q in QUANTILES},
    }
    return {name: np.full((3, 1, 1), value) for name, value in found.items()} | {"count": np.array([frames])}
