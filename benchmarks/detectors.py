"""Time of every looming detector for a frame, compared with the same equations by hand in OpenCV, on one core.

    python benchmarks/detectors.py [--size 80x60 320x240] [--detector lgmd emd]

| candidate | what it does                                                                                |
| --------- | ------------------------------------------------------------------------------------------- |
| calls     | one call for each frame, as on a robot                                                      |
| scan      | all frames in one program (`lax.scan`, as in a rollout)                                     |
| by hand   | OpenCV and NumPy, one call for each frame (`benchmarks/detectors_by_hand.py`)               |

All see the same frames of one eye, in turns within one run: a drifting texture, and a dark square that expands. Before
they are timed, their u and excitation are compared. As in `benchmarks/lgmd.py`, timed is the processor time of the
process, and constants are those of `Params()`, known when a program is compiled. Measure on an idle machine: JAX may
leave a call to a thread of its own and wait, and other programs that run meanwhile empty the caches.
"""

import argparse
import platform
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from types import ModuleType

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from detectors_by_hand import BY_HAND, Step
from jaxtyping import PyTree
from lgmd import FRAMES, make_frames, medians

SIZES = ("80x60", "160x120", "320x240")
ROUNDS = 20
BACKGROUND, DARK, CONTRAST = 180.0, 10.0, 0.25  # with more contrast, feed-forward inhibition would silence some
HALF_SIDES = np.geomspace(0.05, 0.5, FRAMES + 1)  # of the square, in heights of the frame
DETECTORS = {module.__name__.rpartition(".")[2]: module for module in BY_HAND}


def make_approach(width: int, height: int) -> np.ndarray:
    """Return frames of one eye in which every detector responds, at least at the end."""
    frames = BACKGROUND + CONTRAST * (make_frames(width, height)[:, 0] - 127)
    for frame, half_side in zip(frames, HALF_SIDES * height, strict=True):
        rows, columns = (np.clip(half_side + 0.5 - np.abs(np.arange(n) - (n - 1) / 2), 0, 1) for n in frame.shape)
        frame += rows[:, None] * columns * (DARK - frame)
    return frames.astype(np.float32)


def run_calls(step: Callable, state: PyTree, frames: list[jax.Array]) -> None:
    """Run a compiled detector with one call for each frame, waiting for each."""
    for frame in frames:
        state, response = step(state, frame)
        jax.block_until_ready(response.u)


def run_by_hand(step: Step, frames: np.ndarray) -> list[tuple[float, float]]:
    """Return u and the excitation for each frame."""
    return [step(frame) for frame in frames]


def assert_equal(ours: tuple[jax.Array, jax.Array], by_hand: list[tuple[float, float]]) -> None:
    """Compare u and the excitation, of which a thousandth lets a cell at a threshold fall on either side of it."""
    for ours_alone, by_hand_alone in zip(ours, np.array(by_hand).T, strict=True):
        largest = np.abs(by_hand_alone).max()
        np.testing.assert_allclose(ours_alone, by_hand_alone, rtol=1e-3, atol=1e-3 * largest)
        assert np.ptp(by_hand_alone) > 0.02 * largest, "the detector hardly responds, so the comparison says little"


def measure(detector: ModuleType, frames: np.ndarray) -> tuple[dict[str, float], float]:
    """Return the median time of a frame for each candidate [ms], and the size of the state [kB]."""
    params = detector.Params()
    step = partial(detector.step, params)

    @jax.jit
    def scan(state: PyTree, frames: jax.Array) -> tuple[jax.Array, jax.Array]:
        def respond(state: PyTree, frame: jax.Array) -> tuple[PyTree, tuple[jax.Array, jax.Array]]:
            state, response = step(state, frame)
            return state, (response.u, response.excitation)

        return jax.lax.scan(respond, state, frames)[1]

    state, on_device, call = detector.init(params, jnp.asarray(frames[0])), jnp.asarray(frames[1:]), jax.jit(step)
    one_by_one, by_hand = list(on_device), BY_HAND[detector](params, frames[0])
    assert_equal(scan(state, on_device), run_by_hand(by_hand, frames[1:]))
    ms = medians(
        {
            "calls": lambda: run_calls(call, state, one_by_one),
            "scan": lambda: jax.block_until_ready(scan(state, on_device)),
            "by hand": lambda: run_by_hand(by_hand, frames[1:]),
        },
        ROUNDS,
    )
    return ms, sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / 1e3


def main() -> None:
    """Print a table of all detectors and sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs="+", default=SIZES)
    parser.add_argument("--detector", nargs="+", choices=DETECTORS, default=list(DETECTORS))
    given = parser.parse_args()
    cv2.setNumThreads(1)
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "numpy", "opencv-python-headless"))
    print(f"{platform.processor() or platform.machine()}, one core; Python {platform.python_version()}, {versions}")
    print(f"A frame of one eye, median of {ROUNDS} rounds of {FRAMES} frames in turns\n")
    print("| size      | detector       | calls [ms] | scan [ms] | by hand [ms] | by hand / calls | state [kB] |")
    print("| --------- | -------------- | ---------- | --------- | ------------ | --------------- | ---------- |")
    for size in given.size:
        width, height = map(int, size.split("x"))
        frames = make_approach(width, height)
        for name in given.detector:
            ms, state = measure(DETECTORS[name], frames)
            print(
                f"| {width:3d} x {height:3d} | {name:14s} | {ms['calls']:10.3f} | {ms['scan']:9.3f} "
                f"| {ms['by hand']:12.3f} | {ms['by hand'] / ms['calls']:15.2f} | {state:10.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
