"""The detectors equal what `benchmarks/detectors_by_hand.py` computes with OpenCV."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import clips
import numpy as np
import pytest

from lgmdjax.detectors import lgmd1_grouping, lgmd1_onoff

FILE = Path(__file__).parents[2] / "benchmarks" / "detectors_by_hand.py"
_spec = importlib.util.spec_from_file_location(FILE.stem, FILE)
assert _spec is not None and _spec.loader is not None
detectors_by_hand = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(detectors_by_hand)
BY_HAND = detectors_by_hand.BY_HAND
CASES = [
    *((detector, {}) for detector in BY_HAND),
    # Terms that are left out by hand where their weight is zero, as it is by default.
    (lgmd1_grouping, {"persistence": 0.3}),
    (lgmd1_onoff, {"joint_weight": 0.1}),
]


def approach(height: int, width: int) -> np.ndarray:
    """Return frames of a dark square that grows before faint blobs, then of strong blobs, which close the gates."""
    frames = clips.blobs(17, 8.0, height, width)
    for frame, n in zip(frames[:12], np.geomspace(1, height // 2, 12).astype(int), strict=True):
        frame[height // 2 - n : height // 2 + n, width // 2 - n : width // 2 + n] = 10.0
    frames[12:] = clips.blobs(5, 100.0, height, width)
    return frames.astype(np.float32)


@pytest.mark.parametrize(
    ("detector", "constants"), CASES, ids=[detector.__name__.rpartition(".")[2] for detector, _ in CASES]
)
def test_equals_opencv(detector, constants):
    """With an even number of rows and an odd number of columns, since some detectors divide the frame in halves."""
    params, frames = replace(detector.Params(), **constants), approach(24, 33)
    step = BY_HAND[detector](params, frames[0])
    expected = [dict(zip(("u", "excitation"), step(frame), strict=True)) for frame in frames[1:]]
    clips.assert_equals_reference(clips.respond(detector, params, frames), expected, ("u", "excitation"))
