"""The studies of gradients, from end to end, on synthetic dynamics whose solution is known."""

import json
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import safe_open

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.learning import gait_objective
from lgmdjax.locomotion import shaping
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.runtime import tracking
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches
from lgmdjax.studies import gait_gradient, gradient_horizon
from lgmdjax.studies.settings import GaitGradientSettings, GradientHorizonSettings

INPUTS = {"fit-gait": PRETRAINED_DIR, "train": PRETRAINED_DIR}
SETTINGS = GaitGradientSettings(
    robot_seconds=2880.0,
    window=1.6,
    learning_rate=5e-3,
    clip=1.0,
    pairs=2,
    sigma=0.02,
    evolution_learning_rate=5e-3,
    seeds=2,
)
BEST, LEAST = 1.05, 0.02  # coupling within tripods with the least sway, relative to the initial one; that sway [rad]


@pytest.fixture
def initial_coupling(monkeypatch):
    """In place of the physics, robots slide at the commanded speed, and their sway depends on one coupling."""
    first = float(gait_objective.from_shaping(shaping.load_pretrained()).within)

    def rollout(params, model, state, velocity, steps):
        speed = gait_gradient.NOMINAL_SPEED * jnp.mean(velocity)
        sway = LEAST + jnp.abs(params.within / first - BEST)
        summary = gait_objective.GaitSummary(
            speed=speed, yaw_rate=velocity[0] * 0.0, sway=sway, effort=1.0 + 0.0 * sway
        )
        data = state.data.replace(qpos=state.data.qpos.at[0].add(speed * steps * gait_test.TIME_STEP))
        return summary, replace(state, data=data)

    monkeypatch.setattr(gait_objective, "rollout", rollout)
    return first


def test_both_methods_fit_the_gait_for_the_same_simulated_time(initial_coupling, tmp_path):
    """The sway is least at a coupling 5 % above the initial one; the gradient leaves all other parameters unchanged."""
    logged: dict[str, list[float]] = {}
    with tracking.add_listener(lambda _, values: [logged.setdefault(k, []).append(v) for k, v in values.items()]):
        gait_gradient.run(tmp_path, INPUTS, SETTINGS, seed=0)
    rows = json.loads((tmp_path / "gait_gradient.json").read_text())
    assert [(row["method"], row["repeat"]) for row in rows] == [
        ("initial", 0), ("gradient", 0), ("gradient", 1), ("evolution", 0), ("evolution", 1)
    ]  # fmt: skip
    weight = gait_gradient.SWAY_WEIGHT / (LEAST + BEST - 1) ** 2
    for row in rows[1:]:
        time, losses = np.array(row["curve"]).T
        assert logged[f"{row['method']}, seed {row['repeat']}/loss"] == losses.tolist()
        rollouts = {"gradient": 1, "evolution": 2 * SETTINGS.pairs}[row["method"]]
        step = len(gait_gradient.COMMANDS) * gait_gradient.ROBOTS_PER_COMMAND * SETTINGS.window * rollouts
        np.testing.assert_allclose(time, step * np.arange(1, len(time) + 1))
        assert time[-1] == SETTINGS.robot_seconds
        with safe_open(tmp_path / f"shaping-{row['method']}-{row['repeat']}.safetensors", framework="numpy") as file:
            header = file.metadata()
        assert json.loads(header["within"]) == row["within"] and json.loads(header["seed"]) == row["repeat"]
        coupling = row["within"] / initial_coupling
        if row["method"] == "gradient":
            assert losses[0] == pytest.approx(gait_gradient.SWAY_WEIGHT + gait_gradient.EFFORT_WEIGHT, rel=1e-5)
            assert coupling == pytest.approx(BEST, abs=5e-3)
            least = weight * (LEAST + abs(coupling - BEST)) ** 2
            assert losses[-1] == pytest.approx(least + gait_gradient.EFFORT_WEIGHT, rel=0.1)
            initial = gait_objective.from_shaping(shaping.load_pretrained())
            assert row["cycle_time"] == pytest.approx(float(initial.cycle_time))
        else:
            assert coupling > 1 and losses[-1] < 0.9 * losses[0]
        assert row["speed_error"] < 0.02 and len(row["pitch_deg"]) == len(gait_gradient.STRAIGHT)  # in C MuJoCo
    fitted = shaping.load(tmp_path / "shaping-gradient-0.safetensors")
    jax.tree.map(np.testing.assert_array_equal, fitted, shaping.symmetrise(assembly.load_robot().controller.shaping))


def test_windows_continue_and_robots_that_fell_start_again(initial_coupling):
    params, model = gait_objective.from_shaping(shaping.load_pretrained()), hexapod.build()
    initial = gait_gradient.initial_tasks(params, model, jax.random.key(0), window=400)
    robots = len(gait_gradient.COMMANDS) * gait_gradient.ROBOTS_PER_COMMAND
    phases = np.asarray(jax.tree.leaves(initial.state.cpg)[0])
    assert initial.velocity.shape == (robots, 2) and len(np.unique(phases, axis=0)) == robots
    data = initial.state.data
    ends = replace(initial.state, data=data.replace(qpos=data.qpos.at[:, 0].add(1.0)))
    for broken in (ends.data.qpos.at[1, 2].set(0.001), ends.data.qpos.at[1, 0].set(jnp.nan)):
        after = gait_gradient.continue_tasks(
            model, initial, replace(ends, data=ends.data.replace(qpos=broken)), initial
        )
        moved = after.state.data.qpos[:, 0] - data.qpos[:, 0]
        np.testing.assert_allclose(moved, np.where(np.arange(robots) == 1, 0.0, 1.0), atol=1e-12)


ROOMS = 3


def command(before, numbers, frame, x, xp):
    """A synthetic command: a decaying function of the last one, of two controller parameters and of the contacts."""
    inhibition, cycle_time, softness = numbers
    label = 0.5 + 0.3 * xp.cos(0.1 * frame + x)
    return 0.9 * xp.sin(before) + inhibition + cycle_time * xp.asarray([0.1, 0.2]) + softness, label


@pytest.fixture
def synthetic_step(monkeypatch, unchecked):
    """In place of a frame of the closed loop, `command` with the room's first start pose."""

    def step(params, model, room, state, policy, *, render=True, grad_path="everything"):
        own, before = params.controller, state.controller.velocity
        numbers = own.detector.inhibition, own.cpg.cycle_time, model.pair_solref[0, 0]
        velocity, label = command(before, numbers, state.frame.astype(before.dtype), room.starts[0, 0], jnp)
        record: Any = Commands(velocity=velocity, label=label)
        return replace(state, controller=replace(state.controller, velocity=velocity), frame=state.frame + 1), record

    monkeypatch.setattr(closed_loop, "step", step)
    batch: Any = rollout.rollout_batch  # would be kept on disk as a program of the real step
    monkeypatch.setattr(rollout, "rollout_batch", jax.jit(batch.__wrapped__, static_argnames=("policy", "frames")))


class Commands(NamedTuple):
    """The fields of a record that the study reads."""

    velocity: jax.Array
    label: jax.Array


def expected_loss(frames: int, own: np.ndarray, changed: np.ndarray, x: float) -> float:
    """The loss of the last frames, in which the parameters differ from those before."""
    velocity, errors = np.zeros(2), []
    for frame in range(gradient_horizon.END_FRAME):
        late = frame >= gradient_horizon.END_FRAME - frames
        velocity, label = command(velocity, changed if late else own, frame, x, np)
        errors += [np.mean((velocity - label) ** 2)] if late else []
    return float(np.mean(errors))


def test_every_horizon_has_its_derivative_by_all_methods(synthetic_step, tmp_path, monkeypatch):
    """Losses and norms equal those of the same sums in NumPy; single precision starts from the same states."""
    monkeypatch.setattr(gradient_horizon, "HORIZONS", (1, 15, 150))
    gradient_horizon.run(
        tmp_path, INPUTS, GradientHorizonSettings(eyes=CameraSettings(width=16, height=12), robots=ROOMS), seed=4
    )
    rows = json.loads((tmp_path / "gradient_horizon.json").read_text())
    keys = [(row["contact"], row["precision"], row["horizon"], row["robot"]) for row in rows]
    assert len(set(keys)) == len(keys) == 2 * 2 * 3 * ROOMS
    params, model = assembly.load_robot().controller, hexapod.build()
    starts = np.asarray(room_batches.training_rooms(4, 0, ROOMS).starts)[:, 0, 0]
    softness = {"hard": float(model.pair_solref[0, 0]), "soft": float(hexapod.soften_contacts(model).pair_solref[0, 0])}
    assert softness["hard"] != softness["soft"]
    for row in rows:
        own = np.array([params.detector.inhibition, params.cpg.cycle_time, softness[row["contact"]]])
        x, double = float(starts[row["robot"]]), row["precision"] == "float64"
        assert row["loss"] == pytest.approx(expected_loss(row["horizon"], own, own, x), rel=1e-9 if double else 1e-4)
        shifts = 1e-6 * np.diag(np.abs(own) + 1e-6)[:2]  # in units of param_scales
        ends = [[expected_loss(row["horizon"], own, own + by * shift, x) for by in (1, -1)] for shift in shifts]
        gradient = np.array(ends) @ [1, -1] / 2e-6
        assert row["norm"] == pytest.approx(np.linalg.norm(gradient), rel=1e-5 if double else 1e-2)
        assert row["reverse"] == pytest.approx(row["forward"], rel=1e-9 if double else 1e-2)
        assert ("difference" in row) == double
        assert not double or row["difference"] == pytest.approx(row["reverse"], rel=1e-5)
    assert gradient_horizon.plot(rows).axes
