"""D-LGMD of Zhao et al. in NumPy, cell by cell: distributed excitation and inhibition, latency, grouping."""

import math
from typing import Any

import numpy as np

S_E, S_I, A = 1.0, 5.0, 1.5
ALPHA, BETA, LAMBDA = -0.1, 0.5, 0.7
R = 6


def gauss(r2: float, sigma: float) -> float:
    return math.exp(-r2 / (2 * sigma**2)) / (sigma * math.sqrt(2 * math.pi))


def latency(r2: float) -> float:
    return ALPHA + 1 / (BETA + math.exp(-(LAMBDA**2) * r2))


def at(layer: np.ndarray, y: int, x: int) -> float:
    h, w = layer.shape
    return layer[y, x] if 0 <= y < h and 0 <= x < w else 0.0


def summation(P: list[np.ndarray], interpolated: bool) -> np.ndarray:
    """Return S; P holds the present change and the last two."""
    S = np.zeros(P[0].shape)
    for (y, x), _ in np.ndenumerate(S):
        total = 0.0
        for j in range(-R, R + 1):
            for i in range(-R, R + 1):
                r2 = i * i + j * j
                tau, inhibition = latency(r2), A * gauss(r2, S_I)
                n = math.floor(tau)
                part = tau - n if interpolated else 0.0
                shares = {n: 1 - part, n + 1: part}
                now = gauss(r2, S_E) - shares.get(0, 0.0) * inhibition
                total += max(now, 0.0) * at(P[0], y + j, x + i)
                for frames in (1, 2):
                    total -= shares.get(frames, 0.0) * inhibition * at(P[frames], y + j, x + i)
        S[y, x] = max(total, 0.0)
    return S


def d_lgmd(frames: np.ndarray, threshold: float = 0.5, interpolated: bool = False) -> list[dict[str, Any]]:
    changes = [np.zeros(frames[0].shape)] * 2
    out = []
    for k in range(1, len(frames)):
        P = np.abs(frames[k] - frames[k - 1]) / 255
        S = summation([P, *changes], interpolated)
        F = changes[1].mean()
        limit, K = min(threshold * F, 0.3), 0.0
        for (y, x), s in np.ndenumerate(S):
            # The even kernel of 4 x 4 cells: one cell before, two after.
            Ce = sum(at(S, y + j, x + i) for j in range(-1, 3) for i in range(-1, 3)) / 16
            K += min(s * Ce, 1.0) if s * Ce >= limit else 0.0
        K /= S.size
        out.append({"u": 1 / (1 + math.exp(-255 * K)), "excitation": K, "feed_forward": F})
        changes = [P, changes[0]]
    return out
