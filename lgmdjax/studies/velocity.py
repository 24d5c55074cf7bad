"""At which velocity do the detectors best distinguish an obstructed from a free path? Fig. 9: u against velocity.

Robots with the policy `blind` walk straight on through random rooms at 0.1 to 5 times the nominal velocity, the same
distance at each. A frame counts as obstructed if the laser finds something within `NEAR` in a sector straight ahead,
and as free if it finds nothing within `FAR`. The compared quantity is u, the mean of both detectors averaged over about
a gait cycle. The effect size is Cohen's d, the difference of the two means in pooled standard deviations: the larger it
is, the better u shows whether the path is free.

Intervals are bootstrapped over robots, because the frames of one walk are correlated. Rooms differ much more than
velocities do, so all velocities are compared in the same rooms: a velocity is as good as the best one unless its effect
size is smaller in 97.5 % of the resamples.

Writes velocity.json, a row for each velocity, and the walks.

Source: Cizek & Faigl, sec. 4.2 and fig. 9.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from matplotlib.figure import Figure
from scipy import ndimage

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.evaluation import metrics
from lgmdjax.locomotion import cpg, tripod_gait
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import laser
from lgmdjax.simulation import assembly, closed_loop, recording, room_batches
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies.settings import VelocitySettings
from lgmdjax.world import arena

NEAR, FAR = 0.6, 1.2  # m
SECTOR = math.radians(40.0)  # rad, straight ahead
WINDOW = round(metrics.AVERAGING_TIME * closed_loop.FRAME_RATE)  # frames
MIN_SECONDS = 10.0  # of a walk, however fast
RESAMPLES = 1000
PAPER_BEST = (1.0, 1.4)  # v; in this range the paper finds the largest difference


@dataclass(frozen=True, kw_only=True)
class Row:
    """The response at one velocity, in obstructed and in free frames; nan without frames of both kinds."""

    velocity: float  # commanded, as a multiple of the nominal velocity
    speed: float  # m/s, measured
    obstructed: float  # mean u of obstructed frames
    free: float  # mean u of free frames
    spread: float  # pooled standard deviation of u
    effect: float  # Cohen's d
    low: float  # lower end of its 95 % interval
    high: float  # upper end
    as_good: bool  # not worse than the best velocity in 97.5 % of the resamples
    frames: tuple[int, int]  # number of obstructed and of free frames
    suppressed: float  # share of frames in which the feed-forward inhibition exceeds T_f
    lost: int  # robots that fell


def run(folder: Path, inputs: Mapping[str, Path], settings: VelocitySettings, seed: int) -> None:
    """Record walks at every velocity in the same rooms, and compare the responses."""
    robot = assembly.with_resolution(assembly.load_robot(inputs["fit-gait"], inputs["train"]), settings.eyes)
    measured = []
    for velocity in settings.velocities:
        seconds = max(settings.distance / (velocity * float(tripod_gait.Gait().nominal_velocity)), MIN_SECONDS)
        benchmark = BenchmarkRooms(eyes=settings.eyes, robots=settings.robots, seconds=seconds)
        record = recording.record_benchmark(
            folder / f"{velocity:g}", with_velocity(robot, velocity), benchmark, policies.BLIND, seed,
            label=f"v = {velocity:g}", render=True,
        )  # fmt: skip
        ahead = distance_ahead(room_batches.benchmark_rooms(benchmark, seed).arena, record, robot.laser.mount)
        measured.append(score_velocity(velocity, record, ahead, float(robot.controller.detector.suppression)))
    storage.write_json(folder / "velocity.json", [asdict(row) for row in mark_best(measured)])


def with_velocity(robot: closed_loop.Params, velocity: float) -> closed_loop.Params:
    """Set the velocity at which the policy `blind` walks straight on."""
    return assembly.with_policy(robot, "blind", policies.BlindParams(velocity=jnp.full(2, velocity, dtype=float)))


def distance_ahead(
    rooms: arena.Arena, record: closed_loop.Record, mount: hexapod.Offset | None = None
) -> Float[np.ndarray, "robots frames"]:
    """Measure the distance from the laser to the nearest thing in a sector straight ahead [m]."""
    scanner = laser.Params(rays=21, fov=SECTOR)

    def nearest(room: arena.Arena, position: Array, quaternion: Array) -> Array:
        pose = hexapod.Pose(position=position, quaternion=quaternion)
        return jnp.min(laser.scan(scanner, room, *hexapod.laser_pose(pose, mount)))

    nearest_by_frame = jax.vmap(nearest, in_axes=(None, 0, 0))
    poses = (jnp.asarray(record.position), jnp.asarray(record.quaternion))
    by_robot = jax.jit(lambda *walks: jax.lax.map(lambda walk: nearest_by_frame(*walk), walks))
    return np.asarray(by_robot(rooms, *poses))


def score_velocity(
    velocity: float, record: closed_loop.Record, ahead: Float[np.ndarray, "robots frames"], suppression: float
) -> tuple[Row, Float[np.ndarray, " resamples"]]:
    """Compare u between obstructed and free frames; return the row, and Cohen's d of each bootstrap resample.

    Args:
        velocity: commanded, as a multiple of the nominal velocity.
        record: the walks at this velocity.
        ahead: from `distance_ahead` [m].
        suppression: T_f of the detectors [grey].
    """
    u = ndimage.uniform_filter1d(np.asarray(record.u).mean(axis=-1), WINDOW, axis=1)
    steady = _steady_frames(record)
    near, far = (_moments(u, steady & selected) for selected in (ahead < NEAR, ahead > FAR))
    obstructed, free, spread, effect = _effect_size(near.sum(axis=0), far.sum(axis=0))
    drawn = np.random.default_rng(0).integers(0, len(u), (RESAMPLES, len(u)))
    effects = np.array([_effect_size(near[robots].sum(axis=0), far[robots].sum(axis=0))[-1] for robots in drawn])
    low, high = np.nanpercentile(effects, (2.5, 97.5)) if np.any(np.isfinite(effects)) else (math.nan, math.nan)
    score, suppressed = metrics.score(record, cpg.CYCLE_TIME), np.asarray(record.feed_forward)[steady] > suppression
    row = Row(
        velocity=velocity,
        speed=score.speed,
        obstructed=obstructed,
        free=free,
        spread=spread,
        effect=effect,
        low=float(low),
        high=float(high),
        as_good=False,
        frames=(int(near[:, 0].sum()), int(far[:, 0].sum())),
        suppressed=float(suppressed.mean()) if suppressed.size else math.nan,
        lost=score.lost,
    )
    return row, effects


def mark_best(measured: Sequence[tuple[Row, Float[np.ndarray, " resamples"]]]) -> list[Row]:
    """Return the rows with `as_good` set; one resample holds the same robots, hence rooms, at all velocities."""
    rows, effects = [row for row, _ in measured], np.array([effects for _, effects in measured])
    best = _argmax([row.effect for row in rows])
    worse = np.mean(effects < effects[best], axis=1)  # false for a resample without frames of both kinds
    return [
        replace(row, as_good=math.isfinite(row.effect) and bool(share < 0.975))
        for row, share in zip(rows, worse, strict=True)
    ]


def _moments(u: Float[np.ndarray, "robots frames"], selected: Bool[np.ndarray, "robots frames"]) -> np.ndarray:
    """Return for each robot the number of selected frames, and the sums of u and u^2 over them; shape (robots, 3)."""
    return np.stack([np.where(selected, u**power, 0.0).sum(axis=1) for power in range(3)], axis=1)


def _effect_size(near: np.ndarray, far: np.ndarray) -> tuple[float, float, float, float]:
    """Return both means, the pooled standard deviation, and Cohen's d; nan without frames of both kinds."""
    if not (near[0] and far[0]):
        return math.nan, math.nan, math.nan, math.nan
    means = near[1] / near[0], far[1] / far[0]
    squares = sum(moments[2] - moments[1] ** 2 / moments[0] for moments in (near, far))
    spread = math.sqrt(max(squares, 0.0) / (near[0] + far[0]))
    return float(means[0]), float(means[1]), spread, float((means[0] - means[1]) / max(spread, 1e-9))


def _steady_frames(record: closed_loop.Record) -> Bool[np.ndarray, "robots frames"]:
    """Select all frames except the first two seconds after a reset, those before a contact, and those after a fall."""
    resets = np.asarray(record.resets)
    steady = np.zeros(resets.shape, bool)
    for robot, first, last in metrics.segment_bounds(resets):
        steady[robot, first + 2 * round(closed_loop.FRAME_RATE) : max(last - WINDOW, 0)] = True
    return steady & np.asarray(record.ok)


def best_row(rows: Sequence[JsonObject]) -> JsonObject:
    """Return the row with the largest effect size."""
    return rows[_argmax([row["effect"] for row in rows])]


def _argmax(effects: Sequence[float]) -> int:
    return int(np.argmax(np.where(np.isfinite(effects), effects, -math.inf)))


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot mean and spread of u in obstructed and free frames, and the effect size; rows as in velocity.json."""
    names = ("velocity", "spread", "effect", "low", "high")
    velocity, spread, effect, low, high = (np.array([row[name] for row in rows]) for name in names)
    figure = Figure(figsize=(style.WIDTH, 4.4), layout="constrained")
    means, effects = figure.subplots(2, sharex=True)
    for name, colour in (("obstructed", style.RIGHT_COLOUR), ("free", style.LEFT_COLOUR)):
        mean: Float[np.ndarray, " rows"] = np.array([row[name] for row in rows])
        means.plot(velocity, mean, "o-", color=colour, label=f"{name} path")
        means.fill_between(velocity, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)
    means.set(ylabel="mean response u")
    means.legend()
    good = np.array([row["as_good"] for row in rows])
    effects.plot(velocity, effect, "o-", color=style.DARK, markerfacecolor="white", label="worse than the best")
    effects.plot(velocity[good], effect[good], "o", color=style.DARK, label="as good as the best")
    effects.fill_between(velocity, low, high, color=style.DARK, alpha=0.12, linewidth=0)
    effects.axvspan(*PAPER_BEST, color=style.LIGHT_GREY, alpha=0.5, linewidth=0, label="best in the paper")
    effects.set(xlabel="velocity [0.05 m/s]", ylabel="Cohen's d", xscale="log")
    effects.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    effects.legend()
    return figure
