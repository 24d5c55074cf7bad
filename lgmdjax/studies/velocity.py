"""How fast should the robot walk for its eyes? Fig. 9: the mean response of the detectors against velocity.

A robot that looks at nothing walks straight on through random rooms at 0.1 to 5 times the nominal velocity, as far at
each. A frame counts as obstructed when something stands within `NEAR` of the laser in a sector straight ahead, as free
when nothing does within `FAR`; the mean response of both eyes, averaged over about a gait cycle, is compared between
the two. Where they are furthest apart in standard deviations (Cohen's d), the detector tells best whether the way is
free. Intervals are bootstrapped over robots: frames of one walk are alike. Rooms differ much more than velocities do,
so velocities are compared in the same ones: one is as good as the best unless it is worse in 97.5 % of the resamples.

Writes velocity.json, a row a velocity, and the walks.

Source: Cizek & Faigl, sec. 4.2 and fig. 9.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

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
from lgmdjax.sensors import laser
from lgmdjax.simulation import assembly, closed_loop, recording, room_batches
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies.settings import VelocitySettings
from lgmdjax.world import arena

NEAR, FAR = 0.6, 1.2  # m
SECTOR = math.radians(40.0)  # straight ahead
WINDOW = round(metrics.AVERAGED * closed_loop.FRAME_RATE)
LEAST = 10.0  # s of a walk, however fast
RESAMPLED = 1000
BAND = (1.0, 1.4)  # of the nominal velocity: where the paper finds the two furthest apart


@dataclass(frozen=True, kw_only=True)
class Row:
    """What the eyes say at one velocity, where the way is obstructed and where it is free; nan where it never was."""

    velocity: float  # asked for
    speed: float  # m/s, walked
    obstructed: float  # mean u
    free: float
    spread: float  # standard deviation of u, both pooled
    effect: float  # Cohen's d
    low: float  # of its 95 % interval
    high: float
    as_good: bool  # as the best velocity, as far as these rooms can tell
    frames: tuple[int, int]  # obstructed, free
    silenced: float  # share of the frames in which the gate was shut
    lost: int  # robots that fell


def work(folder: Path, inputs: Mapping[str, Path], settings: VelocitySettings, seed: int) -> None:
    """Walk at every velocity through the same rooms, and compare."""
    robot = assembly.with_eyes(assembly.trained(inputs["fit-gait"], inputs["train"]), settings.eyes)
    measured = []
    for velocity in settings.velocities:
        seconds = max(settings.metres / (velocity * float(tripod_gait.Gait().nominal_velocity)), LEAST)
        bench = BenchmarkRooms(eyes=settings.eyes, robots=settings.robots, seconds=seconds)
        record = recording.benched(
            folder / f"{velocity:g}", at_velocity(robot, velocity), bench, policies.BLIND, seed,
            label=f"v = {velocity:g}", draw=True,
        )  # fmt: skip
        free = ahead(room_batches.bench_rooms(bench, seed).arena, record)
        measured.append(measure(velocity, record, free, float(robot.controller.lgmd.suppression)))
    storage.write_json(folder / "velocity.json", [asdict(row) for row in compared(measured)])


def at_velocity(robot: closed_loop.Params, velocity: float) -> closed_loop.Params:
    """Have the blind driver walk straight on at a velocity."""
    return assembly.manned(robot, policies.Blind(velocity=jnp.full(2, velocity, dtype=float)))


def ahead(rooms: arena.Arena, record: closed_loop.Record) -> Float[np.ndarray, "robots frames"]:
    """Measure how far it is from the laser to the first thing in a sector straight ahead [m]."""
    scanner = laser.Params(rays=21, field_of_view=SECTOR)

    def look(room: arena.Arena, position: Array, quaternion: Array) -> Array:
        pose = hexapod.Pose(position=position, quaternion=quaternion)
        return jnp.min(laser.scan(scanner, room, *hexapod.laser_pose(pose)))

    walk = jax.vmap(look, in_axes=(None, 0, 0))
    poses = (jnp.asarray(record.position), jnp.asarray(record.quaternion))
    return np.asarray(jax.jit(lambda *walks: jax.lax.map(lambda one: walk(*one), walks))(rooms, *poses))


def measure(
    velocity: float, record: closed_loop.Record, ahead: Float[np.ndarray, "robots frames"], suppression: float
) -> tuple[Row, Float[np.ndarray, " resamples"]]:
    """Compare u where something is near ahead with u where nothing is; give d of the resamples too."""
    u = ndimage.uniform_filter1d(np.asarray(record.u).mean(axis=-1), WINDOW, axis=1)
    steady = _steady(record)
    near, far = (_moments(u, steady & there) for there in (ahead < NEAR, ahead > FAR))
    obstructed, free, spread, effect = _compare(near.sum(axis=0), far.sum(axis=0))
    chosen = np.random.default_rng(0).integers(0, len(u), (RESAMPLED, len(u)))
    effects = np.array([_compare(near[some].sum(axis=0), far[some].sum(axis=0))[-1] for some in chosen])
    low, high = np.nanpercentile(effects, (2.5, 97.5)) if np.any(np.isfinite(effects)) else (math.nan, math.nan)
    scored, silenced = metrics.score(record, cpg.CYCLE_TIME), np.asarray(record.feed_forward)[steady] > suppression
    row = Row(
        velocity=velocity,
        speed=scored.speed,
        obstructed=obstructed,
        free=free,
        spread=spread,
        effect=effect,
        low=float(low),
        high=float(high),
        as_good=False,
        frames=(int(near[:, 0].sum()), int(far[:, 0].sum())),
        silenced=float(silenced.mean()) if silenced.size else math.nan,
        lost=scored.lost,
    )
    return row, effects


def compared(measured: Sequence[tuple[Row, Float[np.ndarray, " resamples"]]]) -> list[Row]:
    """Tell which velocities are as good as the best; resamples of all are of the same robots, hence the same rooms."""
    rows, effects = [row for row, _ in measured], np.array([effects for _, effects in measured])
    first = _furthest([row.effect for row in rows])
    worse = np.mean(effects < effects[first], axis=1)  # a resample without frames of both kinds is for none
    return [
        replace(row, as_good=math.isfinite(row.effect) and bool(share < 0.975))
        for row, share in zip(rows, worse, strict=True)
    ]


def _moments(u: Float[np.ndarray, "robots frames"], there: Bool[np.ndarray, "robots frames"]) -> np.ndarray:
    """Count the frames of each robot, and sum u and its square over them; shape (robots, 3)."""
    return np.stack([np.where(there, u**power, 0.0).sum(axis=1) for power in range(3)], axis=1)


def _compare(near: np.ndarray, far: np.ndarray) -> tuple[float, float, float, float]:
    """Give both means, the pooled standard deviation, and Cohen's d; nan without frames of both kinds."""
    if not (near[0] and far[0]):
        return math.nan, math.nan, math.nan, math.nan
    means = near[1] / near[0], far[1] / far[0]
    squares = sum(some[2] - some[1] ** 2 / some[0] for some in (near, far))
    spread = math.sqrt(max(squares, 0.0) / (near[0] + far[0]))
    return float(means[0]), float(means[1]), spread, float((means[0] - means[1]) / max(spread, 1e-9))


def _steady(record: closed_loop.Record) -> Bool[np.ndarray, "robots frames"]:
    """Leave out the first two seconds after a robot was put down, the frames before a touch, and robots that fell."""
    setbacks = np.asarray(record.setbacks)
    steady = np.zeros(setbacks.shape, bool)
    for robot, first, last in metrics.stretches(setbacks):
        steady[robot, first + 2 * round(closed_loop.FRAME_RATE) : max(last - WINDOW, 0)] = True
    return steady & np.asarray(record.ok)


def best(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Find the row at whose velocity the two are furthest apart."""
    return rows[_furthest([row["effect"] for row in rows])]


def _furthest(effects: Sequence[float]) -> int:
    return int(np.argmax(np.where(np.isfinite(effects), effects, -math.inf)))


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the mean responses with their spread, and how far apart they are; rows as in velocity.json."""
    names = ("velocity", "spread", "effect", "low", "high")
    velocity, spread, effect, low, high = (np.array([row[name] for row in rows]) for name in names)
    figure = Figure(figsize=(style.WIDTH, 4.4), layout="constrained")
    means, effects = figure.subplots(2, sharex=True)
    for name, colour in (("obstructed", style.RIGHT), ("free", style.LEFT)):
        mean: Float[np.ndarray, " rows"] = np.array([row[name] for row in rows])
        means.plot(velocity, mean, "o-", color=colour, label=f"{name} path")
        means.fill_between(velocity, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)
    means.set(ylabel="mean response u")
    means.legend()
    good = np.array([row["as_good"] for row in rows])
    effects.plot(velocity, effect, "o-", color=style.INK, markerfacecolor="white", label="worse than the best")
    effects.plot(velocity[good], effect[good], "o", color=style.INK, label="as good as the best")
    effects.fill_between(velocity, low, high, color=style.INK, alpha=0.12, linewidth=0)
    effects.axvspan(*BAND, color=style.FAINT, alpha=0.5, linewidth=0, label="the paper's best")
    effects.set(xlabel="velocity [0.05 m/s]", ylabel="Cohen's d", xscale="log")
    effects.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    effects.legend()
    return figure
