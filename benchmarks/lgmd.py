"""How long a pair of LGMDs takes for a stereo frame, beside the same equations in OpenCV, on one core.

    python benchmarks/lgmd.py

Both are shown the same film, in turns within one run, and timed by the processor time of the process, which on one
core is what passes on an idle machine; so neither figure nor ratio hangs on what else runs. JAX runs two ways: a
frame a call, as on a robot, and a film in one program (`lax.scan`, as in a walk), where slicing the film counts
too. OpenCV's subtract, filter2D, absdiff, scaleAdd and threshold are what one would write without JAX.
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
import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.detectors import lgmd

SIZES = ((80, 60), (160, 120), (320, 240), (640, 480))
FRAMES = 16
ROUNDS = 40
PARAMS = lgmd.Params()
KERNEL = np.array(lgmd.KERNEL, np.float32)


def film(width: int, height: int) -> np.ndarray:
    """Draw a textured panorama that drifts by a fraction of a pixel a frame, in stereo."""
    rng = np.random.default_rng(0)
    panorama = cv2.GaussianBlur(rng.uniform(0, 255, (height, width + 64)).astype(np.float32), (0, 0), 2.0)
    panorama = 127 + 6 * (panorama - panorama.mean())
    moved = [
        cv2.warpAffine(panorama, np.array([[1, 0, -0.7 * f], [0, 1, 0]]), (width + 64, height))
        for f in range(FRAMES + 1)
    ]
    return np.stack([[m[:, 8 : 8 + width], m[:, 20 : 20 + width]] for m in moved]).astype(np.float32)


def in_opencv(frames: np.ndarray) -> list[tuple[float, float]]:
    """Run eqs. 7-16 with OpenCV; u of both eyes a frame."""
    last, before = list(frames[0]), [np.zeros_like(frames[0, 0])] * 2
    responses = []
    for frame in frames[1:]:
        u = [0.0, 0.0]
        for eye in (0, 1):
            L, P_before = np.ascontiguousarray(frame[eye]), before[eye]
            P, E = cv2.subtract(L, last[eye]), cv2.absdiff(L, last[eye])
            I = np.abs(cv2.filter2D(P_before, cv2.CV_32F, KERNEL, borderType=cv2.BORDER_CONSTANT))  # noqa: E741
            S = cv2.scaleAdd(I, -0.4, E)
            _, passed = cv2.threshold(S, float(PARAMS.threshold), 0, cv2.THRESH_TOZERO)
            U, FF = cv2.sumElems(passed)[0] / L.size, cv2.norm(P_before, cv2.NORM_L1) / L.size
            u[eye] = 0.5 if float(PARAMS.suppression) < FF else 1 / (1 + np.exp(-U))
            last[eye], before[eye] = L, P
        responses.append((u[0], u[1]))
    return responses


both = jax.vmap(partial(lgmd.step, PARAMS))


@jax.jit
def in_one_program(state: lgmd.State, frames: jax.Array) -> jax.Array:
    """Run a film through both eyes."""
    return jax.lax.scan(both, state, frames)[1].u


# Without donating the state: XLA then copies the frame into it, which costs more than new memory.
one_frame = jax.jit(both)


def in_calls(state: lgmd.State, frames: list[jax.Array]) -> list[jax.Array]:
    """Run a film with a call a frame, waiting for each."""
    responses = []
    for frame in frames:
        state, response = one_frame(state, frame)
        responses.append(jax.block_until_ready(response.u))
    return responses


def medians(candidates: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Time candidates in turns; median milliseconds a stereo frame."""
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for run in candidates.values():
        run()
    for _ in range(ROUNDS):
        for name, run in candidates.items():
            start = time.process_time()
            run()
            times[name].append((time.process_time() - start) / FRAMES * 1e3)
    return {name: statistics.median(t) for name, t in times.items()}


def opened(first: np.ndarray) -> lgmd.State:
    return jax.vmap(partial(lgmd.init, PARAMS))(jnp.asarray(first))


def main() -> None:
    cv2.setNumThreads(1)
    print(f"A stereo frame through two LGMDs on one core, median of {ROUNDS} rounds in turns.")
    print("Memory: the state and what a frame needs on the way; it grows with pixels and eyes, and nothing else.\n")
    print("| size        | calls [ms] | scan [ms] | OpenCV [ms] | OpenCV/calls | OpenCV/scan | memory [MB] |")
    print("| ----------- | ---------- | --------- | ----------- | ------------ | ----------- | ----------- |")
    for width, height in SIZES:
        frames = film(width, height)
        on_device, one_by_one = jnp.asarray(frames[1:]), [jnp.asarray(f) for f in frames[1:]]
        state = opened(frames[0])
        program = in_one_program.lower(state, on_device).compile()
        spent = one_frame.lower(state, on_device[0]).compile().memory_analysis()
        np.testing.assert_allclose(program(state, on_device), in_opencv(frames), atol=1e-4)
        ms = medians(
            {
                "scan": lambda p=program, s=state, f=on_device: jax.block_until_ready(p(s, f)),
                "calls": lambda s=state, f=one_by_one: in_calls(s, f),
                "opencv": lambda f=frames: in_opencv(f),
            }
        )
        memory = (spent.temp_size_in_bytes + spent.output_size_in_bytes) / 1e6 if spent else float("nan")
        print(
            f"| {width:4d} x {height:3d}  | {ms['calls']:10.3f} | {ms['scan']:9.3f} | {ms['opencv']:11.3f} "
            f"| {ms['opencv'] / ms['calls']:12.2f} | {ms['opencv'] / ms['scan']:11.2f} | {memory:11.2f} |"
        )


if __name__ == "__main__":
    main()
