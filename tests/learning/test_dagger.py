"""DAgger: what each round is fitted to, who walks in it, and how an interrupted run resumes."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from synthetic import walk

from lgmdjax.control import navigator
from lgmdjax.learning import behaviour_cloning, dagger
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, episodes, recording

SETTINGS = TrainSettings(
    eyes=CameraSettings(width=16, height=12), epochs=1, dagger_rounds=2, round_epochs=1, robots=4, round_seconds=0.1
)


@pytest.fixture
def run_dagger(monkeypatch):
    """Run DAgger with stand-ins for rollout and fit: batches of two robots, a learner that shows its training data.

    The learner's `output_mean` is one plus the number of segments that it was fitted to; `seen` has it per batch.
    """
    seen, has_faults, interrupt_at = [], [], [0]

    def fit(params, train, test, settings, checkpoints):
        fitted = replace(params, output_mean=np.full(2, 1.0 + len(train) + len(test)))
        return behaviour_cloning.FitResult(params=fitted, best=fitted, train_mse=np.zeros(1), test_mse=np.zeros(1))

    def rollout(params, model, rooms, seconds, label, *, render):
        has_faults.append(rooms.faults is not None)
        learner = next(one for one in params.controller.policy.policies if isinstance(one, navigator.Params))
        seen.append(float(learner.output_mean[0]))
        if len(seen) == interrupt_at[0]:
            raise KeyboardInterrupt
        yield walk(len(rooms.starts), frames=150)

    def run(folder, recorded, at_batch=0, camera_faults=()):
        seen.clear()
        interrupt_at[0] = at_batch
        robot = assembly.assemble(assembly.make_policies())
        has_faults.clear()
        run.has_faults = has_faults
        return dagger.run(folder, robot, recorded, SETTINGS, seed=0, camera_faults=camera_faults), list(seen)

    monkeypatch.setattr(recording, "BATCH_SIZES", (2,))
    monkeypatch.setattr(recording, "rollout_with_progress", rollout)
    monkeypatch.setattr(behaviour_cloning, "fit", fit)
    monkeypatch.setattr(behaviour_cloning, "rescale_turns", lambda params, walks: params)
    return run


@pytest.fixture
def recorded():
    fields = [{name: np.asarray(x)[k] for name, x in vars(walk(8, frames=150)).items()} for k in range(8)]
    return [episodes.Walk(episode=0, robot=k, room=k, seed=0, **fields[k]) for k in range(8)]


def test_every_round_is_fitted_to_all_walks_so_far_and_has_rooms_of_its_own(run_dagger, recorded, tmp_path):
    walks, seen = run_dagger(tmp_path, recorded)
    assert seen == [9.0, 9.0, 13.0, 13.0]  # 8 segments, then 4 more; two batches each
    assert len(walks) == 16 and len({one.room for one in walks}) == 16
    again = dagger.read_rounds(tmp_path)
    assert [one.room for one in again] == [one.room for one in walks[8:]]


def test_a_round_interrupted_between_batches_resumes_with_the_same_learner(run_dagger, recorded, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_dagger(tmp_path, recorded, at_batch=2)
    walks, seen = run_dagger(tmp_path, recorded)
    assert seen == [9.0, 13.0, 13.0]
    assert len(walks) == 16


def test_faults_of_the_cameras_are_in_the_rooms_and_in_the_record(run_dagger, recorded, tmp_path):
    run_dagger(tmp_path, recorded, camera_faults=("noise", "jpeg"))
    assert run_dagger.has_faults == [True] * 4
    header = episodes.read_parameters(tmp_path / "walks" / "round-1")
    assert header["camera_faults"] == ["noise", "jpeg"]
    run_dagger(tmp_path / "without", recorded)
    assert run_dagger.has_faults == [False] * 4
    assert "camera_faults" not in episodes.read_parameters(tmp_path / "without" / "walks" / "round-1")


def test_finished_rounds_are_not_repeated(run_dagger, recorded, tmp_path):
    before, _ = run_dagger(tmp_path, recorded)
    after, seen = run_dagger(tmp_path, recorded)
    assert seen == []
    jax.tree.map(np.testing.assert_array_equal, [vars(one) for one in before], [vars(one) for one in after])


def test_the_three_parts_share_no_room(recorded):
    parts = [{one.room for one in part} for part in dagger.split_rooms(recorded, seed=3)]
    assert sum(map(len, parts)) == len(set.union(*parts)) == 8
    assert all(parts)


def test_an_approach_ends_when_the_robot_is_twice_as_far_away():
    """Of three robots one sways across the threshold, one leaves and returns, and one is reset in between."""
    clearance = np.full((3, 60), 0.12)
    clearance[0, 10:40:2] = 0.05
    clearance[1, [10, 30]], clearance[1, 20] = 0.05, 0.3
    clearance[2, [10, 30]] = 0.05
    is_first = np.zeros((3, 60), bool)
    is_first[2, 20] = True
    assert dagger.count_approaches(walk(3, frames=60, clearance=clearance, is_first=is_first)) == 1 + 2 + 2


def test_the_smallest_turn_gain_with_the_fewest_approaches_is_selected(recorded, tmp_path, monkeypatch):
    """Over the same distance there are 3, 1 and 1 approaches; without a choice no robot walks."""
    approaches = {1.5: 3, 2.0: 1, 2.5: 1}

    def record_rollouts(folder, learner, rooms, seconds, policy, *, parameters, **_):
        clearance = np.full((len(rooms.starts), 600), 0.3)
        for k in range(approaches[parameters["caution"]]):
            clearance[0, 100 * (k + 1) : 100 * (k + 1) + 20] = 0.05
        return walk(len(rooms.starts), frames=600, clearance=clearance)

    monkeypatch.setattr(recording, "record_rollouts", record_rollouts)
    monkeypatch.setattr(
        behaviour_cloning, "rescale_turns", lambda params, walks, turn_gain=1.5: replace(params, output_scale=turn_gain)
    )
    robot, params = assembly.assemble(assembly.make_policies()), navigator.create(jax.random.key(0))
    fit = behaviour_cloning.FitResult(params=params, best=params, train_mse=np.zeros(1), test_mse=np.zeros(1))
    several = replace(SETTINGS, turn_gains=tuple(approaches))
    chosen, rows = dagger.select_turn_gain(tmp_path, robot, fit, recorded, several, seed=0)
    assert chosen.output_scale == 2.0
    assert [(row["caution"], row["tight"], row["chosen"]) for row in rows] == [
        (1.5, 3, False),
        (2.0, 1, True),
        (2.5, 1, False),
    ]
    chosen, rows = dagger.select_turn_gain(tmp_path, robot, fit, recorded, SETTINGS, seed=0)
    assert chosen.output_scale == 1.5 and rows == [{"caution": behaviour_cloning.TURN_GAIN, "chosen": True}]
