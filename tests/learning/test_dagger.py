"""Practice: who walks, what is learned from, and what a kill between two crowds leaves."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from synthetic import walk

from lgmdjax.control import navigator
from lgmdjax.learning import behaviour_cloning, dagger
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, episodes, recording

SETTINGS = TrainSettings(
    eyes=CameraSettings(width=16, height=12), epochs=1, rounds=2, round_epochs=1, robots=4, round_seconds=0.1
)


@pytest.fixture
def drive(monkeypatch):
    """Stand-ins for walking and fitting: crowds of two, a pupil whose outputs tell what it learned from."""
    seen = []

    def fit(params, train, test, settings, checkpoints):
        taught = replace(params, output_mean=np.full(2, 1.0 + len(train) + len(test)))
        return behaviour_cloning.Fit(params=taught, best=taught, train=np.zeros(1), test=np.zeros(1))

    def walks(params, model, rooms, seconds, label, *, draw):
        pupil = next(one for one in params.controller.driver.drivers if isinstance(one, navigator.Params))
        seen.append(float(pupil.output_mean[0]))
        if len(seen) == drive.killed_at:
            raise KeyboardInterrupt
        yield walk(len(rooms.starts), frames=150)

    def drive(folder, recorded, killed_at=0):
        seen.clear()
        drive.killed_at = killed_at
        robot = closed_loop.assemble(assembly.everyone())
        return dagger.practise(folder, robot, recorded, SETTINGS, seed=0), list(seen)

    monkeypatch.setattr(recording, "CROWD", 2)
    monkeypatch.setattr(recording, "walks", walks)
    monkeypatch.setattr(behaviour_cloning, "fit", fit)
    monkeypatch.setattr(behaviour_cloning, "enliven", lambda params, walks: params)
    return drive


@pytest.fixture
def recorded():
    fields = [{name: np.asarray(x)[k] for name, x in vars(walk(8, frames=150)).items()} for k in range(8)]
    return [episodes.Walk(episode=0, robot=k, room=k, seed=0, **fields[k]) for k in range(8)]


def test_every_round_learns_from_all_walks_so_far_in_rooms_of_their_own(drive, recorded, tmp_path):
    walks, seen = drive(tmp_path, recorded)
    assert seen == [9.0, 9.0, 13.0, 13.0]  # 8 stretches, then 4 more; two crowds each
    assert len(walks) == 16 and len({one.room for one in walks}) == 16
    again = dagger.practised(tmp_path)
    assert [one.room for one in again] == [one.room for one in walks[8:]]


def test_after_a_kill_between_two_crowds_the_same_pupil_walks_on(drive, recorded, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        drive(tmp_path, recorded, killed_at=2)
    walks, seen = drive(tmp_path, recorded)
    assert seen == [9.0, 13.0, 13.0]
    assert len(walks) == 16


def test_what_is_done_is_not_walked_again(drive, recorded, tmp_path):
    before, _ = drive(tmp_path, recorded)
    after, seen = drive(tmp_path, recorded)
    assert seen == []
    jax.tree.map(np.testing.assert_array_equal, [vars(one) for one in before], [vars(one) for one in after])


def test_no_room_is_in_two_of_the_three_parts(recorded):
    parts = [{one.room for one in part} for part in dagger.split(recorded, seed=3)]
    assert sum(map(len, parts)) == len(set.union(*parts)) == 8
    assert all(parts)


def test_an_approach_lasts_until_the_robot_was_twice_as_far():
    """Three robots: one sways over the bound, one comes back after it was free, one is put down anew in between."""
    clearance = np.full((3, 60), 0.12)
    clearance[0, 10:40:2] = 0.05
    clearance[1, [10, 30]], clearance[1, 20] = 0.05, 0.3
    clearance[2, [10, 30]] = 0.05
    fresh = np.zeros((3, 60), bool)
    fresh[2, 20] = True
    assert dagger.approaches(walk(3, frames=60, clearance=clearance, fresh=fresh)) == 1 + 2 + 2


def test_caution_is_the_least_of_those_that_come_too_near_least_often(recorded, tmp_path, monkeypatch):
    """Robots come too near `3, 1, 1` times in as much of a way; nothing is walked where there is no choice."""
    times = {1.5: 3, 2.0: 1, 2.5: 1}

    def walked(folder, pupil, rooms, seconds, driver, *, facts, **_):
        clearance = np.full((len(rooms.starts), 600), 0.3)
        for time in range(times[facts["caution"]]):
            clearance[0, 100 * (time + 1) : 100 * (time + 1) + 20] = 0.05
        return walk(len(rooms.starts), frames=600, clearance=clearance)

    monkeypatch.setattr(recording, "walked", walked)
    monkeypatch.setattr(
        behaviour_cloning, "enliven", lambda params, walks, caution=1.5: replace(params, output_scale=caution)
    )
    robot, params = closed_loop.assemble(assembly.everyone()), navigator.create(jax.random.key(0))
    fit = behaviour_cloning.Fit(params=params, best=params, train=np.zeros(1), test=np.zeros(1))
    choice = replace(SETTINGS, cautions=tuple(times))
    chosen, rows = dagger.tempered(tmp_path, robot, fit, recorded, choice, seed=0)
    assert chosen.output_scale == 2.0
    assert [(row["caution"], row["tight"], row["chosen"]) for row in rows] == [
        (1.5, 3, False),
        (2.0, 1, True),
        (2.5, 1, False),
    ]
    chosen, rows = dagger.tempered(tmp_path, robot, fit, recorded, SETTINGS, seed=0)
    assert chosen.output_scale == 1.5 and rows == [{"caution": behaviour_cloning.CAUTION, "chosen": True}]
