"""What do the equations do that cannot work as printed? One at a time, in a robot that is otherwise corrected.

| measured                                        | where                                                        |
| ----------------------------------------------- | ------------------------------------------------------------ |
| speed at v = 1                                  | on an empty floor, in C MuJoCo                               |
| correlation of u with proximity, left - right   | in the benchmark rooms, with the policy `teacher`            |
| collisions per 100 m                            | in the benchmark rooms, with the policies `teacher` and      |
|                                                 | `learned`; the navigator was trained with the corrected      |
|                                                 | robot and is not trained again                               |

Writes errata.json, a row for each case.

Source: Cizek & Faigl, secs. 3.2 and 3.3, eqs. 1-5, 15, 16 and 22; the corrections are in `cpg`, `shaping`, `lgmd`,
`camera` and `braitenberg`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.evaluation import gait_test, metrics
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping, tripod_gait
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import compiled_code, storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.studies import supervision
from lgmdjax.studies.settings import ErrataSettings

SECONDS = 20.0  # duration of the walk on the empty floor
MIN_DISTANCE = 5.0  # m; a robot that walks less has no rate of collisions
FIT_STEPS = 3000  # of the optimiser, for shaping networks with the printed input
Change = Callable[[closed_loop.Params, Path], closed_loop.Params]  # (robot, folder of the study) -> robot


def run(folder: Path, inputs: Mapping[str, Path], settings: ErrataSettings, seed: int) -> None:
    """Measure the robot with every printed equation."""
    robot = assembly.with_resolution(assembly.load_robot(inputs["fit-gait"], inputs["train"]), settings.benchmark.eyes)
    literal = folder / "literal.safetensors"
    if not literal.exists():  # a second fit might differ in the last bits, and the recorded walks would not match
        body = hexapod.load(robot.body)
        geometry, gait = kinematics.read_geometry(body), tripod_gait.read_gait(body)
        networks = gait_fit.fit(geometry, gait, key=jax.random.key(seed), steps=FIT_STEPS, printed_input=True)
        shaping.save(literal, networks, {"steps": FIT_STEPS, "seed": seed})
    rows = []
    for name, change in CASES.items():
        rows.append(_measure(folder, name, change(robot, folder), settings, seed))
        compiled_code.clear_caches_if_near_limit()  # nearly every case has its own programs
    storage.write_json(folder / "errata.json", rows)


def _measure(folder: Path, name: str, robot: closed_loop.Params, settings: ErrataSettings, seed: int) -> JsonObject:
    """Return the row of a case: its walk on the empty floor, and its walks in the benchmark rooms."""
    controller_params, steps = robot.controller, round(SECONDS / gait_test.TIME_STEP)
    targets = gait_test.servo_targets(controller_params.cpg, controller_params.shaping, jnp.ones(2), steps=steps)
    trajectory = gait_test.simulate_mujoco(hexapod.load(robot.body), targets)
    gait = gait_test.measure_gait(trajectory, float(controller_params.cpg.cycle_time))
    case_folder = folder / "".join(c if c.isalnum() else "-" for c in name)
    walks = {
        policy.name: recording.record_benchmark(
            case_folder / policy.name, robot, settings.benchmark, policy, seed, label=name, render=True
        )
        for policy in (policies.TEACHER, policies.LEARNED)
    }
    scores = {policy: asdict(metrics.score(record, cpg.CYCLE_TIME)) for policy, record in walks.items()}
    u = lgmd_grid_search.correlate_with_proximity(walks["teacher"])
    return {"case": name, "speed": gait.speed, "u": u, **scores}


def _with_cpg(robot: closed_loop.Params, **changes: bool | Array) -> closed_loop.Params:
    return replace(robot, controller=replace(robot.controller, cpg=replace(robot.controller.cpg, **changes)))


def _with_lgmd(robot: closed_loop.Params, **changes: bool) -> closed_loop.Params:
    return replace(robot, controller=replace(robot.controller, detector=replace(robot.controller.detector, **changes)))


def _with_printed_shaping(robot: closed_loop.Params, folder: Path) -> closed_loop.Params:
    """Replace the shaping networks by ones that get the paper's single input for each leg."""
    networks = shaping.load(folder / "literal.safetensors")
    return replace(robot, controller=replace(robot.controller, shaping=networks))


def _with_field(robot: closed_loop.Params, **changes: float) -> closed_loop.Params:
    """Change the field of view of the detectors, or its weights."""
    return assembly.with_camera(robot, replace(assembly.camera_settings(robot), **changes))


CASES: Mapping[str, Change] = {
    "all corrected": lambda robot, _: robot,
    "eqs. 1, 3: sign of w_fe": lambda robot, _: _with_cpg(robot, printed_sign=True),
    "eqs. 1, 3: coupling W": lambda robot, _: _with_cpg(robot, coupling=cpg.coupling(within_tripod=0.40, across=0.04)),
    "sec. 3.2: one input a leg": _with_printed_shaping,
    "sec. 3.3: whole width": lambda robot, _: _with_field(robot, overlap=1.0),
    "sec. 3.3: with the ground": lambda robot, _: _with_field(robot, ground=0.0),
    "sec. 3.3: equal weights": lambda robot, _: _with_field(robot, falloff=0.0),
    "eq. 15: signed sum": lambda robot, _: _with_lgmd(robot, printed_feed_forward=True),
    "eq. 16: gate": lambda robot, _: _with_lgmd(robot, printed_gate=True),
    "eq. 22: rule alone": lambda robot, _: supervision.with_rule(robot, "eq. 22"),
}


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot speed, correlation of u with proximity, and collisions of every case; rows as in errata.json."""
    figure = Figure(figsize=(style.WIDTH, 0.8 + 0.3 * len(rows)), layout="constrained")
    speed, correlation, collisions = figure.subplots(1, 3, sharey=True)
    y = np.arange(len(rows))
    speed.barh(y, [row["speed"] for row in rows], height=0.5, color=style.GREY)
    speed.set(xlabel="speed at v = 1 [m/s]")
    correlation.barh(y, [row["u"]["score"] for row in rows], height=0.5, color=style.GREY)
    correlation.set(xlabel="r of u with proximity")
    for shift, policy in ((-0.15, "learned"), (0.15, "teacher")):
        rates = np.array([[row[policy]["per_100_m"][key] for key in ("value", "low", "high")] for row in rows])
        known = np.array([row[policy]["distance"] > MIN_DISTANCE for row in rows])
        options = {"color": style.POLICY_COLOURS[policy]}
        collisions.hlines(y[known] + shift, rates[known, 1], rates[known, 2], linewidth=1.6, alpha=0.5, **options)
        collisions.plot(rates[known, 0], y[known] + shift, "o", markersize=4.5, clip_on=False, label=policy, **options)
    collisions.set(xlabel="collisions per 100 m")
    collisions.set_xlim(left=0)
    collisions.legend(loc="upper right")
    speed.set_yticks(y, [row["case"] for row in rows])
    speed.set_ylim(len(rows) - 0.4, -0.6)
    for panel in (speed, correlation, collisions):
        panel.grid(False, axis="y")
        panel.tick_params(axis="y", length=0)
    return figure
