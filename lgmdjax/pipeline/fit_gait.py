"""Stage fit-gait: fit the shaping networks to the tripod gait, and simulate walks on an empty floor.

Writes shaping.safetensors, gait.json (speeds, turning, sway), cpg.npz (fig. 5b) and foot.npz (fig. 5c); also robot.xml
if the robot has a body of its own.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from tqdm.auto import tqdm

from lgmdjax.body import hexapod, robot_xml
from lgmdjax.errors import InputError
from lgmdjax.evaluation import gait_test
from lgmdjax.evaluation.gait_test import GaitTrajectory
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping, tripod_gait
from lgmdjax.pipeline.settings import FitGaitSettings
from lgmdjax.runtime import partial_files
from lgmdjax.runtime.storage import JsonObject, read_file, write_arrays, write_json

SWEEP_COMMANDS = (
    (1.0, 1.0),
    (0.5, 0.5),
    (1.2, 1.2),
    (2.0, 2.0),
    (-1.0, -1.0),
    (-1.0, 1.0),
    (1.0, -1.0),
)  # v left, right
PLOTTED_COMMANDS = ((0.5, 0.5), (1.0, 1.0), (2.0, 2.0))  # fig. 5c
STRAIGHT = (1.0, 1.0)
MIN_SPEED = 0.5  # of that asked for, below which a robot of one's own has no gait


class Condition(NamedTuple):
    """A commanded velocity, and the form of the shaping networks' input."""

    velocity: tuple[float, float]  # left, right
    printed_input: bool = False  # the single input of the paper


CONDITIONS = (*(Condition(velocity) for velocity in SWEEP_COMMANDS), Condition(STRAIGHT, printed_input=True))
Targets = Mapping[Condition, Float[Array, "steps 6 3"]]
Walks = Mapping[Condition, Mapping[str, GaitTrajectory]]  # by condition and simulator, "mjx" or "c"


def run(folder: Path, inputs: Mapping[str, Path], settings: FitGaitSettings, seed: int) -> None:
    """Fit networks with both forms of the input, and measure walks with them in both simulators.

    Raises InputError, before anything is fitted, if `settings.seconds` is too short to measure a gait.
    """
    cpg_params = cpg.Params()
    gait_test.require_duration(settings.seconds, float(cpg_params.cycle_time))
    body = hexapod.load(_take_body(folder, inputs))
    networks = {printed: _fit(body, settings, seed, printed) for printed in (False, True)}
    shaping.save(folder / "shaping.safetensors", networks[False], {"steps": settings.steps, "seed": seed})
    write_arrays(folder / "cpg.npz", _onset(cpg_params, seed))
    steps = round(settings.seconds / gait_test.TIME_STEP)
    targets = {
        condition: gait_test.servo_targets(
            cpg_params, networks[condition.printed_input], jnp.asarray(condition.velocity), steps=steps
        )
        for condition in CONDITIONS
    }
    print("fit-gait: compiling the physics, then walking on an empty floor", flush=True)
    in_mjx = gait_test.simulate_mjx(hexapod.build(body), jnp.stack(list(targets.values())))
    walks = {
        condition: {"mjx": walk, "c": gait_test.simulate_mujoco(body, own)}
        for (condition, own), walk in zip(targets.items(), in_mjx, strict=True)
    }
    summary = _summary(walks, float(cpg_params.cycle_time))
    _report(summary, settings, is_own="robot" in inputs)
    write_json(folder / "gait.json", summary)
    write_arrays(folder / "foot.npz", _foot_paths(body, targets, walks, float(cpg_params.cycle_time)))


def _take_body(folder: Path, inputs: Mapping[str, Path]) -> robot_xml.Body | None:
    """Return the body of stage robot, and write it beside the gait, where all later stages find it; None without it."""
    if "robot" not in inputs:
        return None
    body = robot_xml.Body(read_file(inputs["robot"] / robot_xml.FILE).decode())
    with partial_files.replacing(folder / robot_xml.FILE) as partial:
        partial.write_text(body.xml, encoding="utf-8")
    return body


def _fit(body: mujoco.MjModel, settings: FitGaitSettings, seed: int, printed_input: bool) -> shaping.Params:
    name = "the paper's input" if printed_input else "the corrected input"
    with tqdm(total=settings.steps, desc=f"fit-gait: {name}", unit="step") as bar:

        def show(done: int, loss: float) -> None:
            bar.set_postfix_str(f"{math.sqrt(max(loss, 0)):.2f} mm", refresh=False)
            bar.update(done - bar.n)

        return gait_fit.fit(
            kinematics.read_geometry(body),
            tripod_gait.read_gait(body),
            key=jax.random.key(seed),
            steps=settings.steps,
            printed_input=printed_input,
            progress=show,
        )


def _onset(network: cpg.Params, seed: int, cycles: int = 12) -> dict[str, np.ndarray | float]:
    """Start the CPG in a random state, and measure how long the tripod takes to form (fig. 5b)."""
    cycle, steps = float(network.cycle_time), round(cycles * float(network.cycle_time) / gait_test.TIME_STEP)
    state = cpg.init(network, jax.random.key(seed))
    _, signal = jax.lax.scan(lambda s, _: cpg.step(network, s, gait_test.TIME_STEP), state, length=steps)
    outputs = np.asarray(signal[..., 0])
    # In a tripod, the outputs of its legs are equal, and those of the other tripod are their negative.
    error = np.abs(outputs - outputs[:, :1] * np.where(np.arange(6) % 2, -1.0, 1.0)).max(axis=1)
    unformed = np.flatnonzero(error > 0.05 * np.abs(outputs).max())
    return {
        "time": np.arange(steps) * gait_test.TIME_STEP,
        "rhythm": outputs,
        "transient_cycles": (unformed[-1] + 1 if unformed.size else 0) * gait_test.TIME_STEP / cycle,
        "period": cpg.period(outputs[steps // 2 :, 0], gait_test.TIME_STEP),
    }


def _summary(walks: Walks, cycle: float) -> JsonObject:
    """Return the contents of gait.json."""
    measured = {
        condition: {simulator: gait_test.measure_gait(walk, cycle) for simulator, walk in both.items()}
        for condition, both in walks.items()
    }
    rows = [
        {
            "velocity": list(velocity),
            "asked": float(tripod_gait.Gait().nominal_velocity) * sum(velocity) / 2,
            "mjx": both["mjx"].speed,
            "c": both["c"].speed,
            "yaw_rate_mjx": both["mjx"].yaw_rate,
            "yaw_rate_c": both["c"].yaw_rate,
            "drift_deg": max((math.degrees(gait.drift) for gait in both.values()), key=abs),
        }
        for (velocity, printed_input), both in measured.items()
        if not printed_input
    ]
    straight, printed = measured[Condition(STRAIGHT)]["mjx"], measured[Condition(STRAIGHT, printed_input=True)]
    sway = {f"{name}_deg": math.degrees(getattr(straight, name)) for name in ("pitch", "roll", "yaw")}
    return {
        "cycle_time": cycle,
        "sweep": rows,
        "literal": {simulator: gait.speed for simulator, gait in printed.items()},
        "sway": sway | {"bounce_mm": 1000 * straight.heave},
    }


def _report(summary: JsonObject, settings: FitGaitSettings, *, is_own: bool) -> None:
    """Print how the robot walks straight on; raise `InputError` for a robot of one's own that hardly does."""
    row = next(row for row in summary["sweep"] if row["velocity"] == list(STRAIGHT))
    walks = f"{row['mjx']:.3f} m/s in MJX, {row['c']:.3f} m/s in C MuJoCo"
    print(f"fit-gait: walks at {walks}; turns by {row['drift_deg']:.1f} deg in {settings.seconds:g} s", flush=True)
    if is_own and not min(row["mjx"], row["c"]) > MIN_SPEED * row["asked"]:
        raise InputError(
            f"fit-gait: expected a gait of {row['asked']:g} m/s, got {walks}; check gains and torque limits of the "
            "servos, give the robot another key frame `stance`, or fit for longer (--fit-gait.steps)"
        )


def _foot_paths(body: mujoco.MjModel, targets: Targets, walks: Walks, cycle: float) -> dict[str, np.ndarray]:
    """Cut one cycle of the first leg's foot out of each walk, in the trunk's frame: commanded and simulated."""
    geometry, steps = kinematics.read_geometry(body), round(cycle / gait_test.TIME_STEP)
    commanded = {
        condition: np.asarray(kinematics.forward(geometry, own[-steps:]))[:, 0] for condition, own in targets.items()
    }
    simulated = {condition: both["mjx"].feet[-steps:, 0] for condition, both in walks.items()}
    return {
        "velocities": np.array([left for left, _ in PLOTTED_COMMANDS]),
        "commanded": np.stack([commanded[Condition(velocity)] for velocity in PLOTTED_COMMANDS]),
        "simulated": np.stack([simulated[Condition(velocity)] for velocity in PLOTTED_COMMANDS]),
        "literal": simulated[Condition(STRAIGHT, printed_input=True)],
    }
