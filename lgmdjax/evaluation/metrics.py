"""Metrics of recorded walks: does a robot avoid obstacles, and does it make progress? Each with a 95 % interval.

Distance is the path length of the trunk's centre. The path is averaged over one gait cycle, so that sway doesn't count,
and is interrupted at resets. A collision is a frame in which the clearance reached zero. The robot is then reset, so
each contact counts once.

A robot that turns on the spot has no collision. `Progress` separates it from one that avoids obstacles and walks on:

| quantity        | unit  | meaning                                                                              |
| --------------- | ----- | ------------------------------------------------------------------------------------ |
| coverage        | 1/min | new cells of 0.25 x 0.25 m that the trunk's centre enters; a reset begins a new count |
| hard turning    | 1     | share of time with a yaw rate, averaged over 1 s, above 0.15 rad/s                    |
| net rotation    | turns | largest difference of two headings of one robot between two resets                    |

| quantity                                   | interval                                 |
| ------------------------------------------ | ---------------------------------------- |
| collisions per 100 m                       | exact, of a Poisson count (Garwood 1936) |
| proportion of trials                       | Wilson's (Wilson 1927)                   |
| means over robots                          | percentile bootstrap over robots         |

Works on host records (`rollout.rollout_chunks`) with axes (robot, frame).
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage, stats

from lgmdjax import geometry
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.locomotion import cpg
from lgmdjax.simulation import finite
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record

CONFIDENCE = 0.95
AVERAGING_TIME = cpg.CYCLE_TIME  # s; u and the commands are averaged over one gait cycle
CELL = 0.25  # m, side of the cells that coverage counts
HARD_TURN_RATE = 0.15  # rad/s; a robot that turns faster is turning hard
HARD_TURN_TIME = 1.0  # s, over which that yaw rate is averaged


@struct.dataclass(kw_only=True)
class Estimate:
    """An estimate and its 95 % interval.

    >>> print(Estimate(value=2.22, low=0.269, high=8.03))
    2.22 [0.269, 8.03]
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


@struct.dataclass(kw_only=True)
class Progress(NotebookTable):
    """Whether robots make progress: how much floor they cover, and how much they turn; means over robots."""

    coverage: Estimate  # 1/min, new cells of `CELL`
    hard_turning: Estimate  # share of time
    net_rotation: Estimate  # turns
    longest_rotation: float  # turns, the largest net rotation of all robots


@struct.dataclass(kw_only=True)
class Score(NotebookTable):
    """Metrics of a batch of walks with one policy."""

    robots: int
    lost: int  # robots that were frozen because they fell or their state became non-finite
    distance: float  # m, total of all robots
    collisions: int
    per_100_m: Estimate  # collisions per 100 m
    first_collision: Estimate  # m walked until the first collision, or until the end if there was none
    clearance: Estimate  # m, mean over frames of the smallest clearance within the frame
    speed: float  # m/s, path length over time
    turning: float  # rad/s, mean absolute yaw rate
    progress: Progress


def score(record: Record, cycle_time: float = cpg.CYCLE_TIME) -> Score:
    """Compute the metrics of a batch of walks; a robot's frames after it was lost (`ok` false) don't count.

    Args:
        record: recorded walks, axes (robot, frame).
        cycle_time: duration of one gait cycle [s], over which paths and headings are averaged.

    Raises InputError if no robot moved, or if a frame that counts is not finite.
    """
    record = finite.require_finite(record, "metrics")
    ok = np.asarray(record.ok)
    contacts = np.asarray(record.contact) & ok
    steps = step_lengths(record, cycle_time)
    distance, collisions = float(steps.sum()), int(contacts.sum())
    if distance <= 0:
        raise InputError("expected a walk with some distance in it, got none; did every robot fall at once?")
    clearance = np.where(ok, record.clearance, np.nan)
    return Score(
        robots=len(ok),
        lost=int((~ok[:, -1]).sum()),
        distance=distance,
        collisions=collisions,
        per_100_m=poisson_rate(collisions, distance / 100),
        first_collision=bootstrap_mean(_distance_to_first_collision(steps, contacts)),
        clearance=bootstrap_mean(np.nanmean(clearance, axis=1)),
        speed=distance * FRAME_RATE / int(ok.sum()),
        turning=float(np.mean(np.abs(yaw_rates(record, cycle_time))[ok])),
        progress=progress(record, cycle_time),
    )


def progress(record: Record, cycle_time: float = cpg.CYCLE_TIME) -> Progress:
    """Return whether robots make progress; frames with `ok` false don't count, nor do robots with only such frames.

    Args:
        record: recorded walks, axes (robot, frame).
        cycle_time: duration of one gait cycle [s], over which paths and headings are averaged.

    Raises InputError if no frame counts, or one that does is not finite.
    """
    record = finite.require_finite(record, "metrics")
    ok = np.asarray(record.ok)
    frames = ok.sum(axis=1)
    if not frames.any():
        raise InputError("expected walks with frames that count, got none; did every robot fall at once?")
    walked = frames > 0
    frames = frames[walked]
    is_hard = (np.abs(yaw_rates(record, HARD_TURN_TIME)) > HARD_TURN_RATE) & ok
    rotation = net_rotations(record, cycle_time)[walked]
    return Progress(
        coverage=bootstrap_mean(count_cells(record, cycle_time)[walked] * FRAME_RATE * 60 / frames),
        hard_turning=bootstrap_mean(is_hard.sum(axis=1)[walked] / frames),
        net_rotation=bootstrap_mean(rotation),
        longest_rotation=float(rotation.max()),
    )


def count_cells(record: Record, cycle_time: float) -> Int[ndarray, " robots"]:
    """Count the cells of `CELL` that each robot's averaged path enters, anew after each reset."""
    positions, ok = np.asarray(record.position)[..., :2], np.asarray(record.ok)
    cells = np.zeros(len(ok), int)
    for robot, first, end in segment_bounds(np.asarray(record.resets)):
        path = positions[robot, first:end][ok[robot, first:end]]
        if len(path):
            averaged = _average_over_cycle(path, cycle_time)
            cells[robot] += len(np.unique(np.floor(averaged / CELL), axis=0))
    return cells


def net_rotations(record: Record, cycle_time: float) -> Float[ndarray, " robots"]:
    """Compute the largest difference [turns] of two headings of each robot, averaged over a cycle, between two resets.

    A robot that turns on the spot has the number of its turns; one that turns to either side in alternation has less
    than half a turn, however often it turns.
    """
    headings, ok = geometry.yaw(np.asarray(record.quaternion, dtype=float)), np.asarray(record.ok)
    rotation = np.zeros(len(ok))
    for robot, first, end in segment_bounds(np.asarray(record.resets)):
        heading = np.unwrap(headings[robot, first:end][ok[robot, first:end]])
        if len(heading):
            turns = np.ptp(_average_over_cycle(heading, cycle_time)) / (2 * np.pi)
            rotation[robot] = max(rotation[robot], turns)
    return rotation


def step_lengths(record: Record, cycle_time: float) -> Float[ndarray, "robots frames"]:
    """Compute the distance [m] from each frame to the next along the averaged path, zero across a reset.

    The last frame of a segment has no next frame and is zero.
    """
    positions, resets, ok = np.asarray(record.position), np.asarray(record.resets), np.asarray(record.ok)
    lengths = np.zeros(resets.shape)
    for robot, first, end in segment_bounds(resets):
        path = _average_over_cycle(positions[robot, first:end, :2], cycle_time)
        lengths[robot, first : end - 1] = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.where(ok, lengths, 0.0)


def yaw_rates(record: Record, cycle_time: float) -> Float[ndarray, "robots frames"]:
    """Compute the yaw rate [rad/s] of the trunk, averaged over one gait cycle, positive to the left."""
    headings = np.unwrap(geometry.yaw(np.asarray(record.quaternion, dtype=float)), axis=1)
    rates = np.zeros(headings.shape)
    for robot, first, end in segment_bounds(np.asarray(record.resets)):
        if end - first > 1:
            averaged = _average_over_cycle(headings[robot, first:end], cycle_time)
            rates[robot, first:end] = np.gradient(averaged) * FRAME_RATE
    return rates


def segment_bounds(resets: Int[ndarray, "robots frames"]) -> Iterator[tuple[int, int, int]]:
    """Yield (robot, first frame, end frame) of every segment of walking without a reset.

    >>> list(segment_bounds(np.array([[0, 0, 0, 1, 1]])))
    [(0, 0, 3), (0, 3, 5)]
    """
    for robot, count in enumerate(resets):
        starts = np.flatnonzero(np.diff(count)) + 1
        bounds = [0, *starts.tolist(), len(count)]
        yield from ((robot, first, end) for first, end in pairwise(bounds))


def poisson_rate(count: int, exposure: float) -> Estimate:
    """Estimate a rate from a count over an exposure, with the exact interval (Garwood 1936).

    >>> print(poisson_rate(2, 0.9))  # two collisions in 90 m: rate per 100 m
    2.22 [0.269, 8.03]
    """
    tail = (1 - CONFIDENCE) / 2
    low = stats.chi2.ppf(tail, 2 * count) / 2 if count else 0.0
    high = stats.chi2.ppf(1 - tail, 2 * (count + 1)) / 2
    return Estimate(value=count / exposure, low=float(low) / exposure, high=float(high) / exposure)


def wilson_proportion(count: int, trials: int) -> Estimate:
    """Estimate a proportion from a count of trials, with Wilson's interval (Wilson 1927).

    >>> print(wilson_proportion(15, 15))  # the paper's trials with one obstacle, all without contact
    1 [0.796, 1]
    """
    interval = stats.binomtest(count, trials).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(value=count / trials, low=float(interval.low), high=float(interval.high))


def bootstrap_mean(values: Float[ndarray, " robots"]) -> Estimate:
    """Estimate a mean over robots with a percentile bootstrap; the interval of a single robot is nan."""
    values = np.asarray(values)
    if len(values) < 2:
        return Estimate(value=float(values.mean()), low=float("nan"), high=float("nan"))
    if np.ptp(values) == 0:
        return Estimate(value=float(values[0]), low=float(values[0]), high=float(values[0]))
    interval = stats.bootstrap(
        (values,), np.mean, confidence_level=CONFIDENCE, n_resamples=2000, method="percentile", rng=0
    ).confidence_interval
    return Estimate(value=float(values.mean()), low=float(interval.low), high=float(interval.high))


def student_mean(values: Sequence[float]) -> Estimate:
    """Estimate a mean over independent runs, with Student's t interval; that of a single run is nan.

    >>> print(student_mean([1.0, 2.0, 3.0]))
    2 [-0.484, 4.48]
    """
    mean = float(np.mean(values))
    if len(values) < 2:
        return Estimate(value=mean, low=float("nan"), high=float("nan"))
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values))
    return Estimate(value=mean, low=mean - half, high=mean + half)


def area_under_roc(positive: Sequence[float] | ndarray, negative: Sequence[float] | ndarray) -> float:
    """Return how often a positive is above a negative, ties counted half.

    >>> area_under_roc([1.0, 2.0], [0.0, 1.0])
    0.875
    """
    return float(stats.mannwhitneyu(positive, negative).statistic) / (len(positive) * len(negative))


def _average_over_cycle(series: Float[ndarray, "frames *components"], cycle_time: float) -> ndarray:
    """Average over one gait cycle; the end values are repeated, which shortens a path by at most half a cycle."""
    return ndimage.uniform_filter1d(series, round(cycle_time * FRAME_RATE), axis=0, mode="nearest")


def _distance_to_first_collision(
    steps: Float[ndarray, "robots frames"], contacts: Bool[ndarray, "robots frames"]
) -> Float[ndarray, " robots"]:
    """Return each robot's distance [m] to its first collision; its total distance (a lower bound) if it had none."""
    distance = np.cumsum(steps, axis=1)
    first = np.where(contacts.any(axis=1), contacts.argmax(axis=1), contacts.shape[1] - 1)
    return np.take_along_axis(distance, first[:, None], axis=1)[:, 0]
