"""Time of `lgmdjax watch` on a video, compared with the same detectors and overlay by hand in OpenCV.

    python benchmarks/watch.py [VIDEO]

| candidate    | what it does                                                                                     |
| ------------ | ------------------------------------------------------------------------------------------------ |
| overlay      | both detectors, and the video with layers and curves                                             |
| no overlay   | both detectors                                                                                   |
| OpenCV       | `VideoCapture`, `resize` and the detectors of `benchmarks/lgmd.py`, without damage check or times |
| OpenCV video | the same, and `VideoWriter` (MPEG-4) with the pictures and S enlarged to the overlay's size       |

Without a video, a drifting texture at 1280 x 720 is written first. Candidates take turns. Timed is the processor time
of the process, so that neither times nor ratios depend on other programs. Frames a second are the most that two quiet
cores can do, if reading, detecting and encoding, which have threads of their own, share them evenly.
"""

import argparse
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stderr
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from lgmd import run_opencv

from lgmdjax.cli import watch
from lgmdjax.detectors import alarm, lgmd
from lgmdjax.reporting import video_io

WIDTH, HEIGHT, FRAMES, ROUNDS = 1280, 720, 300, 5
EYE_WIDTH, EYE_HEIGHT = 320, 180  # of the default --width
OVERLAY_SIZE = (660, 516)


def write_video(path: Path) -> Path:
    """Write a texture that drifts two pixels a frame."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH + 2 * FRAMES, 3), np.uint8), (0, 0), 4)
    texture = cv2.normalize(texture, np.empty_like(texture), 0, 255, cv2.NORM_MINMAX)
    with video_io.open_writer(path, WIDTH, HEIGHT, 30) as write:
        for frame in range(FRAMES):
            write(np.ascontiguousarray(texture[:, 2 * frame : 2 * frame + WIDTH]))
    return path


def run_watch(path: Path, out: Path, overlay: bool) -> None:
    """Run the command's work without its progress bar."""
    with open(os.devnull, "w") as nowhere, redirect_stderr(nowhere):
        watch.detect_looming(
            path,
            out,
            layout=watch.StereoLayout(),
            params=watch.Detectors(lgmd.Params(), alarm.Params()),
            overlay=overlay,
        )


def run_by_hand(path: Path, target: Path | None) -> None:
    """Read, resize, detect and write as one would with OpenCV."""
    video, half = cv2.VideoCapture(str(path)), EYE_WIDTH // 2
    code = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(target), code, 30, OVERLAY_SIZE) if target else None
    last = None
    while (read := video.read())[0]:
        grey = cv2.resize(
            cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY), (EYE_WIDTH, EYE_HEIGHT), None, 0, 0, cv2.INTER_AREA
        )
        eyes = np.stack([grey[:, :half], grey[:, half:]]).astype(np.float32)
        (u,) = run_opencv(np.stack([eyes if last is None else last, eyes]))
        if writer is not None:
            change = grey if last is None else cv2.convertScaleAbs(np.concatenate([*(eyes - last)], axis=1), None, 8.0)
            image = cv2.resize(np.concatenate([grey, change]), OVERLAY_SIZE, None, 0, 0, cv2.INTER_NEAREST)
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
            cv2.putText(image, f"{u[0]:.2f} {u[1]:.2f}", (8, 500), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255))
            writer.write(image)
        last = eyes
    if writer is not None:
        writer.release()


def main() -> None:
    """Print a table of times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", nargs="?", type=Path)
    given = parser.parse_args().video
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = given or write_video(folder / "drift.mp4")
        with video_io.open_reader(path) as video:
            size, frames = f"{video.width} x {video.height}", sum(1 for _ in video.frames(EYE_WIDTH, EYE_HEIGHT))
        candidates: dict[str, Callable[[], None]] = {
            "overlay": lambda: run_watch(path, folder, True),
            "no overlay": lambda: run_watch(path, folder, False),
            "OpenCV video": lambda: run_by_hand(path, folder / "by_hand.mp4"),
            "OpenCV": lambda: run_by_hand(path, None),
        }
        times: dict[str, list[float]] = {name: [] for name in candidates}
        for round_ in range(ROUNDS + 1):  # the first compiles
            for name, run in candidates.items():
                start = time.process_time()
                run()
                if round_:
                    times[name].append((time.process_time() - start) / frames * 1e3)
    ms = {name: statistics.median(t) for name, t in times.items()}
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "av", "opencv-python-headless"))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {versions}")
    print(f"{frames} frames of {size}, median of {ROUNDS} rounds in turns\n")
    print("| candidate    | processor time [ms a frame] | frames/s on two cores | OpenCV / lgmdjax |")
    print("| ------------ | --------------------------- | --------------------- | ---------------- |")
    for name, by_hand in (("overlay", "OpenCV video"), ("no overlay", "OpenCV")):
        for each, ratio in ((name, f"{ms[by_hand] / ms[name]:.2f}"), (by_hand, "")):
            print(f"| {each:12s} | {ms[each]:27.2f} | {2e3 / ms[each]:21.0f} | {ratio:16s} |", flush=True)


if __name__ == "__main__":
    main()
