"""Correlation detectors in NumPy, cell by cell: EMD, regressive motion, and the outward motion of LPLC2."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

DT, TAU, TAU_H = 1 / 30, 0.05, 0.25


def signals(frames: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the high-passed signal and its delayed copy for each frame after the first."""
    H, D = np.zeros(frames[0].shape), np.zeros(frames[0].shape)
    for k in range(1, len(frames)):
        change = (frames[k] - frames[k - 1]) / 255
        H = TAU_H / (DT + TAU_H) * (H + change)
        D = D + DT / (DT + TAU) * (H - D)
        yield H, D


def motion(H: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return motion to the right, between columns, and upward, between rows."""
    h, w = H.shape
    right, up = np.zeros((h, w - 1)), np.zeros((h - 1, w))
    for y in range(h):
        for x in range(w - 1):
            right[y, x] = D[y, x] * H[y, x + 1] - H[y, x] * D[y, x + 1]
    for y in range(h - 1):
        for x in range(w):
            up[y, x] = D[y + 1, x] * H[y, x] - H[y + 1, x] * D[y, x]
    return right, up


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def emd(frames: np.ndarray) -> list[dict[str, Any]]:
    out = []
    for H, D in signals(frames):
        right, up = motion(H, D)
        total = 0.0
        for (_, x), r in np.ndenumerate(right):
            total += np.sign(2 * x - (right.shape[1] - 1)) * r / right.size
        for (y, _), v in np.ndenumerate(up):
            total += np.sign((up.shape[0] - 1) - 2 * y) * v / up.size
        E = max(total, 0.0)
        out.append({"u": sigmoid(1000 * E), "excitation": E, "rightward": right.mean(), "upward": up.mean()})
    return out


def grm(frames: np.ndarray) -> list[dict[str, Any]]:
    out = []
    for H, D in signals(frames):
        right, _ = motion(H, D)
        half = right.shape[1] // 2
        left_sum = sum(max(r, 0) for (_, x), r in np.ndenumerate(right) if x < half)
        right_sum = sum(max(-r, 0) for (_, x), r in np.ndenumerate(right) if x >= right.shape[1] - half)
        left, right_side = left_sum / (half * right.shape[0]), right_sum / (half * right.shape[0])
        E = left + right_side
        out.append({"u": sigmoid(1000 * E), "excitation": E, "left": left, "right": right_side})
    return out


def in_sector(i: int, j: int, direction: str, size: int) -> bool:
    """Return whether an offset (columns right, rows up) is in the sector of a direction."""
    along, across = {"right": (i, j), "left": (-i, j), "up": (j, i), "down": (-j, i)}[direction]
    return along > 0 and abs(across) <= along and math.hypot(i, j) <= size / 2


OPPOSITE = {"right": "left", "left": "right", "up": "down", "down": "up"}


def lplc2(frames: np.ndarray, size: int = 5, stride: int = 2, b_e: float = -1.0) -> list[dict[str, Any]]:
    reach, out = size // 2, []
    offsets = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
    count = sum(in_sector(i, j, "right", size) for i, j in offsets)
    for H, D in signals(frames):
        right, up = motion(H, D)
        right, up = 100 * (right[:-1] + right[1:]) / 2, 100 * (up[:, :-1] + up[:, 1:]) / 2
        fields = {"right": right, "left": -right, "up": up, "down": -up}
        h, w = right.shape
        responses = []
        for y in range(0, h, stride):
            for x in range(0, w, stride):
                response = b_e
                for direction, field in fields.items():
                    excited = inhibited = 0.0
                    for i, j in offsets:
                        row, column = y - j, x + i
                        if 0 <= row < h and 0 <= column < w:
                            moved = max(field[row, column], 0) / count
                            excited += moved if in_sector(i, j, direction, size) else 0
                            inhibited += moved if in_sector(i, j, OPPOSITE[direction], size) else 0
                    response += excited - max(inhibited, 0)
                responses.append(max(response, 0))
        E = float(np.mean(responses))
        out.append({"u": sigmoid(10 * E), "excitation": E})
    return out
