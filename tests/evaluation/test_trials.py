"""The paper's trials: their rooms, and the outcomes of walks."""

from typing import get_args

import jax
import numpy as np
import pytest
from synthetic import walk

from lgmdjax.evaluation import run_trial, trials
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.world import arena, scenes

KEY = jax.random.key(8)
SCENES = ("tube", "indoor", "outdoor", "dynamic", "gap", "gap-60cm", "pocket", "white", "corner")
TUBE = trials.TRIALS["tube"]


@pytest.fixture(scope="module")
def rooms():
    return {name: trials.TRIALS[name].make_rooms(KEY, 2) for name in SCENES}


def test_names_of_the_trials_are_those_of_the_settings():
    assert tuple(trials.TRIALS) == get_args(TrialName)
    assert all(name == trial.name for name, trial in trials.TRIALS.items())


@pytest.mark.parametrize("name", SCENES)
def test_rooms_are_valid_and_starts_are_near_those_of_the_paper(rooms, name):
    batch = rooms[name]
    arena.validate(batch.arena)
    np.testing.assert_array_equal(batch.starts[:, 0], batch.arena.start)
    expected = np.array([0, 0, np.pi / 4 if name == "corner" else 0])
    jitters = {"gap": trials.GAP_JITTER, "gap-60cm": trials.GAP_JITTER, "pocket": trials.POCKET_JITTER}
    jitter = jitters.get(name, trials.START_JITTER)
    assert np.all(np.abs(np.abs(batch.arena.start) - expected) <= np.array(jitter) + 1e-12)
    assert len(np.unique(batch.arena.start[:, 0])) > 1


def test_the_tube_is_at_fifteen_lateral_offsets_to_either_side(rooms):
    tubes = np.asarray(rooms["tube"].arena.cylinders.centre)[:, 0]
    assert tubes.shape == (2 * 15 * 2, 2)
    np.testing.assert_allclose(tubes[:, 0], 1.25)
    sides = tubes[:, 1].reshape(2, 15, 2)
    np.testing.assert_allclose(sides[..., 0], [np.linspace(0, 0.42, 15)] * 2, atol=1e-12)
    np.testing.assert_allclose(sides[..., 1], -sides[..., 0])


def test_every_second_room_is_a_mirror_image(rooms):
    assert rooms["indoor"].arena.handedness.tolist() == [1, -1]
    table = np.asarray(rooms["indoor"].arena.boxes.centre)[:, 2]
    np.testing.assert_allclose(table[0] * [1, -1], table[1])


@pytest.mark.parametrize("name", SCENES)
def test_no_texture_occurs_in_the_training_room(rooms, name):
    training = np.asarray(scenes.training_room().boxes.texture)
    textures = np.asarray(rooms[name].arena.boxes.texture).reshape(-1, 4)
    assert not np.any(np.all(np.isclose(textures[:, None], training[None]), axis=-1))


def test_contacts_after_passing_do_not_count():
    """At 0.05 m/s a robot is 0.4 m beyond the tube after 33 s of 40 s."""
    contact = np.zeros((2, 1200), bool)
    contact[0, 1100], contact[1, 500] = True, True
    clearance = np.full((2, 1200), 0.3)
    clearance[0, 700], clearance[0, 1100], clearance[1, 500] = 0.1, 0.0, -0.01
    outcome = trials.find_outcome(TUBE, walk(contact=contact, clearance=clearance))
    assert outcome.touched.tolist() == [False, True]
    assert outcome.frames.tolist() == [pytest.approx(1.65 / 0.05 * 30, abs=2), 501]
    np.testing.assert_allclose(outcome.clearance, [0.1, -0.01])
    assert outcome.avoided().value == 0.5


def test_a_robot_that_turns_back_has_retreated_and_a_lost_robot_has_failed():
    """A third robot turns back, turns again and passes."""
    yaw = np.zeros((3, 1200))
    yaw[0] = np.linspace(0, 3.0, 1200)
    yaw[2, 100:300] = 3.0
    ok = np.ones((3, 1200), bool)
    ok[1, 600:] = False
    position = np.zeros((3, 1200, 3))
    position[2, 900:, 0] = 2.0
    quaternion = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
    outcome = trials.find_outcome(TUBE, walk(3, quaternion=quaternion, ok=ok, position=position))
    assert outcome.retreated.tolist() == [True, False, False]
    assert outcome.passed.tolist() == [False, False, True]
    assert outcome.touched.tolist() == [False, True, False]
    assert outcome.frames.tolist() == [1200, 601, 901]


def test_a_trial_without_contact_or_passing_ends_with_the_record():
    outcome = trials.find_outcome(TUBE, walk(1, frames=300))
    assert (outcome.frames.tolist(), outcome.touched.tolist(), outcome.retreated.tolist()) == ([300], [False], [False])


def test_turning_on_the_spot_is_no_success():
    """It touches nothing, and counts neither as having passed nor as progress."""
    yaw = np.tile(0.2 * np.arange(1200) / 30, (2, 1))
    quaternion = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
    record = walk(position=np.zeros((2, 1200, 3)), quaternion=quaternion)
    for trial in trials.TRIALS.values():
        if trial.ends_at_contact:
            outcome = trials.find_outcome(trial, record)
            assert not outcome.touched.any() and not outcome.passed.any() and outcome.retreated.all()
            assert outcome.passing().value == 0 and np.all(outcome.made_good == 0)
    summary = run_trial.summarise(TUBE, record)
    assert (summary["untouched"], summary["passed"], summary["made_good"]["value"]) == (2, 0, 0)
    assert summary["progress"]["hard_turning"]["value"] > 0.98  # but for the ends of the average
    assert summary["progress"]["longest_rotation"] > 1


def test_frames_after_the_end_of_a_trial_are_no_progress():
    """The robots pass the tube after 33 s and then turn on the spot."""
    yaw = np.zeros((2, 1200))
    yaw[:, 1000:] = 0.2 * np.arange(200) / 30
    quaternion = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
    summary = run_trial.summarise(TUBE, walk(quaternion=quaternion))
    assert summary["passed"] == 2 and summary["passing"]["value"] == 1
    assert summary["made_good"]["value"] == pytest.approx(0.05, rel=0.01)
    assert summary["progress"]["hard_turning"]["value"] == 0


def test_rooms_to_cross_have_a_way_from_a_free_start_towards_their_end():
    rooms = trials.TRIALS["traverse"].make_rooms(KEY, 3)
    arena.validate(rooms.arena)
    np.testing.assert_allclose(rooms.arena.bounds, [[-6, 6, -3, 3]] * 3)
    np.testing.assert_array_equal(rooms.starts[:, 0], rooms.arena.start)
    np.testing.assert_allclose(rooms.arena.start[:, ::2], [[-5.2, 0]] * 3)
    assert len(np.unique(rooms.arena.start[:, 1])) == 3
    present = np.asarray(rooms.arena.boxes.top > 0).sum(1) + np.asarray(rooms.arena.cylinders.top > 0).sum(1)
    assert np.all(present >= 12)  # 0.2 for each of the 72 square metres are 14; some find no place


def test_success_is_weighted_by_the_length_of_the_path():
    """One robot walks straight on, one a triangle wave of 45 degrees, and one touches something on its way."""
    trial = trials.TRIALS["traverse"]
    frames = 9000
    position = np.zeros((3, frames, 3))
    position[..., 0] = -5.2 + 0.06 * np.arange(frames) / 30
    position[1, :, 1] = np.abs((0.06 * np.arange(frames) / 30) % 2 - 1)
    contact = np.zeros((3, frames), bool)
    contact[2, 3000] = True
    outcome = trials.find_outcome(trial, walk(3, frames, position=position, contact=contact))
    assert outcome.passed.tolist() == [True, True, False]
    np.testing.assert_allclose(outcome.walked[:2], [10.2, 10.2 * np.sqrt(2)], rtol=0.01)
    np.testing.assert_allclose(outcome.spl, [1, 1 / np.sqrt(2), 0], rtol=0.01)
    summary = run_trial.summarise(trial, walk(3, frames, position=position, contact=contact))
    assert summary["touches_per_100_m"]["value"] == pytest.approx(100 / outcome.walked.sum())
    assert summary["spl"]["value"] == pytest.approx(outcome.spl.mean())
    assert "spl" not in run_trial.summarise(TUBE, walk())
