"""Four direction selective networks in NumPy, cell by cell."""

import math

import numpy as np

STEPS = {"left": (0, -1), "right": (0, 1), "up": (-1, 0), "down": (1, 0)}


def dsn(frames, W_I=3.0, decay=0.8, T_s=12.0, T_FFI=25.0, reach=4, delay=1):
    h, w = frames[0].shape
    P = [np.zeros((h, w)) for _ in range(delay + 1)]
    total = sum(decay ** (i - 1) for i in range(1, reach + 1))
    out = []
    for k in range(1, len(frames)):
        P.append(np.abs(frames[k] - frames[k - 1]))
        K = []
        for dy, dx in STEPS.values():
            summed = 0.0
            for y in range(h):
                for x in range(w):
                    inhibition = 0.0
                    for i in range(1, reach + 1):
                        row, column = y - i * dy, x - i * dx
                        if 0 <= row < h and 0 <= column < w:
                            inhibition += decay ** (i - 1) / total * P[-1 - delay][row, column]
                    S = P[-1][y, x] - W_I * inhibition
                    summed += S if T_s <= S else 0.0
            K.append(summed / (h * w))
        E = math.prod(K) ** 0.25
        F = P[-2].mean()
        out.append(
            {
                "u": 1 / (1 + math.exp(-E)) if F < T_FFI else 0.5,
                "excitation": E,
                "feed_forward": F,
                "networks": np.array(K),
            }
        )
    return out
