"""Eqs. 7-16 in NumPy, cell by cell, written from the paper alone."""

import math
from typing import Any

import numpy as np

W_I = np.array(
    [
        [0.06, 0.12, 0.25, 0.12, 0.06],
        [0.12, 0.06, 0.12, 0.06, 0.12],
        [0.25, 0.12, 0.00, 0.12, 0.25],
        [0.12, 0.06, 0.12, 0.06, 0.12],
        [0.06, 0.12, 0.25, 0.12, 0.06],
    ]
)


def inhibition_layer(P_before: np.ndarray) -> np.ndarray:
    """Return the inhibition of eq. 8. Cells beyond the border do not exist and inhibit no cell."""
    h, w = P_before.shape
    inhibition = np.zeros((h, w))
    for y in range(h):
        for x in range(w):
            for i in range(-2, 3):
                for j in range(-2, 3):
                    if 0 <= x + i < w and 0 <= y + j < h:
                        inhibition[y, x] += P_before[y + j, x + i] * W_I[j + 2, i + 2]
    return inhibition


def lgmd(
    frames: np.ndarray,
    threshold: float,
    suppression: float,
    inhibition: float = 0.4,
    printed_feed_forward: bool = False,
    printed_gate: bool = False,
    falloff: float = 0.0,
    outer: float = 85.0,
    inner: float = 0.0,
) -> list[dict[str, Any]]:
    """Run eqs. 7-16 over a sequence of frames. The first frame has no predecessor, and nothing changed before it.

    With a `falloff` the sums of eqs. 13 and 15 have weights by bearing, from `outer` to `inner` [degrees] across the
    frame; their number n_cell becomes the sum of the weights.
    """
    P_before, L_before = np.zeros(frames[0].shape), frames[0]
    out = []
    for L in frames[1:]:
        P = L - L_before  # eq. 7
        I = inhibition_layer(P_before)  # eq. 8  # noqa: E741
        E = np.abs(P)  # eq. 10
        S = E - np.abs(I) * inhibition  # eq. 11
        U, FF, n_cell = 0.0, 0.0, 0.0
        for (row, column), s in np.ndenumerate(S):  # eqs. 12, 13, 15
            bearing = abs(outer + (inner - outer) * (column + 0.5) / S.shape[1])
            weight = 1.0 if bearing <= 20 else (math.sin(math.radians(20)) / math.sin(math.radians(bearing))) ** falloff
            n_cell += weight
            U += weight * abs(s) if s >= threshold else 0.0
            change = P_before[row, column]
            FF += weight * (change if printed_feed_forward else abs(change))
        u = 1 / (1 + math.exp(-U / n_cell))  # eq. 14
        ff = FF / n_cell  # eq. 15
        shown = ff > suppression if printed_gate else not ff > suppression  # eq. 16
        out.append({"u": u if shown else 0.5, "feed_forward": ff, "excitation": U / n_cell, "E": E, "I": I, "S": S})
        P_before, L_before = P, L
    return out
