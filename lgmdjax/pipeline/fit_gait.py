"""Stage fit-gait: teach the shaping networks the tripod gait, and walk them on an empty floor in both simulators.

Writes shaping.safetensors, gait.json (speeds, turning, sway), cpg.npz (fig. 5b) and foot.npz (fig. 5c).
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping, tripod_gait
from lgmdjax.pipeline.settings import FitGaitSettings
from lgmdjax.runtime.storage import write_json

SWEEP = ((1.0, 1.0), (0.5, 0.5), (1.2, 1.2), (2.0, 2.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0))
DRAWN = ((0.5, 0.5), (1.0, 1.0), (2.0, 2.0))  # fig. 5c
STRAIGHT = (1.0, 1.0)


def work(folder: Path, inputs: Mapping[str, Path], settings: FitGaitSettings, seed: int) -> None:
    """Fit both forms of the shaping input, and measure the walks."""
    body = hexapod.load()
    networks = {literal: _teach(body, settings, seed, literal) for literal in (False, True)}
    shaping.save(folder / "shaping.safetensors", networks[False], {"steps": settings.steps, "seed": seed})
    rhythm = cpg.Params()
    np.savez(folder / "cpg.npz", allow_pickle=False, **_onset(rhythm, seed))
    courses = {
        (velocity, literal): gait_test.targets(
            rhythm, networks[literal], jnp.asarray(velocity), steps=round(settings.seconds / gait_test.STEP)
        )
        for velocity, literal in [*((velocity, False) for velocity in SWEEP), (STRAIGHT, True)]
    }
    print("fit-gait: compiling the physics, then walking on an empty floor", flush=True)
    mjx = gait_test.walk_mjx(hexapod.build(body), jnp.stack(list(courses.values())))
    walks = {
        name: {"mjx": walk, "c": gait_test.walk_c(body, course)}
        for (name, course), walk in zip(courses.items(), mjx, strict=True)
    }
    write_json(folder / "gait.json", _summary(walks, float(rhythm.cycle_time)))
    np.savez(folder / "foot.npz", allow_pickle=False, **_foot_paths(body, courses, walks, float(rhythm.cycle_time)))


def _teach(body: Any, settings: FitGaitSettings, seed: int, literal: bool) -> shaping.Params:
    name = "the paper's input" if literal else "the corrected input"
    with tqdm(total=settings.steps, desc=f"fit-gait: {name}", unit="step") as bar:

        def show(done: int, loss: float) -> None:
            bar.set_postfix_str(f"{math.sqrt(max(loss, 0)):.2f} mm", refresh=False)
            bar.update(done - bar.n)

        return gait_fit.teach(
            kinematics.geometry(body), key=jax.random.key(seed), steps=settings.steps, literal=literal, progress=show
        )


def _onset(network: cpg.Params, seed: int, cycles: int = 12) -> dict[str, Any]:
    """Start the rhythm at random and see how long it takes to become a tripod (fig. 5b)."""
    cycle, steps = float(network.cycle_time), round(cycles * float(network.cycle_time) / gait_test.STEP)
    state = cpg.init(network, jax.random.key(seed))
    _, rhythm = jax.lax.scan(lambda s, _: cpg.step(network, s, gait_test.STEP), state, length=steps)
    outputs = np.asarray(rhythm[..., 0])
    # Two legs of one tripod say the same, and the other tripod the opposite, once it has formed.
    error = np.abs(outputs - outputs[:, :1] * np.where(np.arange(6) % 2, -1.0, 1.0)).max(axis=1)
    formed = np.flatnonzero(error > 0.05 * np.abs(outputs).max())
    return {
        "time": np.arange(steps) * gait_test.STEP,
        "rhythm": outputs,
        "transient_cycles": (formed[-1] + 1 if formed.size else 0) * gait_test.STEP / cycle,
        "period": cpg.period(outputs[steps // 2 :, 0], gait_test.STEP),
    }


def _summary(walks: Mapping[Any, Mapping[str, gait_test.Course]], cycle: float) -> dict[str, Any]:
    gauges = {name: {sim: gait_test.gauge(c, cycle) for sim, c in both.items()} for name, both in walks.items()}
    rows = [
        {
            "velocity": list(velocity),
            "asked": float(tripod_gait.Gait().nominal_velocity) * sum(velocity) / 2,
            "mjx": both["mjx"].speed,
            "c": both["c"].speed,
            "yaw_rate_mjx": both["mjx"].yaw_rate,
            "yaw_rate_c": both["c"].yaw_rate,
            "drift_deg": max((math.degrees(g.drift) for g in both.values()), key=abs),
        }
        for (velocity, literal), both in gauges.items()
        if not literal
    ]
    straight, literal = gauges[STRAIGHT, False]["mjx"], gauges[STRAIGHT, True]
    sway = {f"{name}_deg": math.degrees(getattr(straight, name)) for name in ("pitch", "roll", "yaw")}
    return {
        "cycle_time": cycle,
        "sweep": rows,
        "literal": {sim: g.speed for sim, g in literal.items()},
        "sway": sway | {"bounce_mm": 1000 * straight.bounce},
    }


def _foot_paths(
    body: Any, courses: Mapping[Any, Any], walks: Mapping[Any, Mapping[str, gait_test.Course]], cycle: float
) -> dict[str, Any]:
    """Cut one cycle of the first leg's foot out of each walk, in the trunk's frame: asked of it, and walked."""
    geometry, steps = kinematics.geometry(body), round(cycle / gait_test.STEP)
    asked = {name: np.asarray(kinematics.forward(geometry, course[-steps:]))[:, 0] for name, course in courses.items()}
    walked = {name: both["mjx"].feet[-steps:, 0] for name, both in walks.items()}
    return {
        "velocities": np.array([left for left, _ in DRAWN]),
        "commanded": np.stack([asked[velocity, False] for velocity in DRAWN]),
        "simulated": np.stack([walked[velocity, False] for velocity in DRAWN]),
        "literal": walked[STRAIGHT, True],
    }
