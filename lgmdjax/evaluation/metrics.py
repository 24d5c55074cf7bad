"""How walks are scored: distance, collisions per 100 m, clearance, each with a 95 % interval.

Distance is the path of the trunk's centre, averaged over one gait cycle so that sway does not count, and not
across the gap when the robot was set back. A collision is a frame in which the least clearance reached zero;
the robot is then set back, so each touch counts once. Rates of collisions are Poisson counts over a distance;
their interval is exact (Garwood 1936), and clearances and distances are bootstrapped over robots.

Works on host records (`rollout.chunks`) with axes (robot, frame).
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from flax import struct
from scipy import ndimage, stats

from lgmdjax.errors import InputError
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record

CONFIDENCE = 0.95


@struct.dataclass(kw_only=True)
class Estimate:
    """A number and the interval that holds it at 95 %."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


@struct.dataclass(kw_only=True)
class Score:
    """What one driver did over a set of walks."""

    robots: int
    lost: int  # robots frozen because they fell or went non-finite
    distance: float  # m, all together
    collisions: int
    per_100_m: Estimate  # collisions per 100 m
    first_collision: Estimate  # m walked until the first touch, or to the end where there was none
    clearance: Estimate  # m, the mean over frames of the least clearance in a frame
    speed: float  # m/s, path length over time
    turning: float  # rad/s, mean absolute yaw rate


def score(record: Record, cycle_time: float) -> Score:
    """Score a batch of walks; frames of a robot that is no longer sound count for nothing."""
    sound = np.asarray(record.ok)
    touches = np.asarray(record.contact) & sound
    steps = step_lengths(record, cycle_time)
    distance, collisions = float(steps.sum()), int(touches.sum())
    if distance <= 0:
        raise InputError("expected a walk with some distance in it, got none; did every robot fall at once?")
    clearance = np.where(sound, record.clearance, np.nan)
    return Score(
        robots=len(sound),
        lost=int((~sound[:, -1]).sum()),
        distance=distance,
        collisions=collisions,
        per_100_m=poisson_rate(collisions, distance / 100),
        first_collision=bootstrap_mean(_first_collision(steps, touches)),
        clearance=bootstrap_mean(np.nanmean(clearance, axis=1)),
        speed=distance * FRAME_RATE / int(sound.sum()),
        turning=float(np.mean(np.abs(yaw_rates(record, cycle_time))[sound])),
    )


def step_lengths(record: Record, cycle_time: float) -> np.ndarray:
    """Measure the way of the smoothed trunk centre from each frame to the next [m], zero across a set-back.

    Shape (robots, frames); the last frame of a stretch has no next one and counts zero.
    """
    positions, setbacks = np.asarray(record.position), np.asarray(record.setbacks)
    sound = np.asarray(record.ok)
    lengths = np.zeros(setbacks.shape)
    for robot, first, last in stretches(setbacks):
        path = _smooth(positions[robot, first:last, :2], cycle_time)
        lengths[robot, first : last - 1] = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.where(sound, lengths, 0.0)


def yaw_rates(record: Record, cycle_time: float) -> np.ndarray:
    """Measure the yaw rate of the trunk, averaged over one gait cycle [rad/s]; shape (robots, frames)."""
    yaw, setbacks = np.unwrap(yaws(np.asarray(record.quaternion)), axis=1), np.asarray(record.setbacks)
    rates = np.zeros(yaw.shape)
    for robot, first, last in stretches(setbacks):
        if last - first > 1:
            rates[robot, first:last] = np.gradient(_smooth(yaw[robot, first:last], cycle_time)) * FRAME_RATE
    return rates


def yaws(quaternion: np.ndarray) -> np.ndarray:
    """Read the heading [rad] off quaternions w x y z."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=float), -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def stretches(setbacks: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Yield (robot, first frame, end frame) of every uninterrupted stretch of walking."""
    for robot, count in enumerate(setbacks):
        cuts = np.flatnonzero(np.diff(count)) + 1
        bounds = [0, *cuts.tolist(), len(count)]
        yield from ((robot, first, last) for first, last in pairwise(bounds))


def poisson_rate(count: int, exposure: float) -> Estimate:
    """Estimate a rate from a count over an exposure, with the exact interval (Garwood 1936)."""
    tail = (1 - CONFIDENCE) / 2
    low = stats.chi2.ppf(tail, 2 * count) / 2 if count else 0.0
    high = stats.chi2.ppf(1 - tail, 2 * (count + 1)) / 2
    return Estimate(value=count / exposure, low=float(low) / exposure, high=float(high) / exposure)


def wilson(count: int, trials: int) -> Estimate:
    """Estimate a share from a count of trials, with Wilson's interval (Wilson 1927)."""
    interval = stats.binomtest(count, trials).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(value=count / trials, low=float(interval.low), high=float(interval.high))


def bootstrap_mean(values: np.ndarray) -> Estimate:
    """Estimate a mean over robots, with a percentile bootstrap; one robot alone has no interval (nan)."""
    values = np.asarray(values)
    if len(values) < 2:
        return Estimate(value=float(values.mean()), low=float("nan"), high=float("nan"))
    if np.ptp(values) == 0:
        return Estimate(value=float(values[0]), low=float(values[0]), high=float(values[0]))
    interval = stats.bootstrap(
        (values,), np.mean, confidence_level=CONFIDENCE, n_resamples=2000, method="percentile", rng=0
    ).confidence_interval
    return Estimate(value=float(values.mean()), low=float(interval.low), high=float(interval.high))


def _smooth(path: np.ndarray, cycle_time: float) -> np.ndarray:
    """Average over one gait cycle; the ends repeat, which shortens a stretch by at most half a cycle."""
    return ndimage.uniform_filter1d(path, round(cycle_time * FRAME_RATE), axis=0, mode="nearest")


def _first_collision(steps: np.ndarray, touches: np.ndarray) -> np.ndarray:
    """Measure each robot's way to its first touch [m]; its whole way where it never touched (a lower bound)."""
    walked = np.cumsum(steps, axis=1)
    first = np.where(touches.any(axis=1), touches.argmax(axis=1), touches.shape[1] - 1)
    return np.take_along_axis(walked, first[:, None], axis=1)[:, 0]


AVERAGED = 0.8  # s, about a gait cycle
