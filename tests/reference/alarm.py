"""The alarm in NumPy: every running mean as a weighted sum over all frames so far."""

import numpy as np


def weighted_mean(values, moved, tau, dt=1 / 30):
    """Return the mean of the values in frames that moved, each newer one weighted exp(dt / tau) times as much."""
    seen = np.asarray(values)[np.asarray(moved, bool)]
    if not len(seen):
        return 0.0
    weights = np.exp(-dt / tau * np.arange(len(seen))[::-1])
    return float(np.sum(weights * seen) / np.sum(weights))


def alarm(frames, excitation, fast=0.3, slow=3.0, threshold=0.6, persistence=0.1, dt=1 / 30, block=1):
    """Return A, w and the alarm for each frame after the first; frames are multiples of a block."""
    n, height, width = frames.shape
    blocks = frames.reshape(n, height // block, block, width // block, block).mean((2, 4))
    M, D, moved, e, out = [], [], [], [], []
    for k in range(1, n):
        P = blocks[k] - blocks[k - 1]
        M.append(np.abs(P).mean())
        D.append(np.median(P))
        moved.append(M[-1] > 1e-3)
        change = weighted_mean(M, moved, fast, dt)
        w = min(abs(weighted_mean(D, moved, fast, dt)) / change, 1.0) if change > 0 else 0.0
        e.append((1 - w) * excitation[k])
        recent, before = weighted_mean(e, moved, fast, dt), weighted_mean(e, moved, slow, dt)
        A = recent / (recent + before) if recent + before > 0 else 0.5
        needed = max(round(persistence / dt), 1)
        last = [row["adapted"] for row in out[len(out) - needed + 1 :]] if needed > 1 else []
        is_alarm = len(last) == needed - 1 and min([A, *last]) >= threshold
        out.append({"adapted": A, "whole_field": w, "alarm": float(is_alarm)})
    return out
