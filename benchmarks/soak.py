"""Memory, open files and compiled programs of one process that rolls out, runs trials and watches videos for hours.

    python benchmarks/soak.py [--minutes 120] [--pause 60] [--out build/soak]

| part of a cycle | what it does                                                                            |
| --------------- | --------------------------------------------------------------------------------------- |
| rollout         | five seconds of the pretrained robot in four new random rooms, 80 x 60                  |
| trial           | `lgmdjax trial white` with two robots and a new seed: walks, plot, video, page          |
| watch           | `lgmdjax watch` on a video of two seconds at 160 x 120                                  |

After each cycle, and a collection of garbage, a row is added to `soak.csv`. At the end `soak.png` shows the curves, and
a line for each quantity says how fast it grew in the second half: Theil and Sen's slope with its 95 % interval. The
first half, in which programs are compiled and allocators fill their pools, does not count. A quantity levels off if the
interval contains zero, or if at this slope it would grow by less than 1 % in the second half. Exit code 1 if one
doesn't. With --plot, only the figure and the lines are made again from a `soak.csv`.

Source: P. K. Sen (1968), Estimates of the regression coefficient based on Kendall's tau, JASA 63.
"""

import argparse
import csv
import gc
import os
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

from lgmdjax.runtime.jax_setup import prepare_jax

prepare_jax()  # as the command line does

import jax
import numpy as np
from jax.extend.backend import get_backend
from matplotlib import pyplot
from matplotlib.figure import Figure
from scipy.stats import theilslopes

import lgmdjax
from lgmdjax.cli import environment, watch
from lgmdjax.detectors import alarm, lgmd
from lgmdjax.reporting import video_io
from lgmdjax.runtime import compiled_code
from lgmdjax.simulation import assembly

WIDTH, ROBOTS, SECONDS = 80, 4, 5.0  # px, number, s of a rollout
TRIAL, SEEDS = "white", 2
VIDEO_SIZE, VIDEO_FRAMES = (160, 120), 60
TOLERANCE = 0.01  # of the median, growth in the second half that is none
MIN_CYCLES = 8
UNITS = {"memory": "MB", "cycle_seconds": "s"}


class Usage(NamedTuple):
    """What the process holds after a cycle."""

    minutes: float  # since the start
    cycle_seconds: float  # without the pause
    memory: float  # resident [MB]
    files: int  # open file descriptors
    threads: int  # of the operating system
    mappings: int  # of memory; XLA makes some for each piece of a program
    programs: int  # compiled, that are still held
    arrays: int  # of JAX
    array_bytes: int
    objects: int  # that Python's garbage collector tracks
    figures: int  # of pyplot


def measure(minutes: float, cycle_seconds: float) -> Usage:
    """Measure what this process holds; Linux only."""
    gc.collect()
    resident_pages = int(Path("/proc/self/statm").read_text().split()[1])
    arrays = jax.live_arrays()
    return Usage(
        minutes=minutes,
        cycle_seconds=cycle_seconds,
        memory=resident_pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        files=len(os.listdir("/proc/self/fd")) - 1,  # without that of the listing
        threads=len(os.listdir("/proc/self/task")),
        mappings=compiled_code.MAPS_FILE.read_text().count("\n"),
        programs=len(get_backend().live_executables()),
        arrays=len(arrays),
        array_bytes=sum(array.nbytes for array in arrays),
        objects=len(gc.get_objects()),
        figures=len(pyplot.get_fignums()),
    )


def write_video(path: Path) -> None:
    """Write a dark square that grows."""
    width, height = VIDEO_SIZE
    with video_io.open_writer(path, width, height, 30) as write:
        for frame in range(VIDEO_FRAMES):
            picture = np.full((height, width, 3), 200, np.uint8)
            half = 4 + frame * height // (3 * VIDEO_FRAMES)
            picture[height // 2 - half : height // 2 + half, width // 2 - half : width // 2 + half] = 30
            write(picture)


def run_cycle(cycle: int, robot: lgmdjax.simulation.closed_loop.Params, video: Path) -> None:
    """Roll out, run a trial and watch a video; results go to a folder that is deleted."""
    rooms = lgmdjax.random_rooms(jax.random.key(cycle), ROBOTS)
    lgmdjax.rollout(robot, rooms, seconds=SECONDS)
    with tempfile.TemporaryDirectory() as name:
        lgmdjax.run_trial(TRIAL, seed=cycle, seeds=SEEDS, width=WIDTH, out=Path(name))
        watch.detect_looming(
            video,
            Path(name),
            layout=watch.StereoLayout(),
            params=watch.Detectors(lgmd.Params(), alarm.Params()),
        )


def run(minutes: float, pause: float, out: Path) -> list[Usage]:
    """Repeat the cycle for some minutes and write soak.csv; return what the process held after each cycle."""
    environment.check_jax()
    robot = assembly.load_robot()
    robot = assembly.with_resolution(robot, assembly.scale_resolution(robot, WIDTH))
    usages: list[Usage] = []
    start = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    video = out / "square.mp4"
    write_video(video)
    with (out / "soak.csv").open("w", newline="") as table:
        rows = csv.writer(table)
        rows.writerow(Usage._fields)
        while time.monotonic() - start < 60 * minutes:
            began = time.monotonic()
            with open(os.devnull, "w") as nowhere, redirect_stderr(nowhere), redirect_stdout(nowhere):
                run_cycle(len(usages), robot, video)
            now = time.monotonic()
            usages.append(measure((now - start) / 60, now - began))
            rows.writerow(usages[-1])
            table.flush()
            time.sleep(pause)
    return usages


def read(path: Path) -> list[Usage]:
    """Read a soak.csv."""
    with path.open(newline="") as table:
        return [Usage(**{name: float(value) for name, value in row.items()}) for row in csv.DictReader(table)]  # pyright: ignore[reportArgumentType]


def find_growth(values: np.ndarray) -> tuple[float, float, float, bool]:
    """Return slope per cycle in the second half, its 95 % interval, and whether the quantity levels off."""
    half = values[len(values) // 2 :]
    slope, _, low, high = np.asarray(theilslopes(half, np.arange(len(half)), 0.95), float).tolist()
    return slope, low, high, low <= 0 <= high or slope * len(half) < TOLERANCE * float(np.median(half))


def plot(usages: list[Usage]) -> Figure:
    """Plot every quantity over time."""
    names = [name for name in Usage._fields if name != "minutes"]
    minutes = [usage.minutes for usage in usages]
    figure, axes = pyplot.subplots(5, 2, figsize=(10, 12), sharex=True, layout="constrained")
    for axis, name in zip(axes.flat, names, strict=True):
        axis.plot(minutes, [getattr(usage, name) for usage in usages], ".-", markersize=3, linewidth=1)
        axis.axvline(minutes[len(minutes) // 2], color="0.7", linewidth=1)
        axis.set_title(f"{name.replace('_', ' ')}{f' [{UNITS[name]}]' if name in UNITS else ''}", fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("time [min]")
    return figure


def report(usages: list[Usage], out: Path) -> int:
    """Write soak.png, print a line for each quantity, and return the exit code."""
    if len(usages) < MIN_CYCLES:
        sys.exit(f"expected {MIN_CYCLES} cycles or more, got {len(usages)}; raise --minutes")
    figure = plot(usages)
    figure.savefig(out / "soak.png", dpi=100)
    pyplot.close(figure)
    print(f"{len(usages)} cycles in {usages[-1].minutes:.0f} minutes; slopes of the second half, for each cycle\n")
    print("| quantity      |   first |  middle |    last | slope [95 % interval]          | verdict    |")
    print("| ------------- | ------- | ------- | ------- | ------------------------------ | ---------- |")
    grows = False
    for name in Usage._fields[1:]:
        values = np.asarray([getattr(usage, name) for usage in usages], float)
        slope, low, high, levels_off = find_growth(values)
        first, middle, last = (f"{values[k]:.7g}" for k in (0, len(values) // 2, -1))
        interval = f"{slope:.3g} [{low:.3g}, {high:.3g}]"
        verdict = "levels off" if levels_off else "grows"
        print(f"| {name:13s} | {first:>7s} | {middle:>7s} | {last:>7s} | {interval:30s} | {verdict:10s} |")
        grows |= not levels_off and name != "cycle_seconds"
    return int(grows)


def main() -> int:
    """Run or read, plot and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=120)
    parser.add_argument("--pause", type=float, default=0, help="seconds between two cycles")
    parser.add_argument("--out", type=Path, default=Path("build/soak"))
    parser.add_argument("--plot", type=Path, help="a soak.csv to read instead of a run")
    given = parser.parse_args()
    if given.plot:
        return report(read(given.plot), given.plot.parent)
    return report(run(given.minutes, given.pause, given.out), given.out)


if __name__ == "__main__":
    sys.exit(main())
