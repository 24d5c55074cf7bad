"""How fast should the robot walk for its eyes? Fig. 9: `python experiments/velocity.py` (half an hour at 160 x 120).

Robots that are blind to what they see walk straight on through random rooms at 0.1 to 5 times the nominal velocity. A
frame counts as obstructed when the scanner has something within `NEAR` ahead, as free when it has nothing within
`FAR`; the mean response of both eyes, averaged over about a gait cycle, is compared between the two. Where their
difference is largest in standard deviations (Cohen's d), the detector tells best whether the way is free.

Writes velocity.json and velocity.png into --out.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from scipy import ndimage

from lgmdjax import calibration, cpg, drivers, figures, files, hexapod, rollout, scores, simulation
from lgmdjax.stages import crew

VELOCITIES = (0.1, 0.25, 0.5, 0.75, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0)  # of the nominal 0.05 m/s
ROOMS = 2**23  # far from the numbers of a run's episodes
NEAR, FAR = 0.6, 1.2  # m
WINDOW = round(calibration.AVERAGED * simulation.FRAME_RATE)


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


def main(
    velocities: Sequence[float] = VELOCITIES,
    run: Path | None = None,
    robots: int = 16,
    seconds: float = 20.0,
    seed: int = 0,
    out: Path = Path("runs/experiments"),
) -> None:
    """Print a row a velocity, and draw them.

    Args:
        velocities: multiples of the nominal 0.05 m/s
        run: run folder whose robot walks; the trained one that comes along if left out
        robots: in a room each, the same rooms at every velocity
        seconds: of each robot
        seed: of the rooms
        out: folder to write to
    """
    robot, model = crew.trained(run), hexapod.build()
    rooms = rollout.random_rooms(jax.random.fold_in(jax.random.key(seed), ROOMS), robots)
    rows = []
    for velocity in velocities:
        params = at_velocity(robot, velocity)
        record = rollout.together(list(crew.walks(params, model, rooms, seconds, f"v = {velocity:g}")))
        rows.append(measure(velocity, record, float(robot.controller.lgmd.suppression)))
        print(rows[-1], flush=True)
    out.mkdir(parents=True, exist_ok=True)
    files.write_json(out / "velocity.json", [asdict(row) for row in rows])
    (out / "velocity.png").write_bytes(figures.to_png(draw(rows)))


def at_velocity(robot: simulation.Params, velocity: float) -> simulation.Params:
    """Have the blind driver walk straight on at a velocity."""
    robot = crew.seat(robot, drivers.BLIND)
    anyone = robot.controller.driver
    blind = drivers.Blind(velocity=jnp.full(2, velocity, dtype=float))
    seats = tuple(blind if isinstance(own, drivers.Blind) else own for own in anyone.drivers)
    return replace(robot, controller=replace(robot.controller, driver=replace(anyone, drivers=seats)))


def measure(velocity: float, record: simulation.Record, suppression: float) -> Row:
    """Compare u where something is near with u where nothing is."""
    u = ndimage.uniform_filter1d(np.asarray(record.u).mean(axis=-1), WINDOW, axis=1)
    steady, distance = _steady(record), np.asarray(record.distances).min(axis=-1)
    near, far = u[steady & (distance < NEAR)], u[steady & (distance > FAR)]
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
        steady[robot, first + 2 * round(simulation.FRAME_RATE) : last - WINDOW] = True
    return steady & np.asarray(record.ok)


@figures.styled
def draw(rows: Sequence[Row]) -> Figure:
    """Draw the mean responses with their spread, and how far apart they are."""
    velocity: Float[np.ndarray, " rows"] = np.array([row.velocity for row in rows])
    spread = np.array([row.spread for row in rows])
    figure = Figure(figsize=(figures.WIDTH, 4.4), layout="constrained")
    means, effects = figure.subplots(2, sharex=True)
    for name, colour in (("obstructed", figures.RIGHT), ("free", figures.LEFT)):
        mean = np.array([getattr(row, name) for row in rows])
        means.plot(velocity, mean, "o-", color=colour, label=f"{name} path")
        means.fill_between(velocity, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)
    means.set(ylabel="mean response u")
    means.legend()
    effects.plot(velocity, [row.effect for row in rows], "o-", color=figures.INK)
    effects.axvspan(1.0, 1.4, color=figures.FAINT, alpha=0.5, linewidth=0)
    effects.text(1.2, effects.get_ylim()[0], "the paper's band", ha="center", va="bottom", fontsize="small")
    effects.set(xlabel="velocity [0.05 m/s]", ylabel="Cohen's d", xscale="log")
    return figure


if __name__ == "__main__":
    tyro.cli(main)
