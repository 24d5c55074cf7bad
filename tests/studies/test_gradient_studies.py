"""The studies that follow or compare gradients, from end to end, on walks that can be worked out by hand."""

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
from lgmdjax.paths import PRETRAINED
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, room_batches
from lgmdjax.studies import gait_gradient, gradient_horizon
from lgmdjax.studies.settings import GaitGradientSettings, GradientHorizonSettings

INPUTS = {"fit-gait": PRETRAINED, "train": PRETRAINED}
SETTINGS = GaitGradientSettings(
    robot_seconds=2880.0, window=1.6, learning_rate=5e-3, clip=1.0, pairs=2, sigma=0.02, evolution_rate=5e-3, seeds=2
)
BEST, LEAST = 1.05, 0.02  # of a rhythm's coupling within tripods, in its first size; rad, of sway


@pytest.fixture
def slid(monkeypatch):
    """In place of the physics: robots slide as fast as they are asked to, and sway with one coupling."""
    first = float(gait_objective.before(shaping.taught()).within)

    def walk(legs, model, walker, velocity, steps):
        speed = gait_gradient.SPEED * jnp.mean(velocity)
        sway = LEAST + jnp.abs(legs.within / first - BEST)
        course = gait_objective.Course(speed=speed, turn=velocity[0] * 0.0, sway=sway, effort=1.0 + 0.0 * sway)
        data = walker.data.replace(qpos=walker.data.qpos.at[0].add(speed * steps * gait_test.STEP))
        return course, replace(walker, data=data)

    monkeypatch.setattr(gait_objective, "walk", walk)
    return first


def test_legs_are_fitted_by_both_methods_for_as_many_simulated_seconds(slid, tmp_path):
    """To a sway that is least at a coupling 5 % above the first; what nothing hangs on, the gradient leaves alone."""
    gait_gradient.work(tmp_path, INPUTS, SETTINGS, seed=0)
    rows = json.loads((tmp_path / "gait_gradient.json").read_text())
    assert [(row["method"], row["start"]) for row in rows] == [
        ("before", 0), ("gradient", 0), ("gradient", 1), ("evolution", 0), ("evolution", 1)
    ]  # fmt: skip
    weight = gait_gradient.SWAY_COUNTS / (LEAST + BEST - 1) ** 2
    for row in rows[1:]:
        spent, losses = np.array(row["curve"]).T
        tries = {"gradient": 1, "evolution": 2 * SETTINGS.pairs}[row["method"]]
        each = len(gait_gradient.COMMANDS) * gait_gradient.ROBOTS * SETTINGS.window * tries
        np.testing.assert_allclose(spent, each * np.arange(1, len(spent) + 1))
        assert spent[-1] == SETTINGS.robot_seconds
        with safe_open(tmp_path / f"shaping-{row['method']}-{row['start']}.safetensors", framework="numpy") as file:
            told = file.metadata()
        assert json.loads(told["within"]) == row["within"] and json.loads(told["seed"]) == row["start"]
        if row["method"] == "gradient":
            assert losses[0] == pytest.approx(gait_gradient.SWAY_COUNTS + gait_gradient.EFFORT_COUNTS, rel=1e-5)
            assert row["within"] / slid == pytest.approx(BEST, abs=5e-3)
            least = weight * (LEAST + abs(row["within"] / slid - BEST)) ** 2
            assert losses[-1] == pytest.approx(least + gait_gradient.EFFORT_COUNTS, rel=0.1)
            assert row["cycle_time"] == pytest.approx(float(gait_objective.before(shaping.taught()).cycle_time))
        else:
            assert row["within"] > slid and losses[-1] < 0.9 * losses[0]
        assert row["speed_error"] < 0.02 and len(row["pitch_deg"]) == len(gait_gradient.STRAIGHT)  # in C MuJoCo
    taught = shaping.load(tmp_path / "shaping-gradient-0.safetensors")
    jax.tree.map(np.testing.assert_array_equal, taught, shaping.symmetric(assembly.trained().controller.shaping))


def test_robots_walk_on_and_those_that_fell_begin_again(slid):
    legs, model = gait_objective.before(shaping.taught()), hexapod.build()
    began = gait_gradient.tasks(legs, model, jax.random.key(0), window=400)
    robots = len(gait_gradient.COMMANDS) * gait_gradient.ROBOTS
    phases = np.asarray(jax.tree.leaves(began.walker.rhythm)[0])
    assert began.velocity.shape == (robots, 2) and len(np.unique(phases, axis=0)) == robots
    ends = replace(began.walker, data=began.walker.data.replace(qpos=began.walker.data.qpos.at[:, 0].add(1.0)))
    for broken in (ends.data.qpos.at[1, 2].set(0.001), ends.data.qpos.at[1, 0].set(jnp.nan)):
        after = gait_gradient.going_on(began, replace(ends, data=ends.data.replace(qpos=broken)), began)
        moved = after.walker.data.qpos[:, 0] - began.walker.data.qpos[:, 0]
        np.testing.assert_allclose(moved, np.where(np.arange(robots) == 1, 0.0, 1.0), atol=1e-12)


ROOMS = 3


def commanded(before, numbers, frame, place, xp):
    """A made-up command from the one before: it forgets slowly, and hangs on two numbers of the nerves and one more."""
    inhibition, cycle_time, softness = numbers
    label = 0.5 + 0.3 * xp.cos(0.1 * frame + place)
    return 0.9 * xp.sin(before) + inhibition + cycle_time * xp.asarray([0.1, 0.2]) + softness, label


@pytest.fixture
def made_up(monkeypatch, unchecked):
    """In place of a frame: commands made up, from the room, the contacts and the last ones."""

    def step(params, model, room, state, driver, draw=True, through="everything"):
        nerves, before = params.controller, state.controller.velocity
        numbers = nerves.lgmd.inhibition, nerves.cpg.cycle_time, model.pair_solref[0, 0]
        velocity, label = commanded(before, numbers, state.frame.astype(before.dtype), room.starts[0, 0], jnp)
        record: Any = Said(velocity=velocity, label=label)
        return replace(state, controller=replace(state.controller, velocity=velocity), frame=state.frame + 1), record

    monkeypatch.setattr(closed_loop, "step", step)


class Said(NamedTuple):
    """What the study reads of a frame."""

    velocity: jax.Array
    label: jax.Array


def by_hand(frames: int, own: np.ndarray, changed: np.ndarray, place: float) -> float:
    """The loss of the last frames, in which the numbers are others than before."""
    velocity, errors = np.zeros(2), []
    for frame in range(gradient_horizon.FRAMES):
        late = frame >= gradient_horizon.FRAMES - frames
        velocity, label = commanded(velocity, changed if late else own, frame, place, np)
        errors += [np.mean((velocity - label) ** 2)] if late else []
    return float(np.mean(errors))


def test_every_horizon_has_its_derivative_by_every_route(made_up, tmp_path, monkeypatch):
    """Losses and norms are those of the same sums in NumPy; rows of single precision begin where the others do."""
    monkeypatch.setattr(gradient_horizon, "HORIZONS", (1, 15, 150))
    gradient_horizon.work(
        tmp_path, INPUTS, GradientHorizonSettings(eyes=CameraSettings(width=16, height=12), robots=ROOMS), seed=4
    )
    rows = json.loads((tmp_path / "gradient_horizon.json").read_text())
    keys = [(row["contact"], row["precision"], row["horizon"], row["robot"]) for row in rows]
    assert len(set(keys)) == len(keys) == 2 * 2 * 3 * ROOMS
    nerves, places = assembly.trained().controller, np.asarray(room_batches.rooms_of(4, 0, ROOMS).starts)[:, 0, 0]
    model = hexapod.build()
    softness = {"hard": float(model.pair_solref[0, 0]), "soft": float(hexapod.softened(model).pair_solref[0, 0])}
    assert softness["hard"] != softness["soft"]
    for row in rows:
        own = np.array([nerves.lgmd.inhibition, nerves.cpg.cycle_time, softness[row["contact"]]])
        place, double = float(places[row["robot"]]), row["precision"] == "float64"
        assert row["loss"] == pytest.approx(by_hand(row["horizon"], own, own, place), rel=1e-9 if double else 1e-4)
        shifts = 1e-6 * np.diag(np.abs(own) + 1e-6)[:2]  # shares of their sizes, as in the study
        ends = [[by_hand(row["horizon"], own, own + by * shift, place) for by in (1, -1)] for shift in shifts]
        gradient = np.array(ends) @ [1, -1] / 2e-6
        assert row["norm"] == pytest.approx(np.linalg.norm(gradient), rel=1e-5 if double else 1e-2)
        assert row["slope"] == pytest.approx(row["forward"], rel=1e-9 if double else 1e-2)
        assert ("difference" in row) == double
        assert not double or row["difference"] == pytest.approx(row["slope"], rel=1e-5)
    assert gradient_horizon.draw(rows).axes
