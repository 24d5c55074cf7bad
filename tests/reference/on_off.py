"""The LGMD1 and LGMD2 of Fu, Yue et al. in NumPy, cell by cell: ON and OFF channels, delays, adaptation."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
from reference.lgmd1_grouping import grouped, spread

FRAME_TIME = 1 / 30


def blend(time_constant: float) -> float:
    return FRAME_TIME / (FRAME_TIME + time_constant)


def delayed_sum(before: np.ndarray, now: np.ndarray, weights: list[float], delays: list[float]) -> np.ndarray:
    """Return the sum over 3 x 3 cells whose weights and delays are those of (own, nearest, diagonal)."""
    h, w = now.shape
    out = np.zeros((h, w))
    for y in range(h):
        for x in range(w):
            for j in (-1, 0, 1):
                for i in (-1, 0, 1):
                    row, column = min(max(y + j, 0), h - 1), min(max(x + i, 0), w - 1)
                    distance = abs(i) + abs(j)
                    a = blend(delays[distance])
                    value = a * now[row, column] + (1 - a) * before[row, column]
                    out[y, x] += weights[distance] * value
    return out


def adapted(u_before: float, k_before: float, k: float, time_constant: float, threshold: float) -> float:
    h = time_constant / (time_constant + FRAME_TIME)
    if k - k_before <= threshold:
        return max(h * (u_before + (k - k_before)), 0.5)
    return max(h * k, 0.5)


class Channels:
    """ON and OFF activity with a residual of 0.1."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.on, self.off = np.zeros(shape), np.zeros(shape)

    def next(self, P: np.ndarray) -> "Channels":
        new = Channels(P.shape)
        for index, p in np.ndenumerate(P):
            new.on[index] = (p if p > 0 else 0) + 0.1 * self.on[index]
            new.off[index] = (-p if p < 0 else 0) + 0.1 * self.off[index]
        return new


def lgmd1_onoff(frames: np.ndarray, threshold: float, suppression: float, joint: float) -> list[dict[str, Any]]:
    channels, F, k_before, u = Channels(frames[0].shape), 0.0, 0.5, 0.5
    weights, delays = [0, 0.25, 0.125], [1.0, 0.03, 0.06]
    out = []
    for L_before, L in pairwise(frames):
        P = L - L_before
        F = blend(0.09) * np.abs(P).mean() + (1 - blend(0.09)) * F
        now = channels.next(P)
        S_on = now.on - 0.5 * delayed_sum(channels.on, now.on, weights, delays)
        S_off = delayed_sum(channels.off, now.off, weights, delays) - 1.0 * now.off
        S = S_on + S_off + joint * S_on * S_off
        S[threshold > S] = 0
        K = spread(S, np.full((3, 3), 1 / 9)).mean()
        k = 1 / (1 + math.exp(-K))
        u = adapted(u, k_before, k, 0.5, 0.005)
        if suppression <= F:
            k = u = 0.5
        out.append({"u": u, "potential": k, "excitation": K, "feed_forward": F})
        channels, k_before = now, k
    return out


def lgmd2(frames: np.ndarray) -> list[dict[str, Any]]:
    channels, PM, k_before, u = Channels(frames[0].shape), 0.0, 0.5, 0.5
    out = []
    for L_before, L in pairwise(frames):
        P = L - L_before
        PM = blend(0.09) * np.abs(P).mean() + (1 - blend(0.09)) * PM
        now = channels.next(P)
        I_on = delayed_sum(channels.on, now.on, [2, 0.5, 0.25], [0.015, 0.03, 0.045])
        I_off = delayed_sum(channels.off, now.off, [1, 0.25, 0.125], [0.06, 0.12, 0.18])
        S_on = np.maximum(now.on - max(PM / 8, 1.0) * I_on, 0)
        S_off = np.maximum(now.off - max(PM / 8, 0.5) * I_off, 0)
        G = grouped(S_on + S_off + S_on * S_off)
        K = sum(g for g in G.ravel() if g * 0.5 >= 15) / G.size
        k = 1 / (1 + math.exp(-K))
        u = adapted(u, k_before, k, 0.8, 0.003)
        out.append({"u": u, "potential": k, "excitation": K, "mediation": PM})
        channels, k_before = now, k
    return out
