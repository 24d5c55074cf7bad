"""How fast should the robot walk for its eyes? Fig. 9: the mean response of the detectors against velocity.

A robot that looks at nothing walks straight on through random rooms at 0.1 to 5 times the nominal velocity. A frame
counts as obstructed when the scanner has something within `NEAR` ahead, as free when it has nothing within `FAR`; the
mean response of both eyes, averaged over about a gait cycle, is compared between the two. Where they are furthest
apart in standard deviations (Cohen's d), the detector tells best whether the way is free.

Writes velocity.json, a row a velocity, and the walks.

Source: Cizek & Faigl, sec. 4.2 and fig. 9.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from scipy import ndimage

from lgmdjax import calibration, cpg, drivers, figures, files, scales, scores, simulation
from lgmdjax.errors import InputError
from lgmdjax.stages import crew

NEAR, FAR = 0.6, 1.2  # m
WINDOW = round(calibration.AVERAGED * simulation.FRAME_RATE)
BAND = (1.0, 1.4)  # of the nominal velocity: where the paper finds the two furthest apart


@dataclass(frozen=True, kw_only=True)
class Row:
    """What the eyes say at one velocity, where the way is obstructed and where it is free."""

    velocity: float  # asked for
    speed: float  # m/s, walked
    obstructed: float  # mean u
    free: float
    spread: float  # standard deviation of u, both pooled
    effect: float  # Cohen's d
    frames: tuple[int, int]  # obstructed, free
    silenced: float  # share of the frames in which the gate was shut


def work(folder: Path, inputs: Mapping[str, Path], settings: scales.Velocity, seed: int) -> None:
    """Walk at every velocity through the same rooms, and compare."""
    robot = crew.with_eyes(crew.trained(inputs["fit-gait"], inputs["train"]), settings.bench.eyes)
    rows = []
    for velocity in settings.velocities:
        record = crew.benched(
            folder / f"{velocity:g}", at_velocity(robot, velocity), settings.bench, drivers.BLIND, seed,
            label=f"v = {velocity:g}", draw=True,
        )  # fmt: skip
        rows.append(measure(velocity, record, float(robot.controller.lgmd.suppression)))
    files.write_json(folder / "velocity.json", [asdict(row) for row in rows])


def at_velocity(robot: simulation.Params, velocity: float) -> simulation.Params:
    """Have the blind driver walk straight on at a velocity."""
    return crew.manned(robot, drivers.Blind(velocity=jnp.full(2, velocity, dtype=float)))


def measure(velocity: float, record: simulation.Record, suppression: float) -> Row:
    """Compare u where something is near with u where nothing is."""
    u = ndimage.uniform_filter1d(np.asarray(record.u).mean(axis=-1), WINDOW, axis=1)
    steady, distance = _steady(record), np.asarray(record.distances).min(axis=-1)
    near, far = u[steady & (distance < NEAR)], u[steady & (distance > FAR)]
    if not (len(near) and len(far)):
        raise InputError(
            f"velocity {velocity:g}: expected frames with something within {NEAR} m and frames with nothing within "
            f"{FAR} m, got {len(near)} and {len(far)}; walk more robots, or for longer"
        )
    spread = float(np.sqrt((near.var() * len(near) + far.var() * len(far)) / (len(near) + len(far))))
    scored = scores.score(record, cpg.CYCLE_TIME)
    return Row(
        velocity=velocity,
        speed=scored.speed,
        obstructed=float(near.mean()),
        free=float(far.mean()),
        spread=spread,
        effect=float((near.mean() - far.mean()) / max(spread, 1e-9)),
        frames=(len(near), len(far)),
        silenced=float((np.asarray(record.feed_forward)[steady] > suppression).mean()),
    )


def _steady(record: simulation.Record) -> Bool[np.ndarray, "robots frames"]:
    """Leave out the first two seconds after a robot was put down, the frames before a touch, and robots that fell."""
    setbacks = np.asarray(record.setbacks)
    steady = np.zeros(setbacks.shape, bool)
    for robot, first, last in scores.stretches(setbacks):
        steady[robot, first + 2 * round(simulation.FRAME_RATE) : max(last - WINDOW, 0)] = True
    return steady & np.asarray(record.ok)


@figures.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the mean responses with their spread, and how far apart they are; rows as in velocity.json."""
    velocity, spread, effect = (np.array([row[name] for row in rows]) for name in ("velocity", "spread", "effect"))
    figure = Figure(figsize=(figures.WIDTH, 4.4), layout="constrained")
    means, effects = figure.subplots(2, sharex=True)
    for name, colour in (("obstructed", figures.RIGHT), ("free", figures.LEFT)):
        mean: Float[np.ndarray, " rows"] = np.array([row[name] for row in rows])
        means.plot(velocity, mean, "o-", color=colour, label=f"{name} path")
        means.fill_between(velocity, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)
    means.set(ylabel="mean response u")
    means.legend()
    effects.plot(velocity, effect, "o-", color=figures.INK)
    effects.axvspan(*BAND, color=figures.FAINT, alpha=0.5, linewidth=0, label="the paper's best")
    effects.set(xlabel="velocity [0.05 m/s]", ylabel="Cohen's d", xscale="log")
    effects.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    effects.legend()
    return figure
