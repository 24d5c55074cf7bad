"""Rollouts of any number of robots: batches, policies by name, and records in a folder; the simulation is a stub."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.control import policies
from lgmdjax.errors import InputError
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.world import arena

FRAMES = 30


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


@pytest.fixture(scope="module")
def rooms():
    """Five rooms whose first starts tell them apart."""
    starts = jnp.zeros((5, 1, 3)).at[:, 0, 0].set(jnp.arange(5.0))
    arenas = jax.tree.map(lambda leaf: jnp.stack([leaf] * 5), arena.empty_room((5.0, 4.0)))
    return closed_loop.Room(arena=arenas, starts=starts, key=jax.random.split(jax.random.key(0), 5))


@pytest.fixture
def calls(monkeypatch):
    """Rollouts at rest at each room's first start, two robots in a batch; a list of (policy, render, robots)."""
    made = []

    def stand(params, model, rooms, seconds, label, *, render=True):
        robots = len(rooms.starts)
        made.append((policies.POLICIES[int(params.controller.policy.active)].name, render, robots))
        position = np.zeros((robots, FRAMES, 3)) + np.asarray(rooms.starts)[:, :1]
        for half in (slice(0, 20), slice(20, FRAMES)):
            yield jax.tree.map(lambda leaf, half=half: leaf[:, half], synthetic.walk(robots, FRAMES, position=position))

    monkeypatch.setattr(recording, "rollout_with_progress", stand)
    monkeypatch.setattr(recording, "BATCH_SIZES", (2,))
    return made


@pytest.mark.parametrize(
    ("policy", "render"), [("learned", True), ("blind", False), ("direct", True), ("random", False)]
)
def test_rollout_returns_one_record_of_all_robots(robot, rooms, calls, policy, render):
    record = recording.rollout(robot, rooms, seconds=1.0, policy=policy)
    assert calls == [(policy, render, 2)] * 3
    assert record.time.shape == (5, FRAMES)
    np.testing.assert_array_equal(record.position[:, 0, 0], np.arange(5.0))


def test_rollout_renders_on_demand(robot, rooms, calls):
    recording.rollout(robot, rooms, seconds=1.0, policy="blind", render=True)
    assert calls[0] == ("blind", True, 2)


@pytest.mark.parametrize(("robots", "sizes"), [(1, [2]), (2, [2]), (3, [4]), (5, [4, 4])])
def test_few_robots_get_a_small_batch(robot, rooms, calls, monkeypatch, robots, sizes):
    monkeypatch.setattr(recording, "BATCH_SIZES", (2, 4))
    some = jax.tree.map(lambda leaf: leaf[:robots], rooms)
    record = recording.rollout(robot, some, seconds=1.0)
    assert [size for *_, size in calls] == sizes
    np.testing.assert_array_equal(record.position[:, 0, 0], np.arange(robots))


@pytest.mark.usefixtures("unchecked")
def test_an_unknown_policy_is_refused(robot, rooms):
    with pytest.raises(InputError, match="policy: expected one of teacher"):
        recording.rollout(robot, rooms, seconds=1.0, policy="nobody")  # pyright: ignore[reportArgumentType]


def test_recorded_batches_are_not_rolled_out_again(robot, rooms, calls, tmp_path):
    how = {"seed": 7, "parameters": {"speed": 1.2}, "label": "test"}
    first = recording.record_rollouts(tmp_path, robot, rooms, 1.0, policies.BLIND, **how)
    assert len(calls) == 3 and recording.is_recorded(tmp_path, 5)
    (tmp_path / "chunk-00002.parquet").unlink()
    assert not recording.is_recorded(tmp_path, 5)
    again = recording.record_rollouts(tmp_path, robot, rooms, 1.0, policies.BLIND, **how)
    assert len(calls) == 4
    jax.tree.map(np.testing.assert_array_equal, again, first)


def test_a_benchmark_of_another_robot_is_refused(robot, rooms, calls, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "benchmark_rooms", lambda *_: jax.tree.map(lambda leaf: leaf[:2], rooms))
    benchmark = BenchmarkRooms(eyes=CameraSettings(width=80, height=60), robots=2, seconds=1.0)
    record = recording.record_benchmark(tmp_path, robot, benchmark, policies.TEACHER, 0, label="test")
    assert record.time.shape == (2, FRAMES)
    other = assembly.with_camera(robot, CameraSettings(width=40, height=30))
    with pytest.raises(InputError, match="expected walks of the same settings, got robot"):
        recording.record_benchmark(tmp_path, other, benchmark, policies.TEACHER, 0, label="test")
