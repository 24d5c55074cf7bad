"""What do the equations do that cannot work as printed? Each erratum by itself, in a robot otherwise corrected.

Whether it still walks is measured on an empty floor in C MuJoCo; what u then tells of distance, and how often it
touches something, in the rooms of the bench: once with the teacher driving, so that all walk by the same rule, and once
with the navigator, which learned with the corrected robot and is not taught again.

Writes printed.json, a row a case.

Source: Cizek & Faigl, secs. 3.2 and 3.3, eqs. 1-5, 15, 16 and 22; the corrections are in `cpg`, `shaping`, `lgmd`,
`camera` and `braitenberg`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.evaluation import gait_test, metrics
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import compiled_code, storage
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.studies import supervision
from lgmdjax.studies.settings import ErrataSettings

SECONDS = 20.0  # on the empty floor
WALKED = 5.0  # m; of a robot that walks less there is no rate to tell
STEPS = 3000  # of fitting networks to the paper's input
Change = Callable[[closed_loop.Params, Path], closed_loop.Params]  # a robot, and the study's folder


def work(folder: Path, inputs: Mapping[str, Path], settings: ErrataSettings, seed: int) -> None:
    """Put every erratum into the robot, and measure."""
    robot = assembly.with_eyes(assembly.trained(inputs["fit-gait"], inputs["train"]), settings.bench.eyes)
    literal = folder / "literal.safetensors"
    if not literal.exists():  # bits of a second fit might differ, and so would the robot
        geometry = kinematics.geometry(hexapod.load())
        networks = gait_fit.teach(geometry, key=jax.random.key(seed), steps=STEPS, literal=True)
        shaping.save(literal, networks, {"steps": STEPS, "seed": seed})
    rows = []
    for name, change in CASES.items():
        rows.append(_measure(folder, name, change(robot, folder), settings, seed))
        compiled_code.let_go()  # nearly every case has its own
    storage.write_json(folder / "errata.json", rows)


def _measure(folder: Path, name: str, robot: closed_loop.Params, settings: ErrataSettings, seed: int) -> dict[str, Any]:
    """Walk a robot on an empty floor and in the rooms, driven by the teacher and by the navigator."""
    nerves, steps = robot.controller, round(SECONDS / gait_test.STEP)
    course = gait_test.targets(nerves.cpg, nerves.shaping, jnp.ones(2), steps=steps)
    gauge = gait_test.gauge(gait_test.walk_c(hexapod.load(), course), float(nerves.cpg.cycle_time))
    place = folder / "".join(c if c.isalnum() else "-" for c in name)
    walks = {
        driver.name: recording.benched(place / driver.name, robot, settings.bench, driver, seed, label=name, draw=True)
        for driver in (policies.TEACHER, policies.LEARNED)
    }
    scored = {driver: asdict(metrics.score(record, cpg.CYCLE_TIME)) for driver, record in walks.items()}
    return {"case": name, "speed": gauge.speed, "u": lgmd_grid_search.follow(walks["teacher"]), **scored}


def _rhythm(robot: closed_loop.Params, **changes: Any) -> closed_loop.Params:
    return replace(robot, controller=replace(robot.controller, cpg=replace(robot.controller.cpg, **changes)))


def _detector(robot: closed_loop.Params, **changes: bool) -> closed_loop.Params:
    return replace(robot, controller=replace(robot.controller, lgmd=replace(robot.controller.lgmd, **changes)))


def _literal(robot: closed_loop.Params, folder: Path) -> closed_loop.Params:
    """Give the robot networks that hear what the paper's do."""
    networks = shaping.load(folder / "literal.safetensors")
    return replace(robot, controller=replace(robot.controller, shaping=networks))


def _same_picture(robot: closed_loop.Params, _: Path) -> closed_loop.Params:
    """Show each detector all that its eye sees."""
    eyes = robot.camera
    whole = CameraSettings(width=eyes.width, height=eyes.height, overlap=1.0, pooling=robot.controller.lgmd.pooling)
    return assembly.with_eyes(robot, whole)


CASES: Mapping[str, Change] = {
    "all corrected": lambda robot, _: robot,
    "eqs. 1, 3: sign of w_fe": lambda robot, _: _rhythm(robot, printed_sign=True),
    "eqs. 1, 3: coupling W": lambda robot, _: _rhythm(robot, coupling=cpg.coupling(within_tripod=0.40, across=0.04)),
    "sec. 3.2: one input a leg": _literal,
    "sec. 3.3: whole pictures": _same_picture,
    "eq. 15: signed sum": lambda robot, _: _detector(robot, printed_feed_forward=True),
    "eq. 16: gate": lambda robot, _: _detector(robot, printed_gate=True),
    "eq. 22: rule alone": lambda robot, _: supervision.under(robot, "eq. 22"),
}


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw speed, what u tells of distance, and collisions of every case, side by side; rows as in printed.json."""
    figure = Figure(figsize=(style.WIDTH, 0.8 + 0.3 * len(rows)), layout="constrained")
    speed, sight, touches = figure.subplots(1, 3, sharey=True)
    places = np.arange(len(rows))
    speed.barh(places, [row["speed"] for row in rows], height=0.5, color=style.QUIET)
    speed.set(xlabel="speed at v = 1 [m/s]")
    sight.barh(places, [row["u"]["score"] for row in rows], height=0.5, color=style.QUIET)
    sight.set(xlabel="u follows nearness, r")
    for shift, driver in ((-0.15, "learned"), (0.15, "teacher")):
        rates = np.array([[row[driver]["per_100_m"][key] for key in ("value", "low", "high")] for row in rows])
        known = np.array([row[driver]["distance"] > WALKED for row in rows])
        look = {"color": style.DRIVERS[driver]}
        touches.hlines(places[known] + shift, rates[known, 1], rates[known, 2], linewidth=1.6, alpha=0.5, **look)
        touches.plot(rates[known, 0], places[known] + shift, "o", markersize=4.5, clip_on=False, label=driver, **look)
    touches.set(xlabel="collisions per 100 m")
    touches.set_xlim(left=0)
    touches.legend(loc="upper right")
    speed.set_yticks(places, [row["case"] for row in rows])
    speed.set_ylim(len(rows) - 0.4, -0.6)
    for panel in (speed, sight, touches):
        panel.grid(False, axis="y")
        panel.tick_params(axis="y", length=0)
    return figure
