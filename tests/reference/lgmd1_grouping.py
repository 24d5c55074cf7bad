"""Yue & Rind 2006 in NumPy, cell by cell: grouping layer and feed-forward inhibition."""

import math
from typing import Any

import numpy as np

W_LOCAL = np.array([[0.125, 0.25, 0.125], [0.25, 0.0, 0.25], [0.125, 0.25, 0.125]])
W_GROUP = np.full((3, 3), 1 / 9)


def spread(layer: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted sum over 3 x 3 cells; beyond the border is the nearest cell."""
    h, w = layer.shape
    out = np.zeros((h, w))
    for y in range(h):
        for x in range(w):
            for j in (-1, 0, 1):
                for i in (-1, 0, 1):
                    row, column = min(max(y + j, 0), h - 1), min(max(x + i, 0), w - 1)
                    out[y, x] += layer[row, column] * weights[j + 1, i + 1]
    return out


def grouped(S: np.ndarray, C_w: float = 4.0, offset: float = 0.01) -> np.ndarray:
    """Return S Ce / w."""
    Ce = spread(S, W_GROUP)
    scale = offset + max(abs(value) for value in Ce.ravel()) / C_w
    return S * Ce / scale


def lgmd1_grouping(
    frames: np.ndarray, suppression: float = 10.0, persistence: float = 0.0, magnitudes: bool = False
) -> list[dict[str, Any]]:
    """Run the model over a sequence of frames; nothing changed before the first."""
    L_before, P_before = frames[0], np.zeros(frames[0].shape)
    out = []
    for L in frames[1:]:
        P = persistence * P_before + (L - L_before)
        I = spread(P_before, W_LOCAL)  # noqa: E741
        S = np.abs(P) - 0.6 * np.abs(I) if magnitudes else P - 0.6 * I
        G = grouped(S)
        K = 0.0
        for value in G.ravel():
            K += abs(value) if value * 0.5 >= 15.0 else 0.0
        F = np.abs(P_before).sum() / P.size
        u = 0.5 if suppression <= F else 1 / (1 + math.exp(-K / P.size))
        out.append({"u": u, "excitation": K / P.size, "feed_forward": F})
        L_before, P_before = L, P
    return out
