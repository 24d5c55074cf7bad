"""Time of a pair of LGMDs for a stereo frame, compared with the same equations in OpenCV, on one core.

    python benchmarks/lgmd.py

| candidate | what it does                                                                                |
| --------- | ------------------------------------------------------------------------------------------- |
| calls     | one call for each frame, as on a robot                                                      |
| scan      | all frames in one program (`lax.scan`, as in a rollout), with the slicing of the frames     |
| OpenCV    | subtract, filter2D, absdiff, scaleAdd and threshold (`benchmarks/detectors_by_hand.py`)     |

All see the same frames, in turns within one run. Timed is the processor time of the process, which on one core equals
the wall time of an idle machine; so neither times nor ratios depend on other programs.
"""

import os
import statistics
import time
from collections.abc import Callable, Mapping
from functools import partial

# One core for both: before JAX starts its threads.
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import cv2
import detectors_by_hand
import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.detectors import lgmd

SIZES = ((80, 60), (160, 120), (320, 240), (640, 480))
FRAMES = 16
ROUNDS = 40
PARAMS = lgmd.Params()


def make_frames(width: int, height: int) -> np.ndarray:
    """Return stereo frames of a textured panorama that drifts by a fraction of a pixel each frame."""
    rng = np.random.default_rng(0)
    panorama = cv2.GaussianBlur(rng.uniform(0, 255, (height, width + 64)).astype(np.float32), (0, 0), 2.0)
    panorama = 127 + 6 * (panorama - panorama.mean())
    shifted = [
        cv2.warpAffine(panorama, np.array([[1, 0, -0.7 * f], [0, 1, 0]]), (width + 64, height))
        for f in range(FRAMES + 1)
    ]
    return np.stack([[s[:, 8 : 8 + width], s[:, 20 : 20 + width]] for s in shifted]).astype(np.float32)


def run_opencv(frames: np.ndarray) -> list[list[float]]:
    """Run eqs. 7-16 with OpenCV; return u of both eyes for each frame."""
    eyes = [detectors_by_hand.LGMD(PARAMS, first) for first in frames[0]]
    return [[see(L)[0] for see, L in zip(eyes, frame, strict=True)] for frame in frames[1:]]


step_both_eyes = jax.vmap(partial(lgmd.step, PARAMS))


@jax.jit
def run_scan(state: lgmd.State, frames: jax.Array) -> jax.Array:
    """Run both detectors over all frames in one program; return u."""
    return jax.lax.scan(step_both_eyes, state, frames)[1].u


# The state is not donated: XLA would copy the frame into it, which takes longer than new memory.
step_compiled = jax.jit(step_both_eyes)


def run_calls(state: lgmd.State, frames: list[jax.Array]) -> list[jax.Array]:
    """Run both detectors with one call for each frame, waiting for each; return u."""
    responses = []
    for frame in frames:
        state, response = step_compiled(state, frame)
        responses.append(jax.block_until_ready(response.u))
    return responses


def medians(candidates: Mapping[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """Time candidates, which run over all frames, in turns; return the median time of a frame [ms]."""
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for run in candidates.values():
        run()
    for _ in range(rounds):
        for name, run in candidates.items():
            start = time.process_time()
            run()
            times[name].append((time.process_time() - start) / FRAMES * 1e3)
    return {name: statistics.median(t) for name, t in times.items()}


def init_both_eyes(first: np.ndarray) -> lgmd.State:
    """Return the detectors' states at the first frame."""
    return jax.vmap(partial(lgmd.init, PARAMS))(jnp.asarray(first))


def main() -> None:
    """Print a table of times and memory against the size of a picture."""
    cv2.setNumThreads(1)
    print(f"A stereo frame through two LGMDs on one core, median of {ROUNDS} rounds in turns.")
    print("Memory: the state and the temporary arrays of a frame; proportional to the number of pixels and eyes.\n")
    print("| size        | calls [ms] | scan [ms] | OpenCV [ms] | OpenCV/calls | OpenCV/scan | memory [MB] |")
    print("| ----------- | ---------- | --------- | ----------- | ------------ | ----------- | ----------- |")
    for width, height in SIZES:
        frames = make_frames(width, height)
        on_device, one_by_one = jnp.asarray(frames[1:]), [jnp.asarray(f) for f in frames[1:]]
        state = init_both_eyes(frames[0])
        program = run_scan.lower(state, on_device).compile()
        analysis = step_compiled.lower(state, on_device[0]).compile().memory_analysis()
        np.testing.assert_allclose(program(state, on_device), run_opencv(frames), atol=1e-4)
        ms = medians(
            {
                "scan": lambda p=program, s=state, f=on_device: jax.block_until_ready(p(s, f)),
                "calls": lambda s=state, f=one_by_one: run_calls(s, f),
                "opencv": lambda f=frames: run_opencv(f),
            }
        )
        memory = (analysis.temp_size_in_bytes + analysis.output_size_in_bytes) / 1e6 if analysis else float("nan")
        print(
            f"| {width:4d} x {height:3d}  | {ms['calls']:10.3f} | {ms['scan']:9.3f} | {ms['opencv']:11.3f} "
            f"| {ms['opencv'] / ms['calls']:12.2f} | {ms['opencv'] / ms['scan']:11.2f} | {memory:11.2f} |"
        )


if __name__ == "__main__":
    main()
