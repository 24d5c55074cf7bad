"""Variations of rooms for training."""

import jax
import numpy as np
import pytest

from lgmdjax.simulation import room_batches
from lgmdjax.world import arena, scenes, variation

ROOMS = 64


@pytest.fixture(scope="module")
def rooms():
    """Rooms without and with obstacles that cross the path, and the starts."""
    keys = jax.random.split(jax.random.key(5), ROOMS)
    still = jax.vmap(lambda key: scenes.random_room(key, 0.15))(keys)
    return still, jax.vmap(variation.cross_path)(still, jax.random.split(jax.random.key(6), ROOMS), still.start)


@pytest.mark.parametrize("kind", ["boxes", "cylinders"])
def test_crossing_obstacles_stop_before_a_robot_that_walks_straight_ahead(rooms, kind):
    """The gap between robot and obstacle is as asked, by plane geometry in the frame of the start."""
    still, moving = (jax.tree.map(np.asarray, getattr(room, kind)) for room in rooms)
    starts = np.asarray(rooms[0].start)
    moves = moving.arrives[:, 0] > moving.departs[:, 0]
    assert abs(moves.mean() - variation.CROSSING_SHARE) < 0.2
    from_left = []
    for row in np.flatnonzero(moves):
        x, y, yaw = starts[row]
        there = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        goal, centre = (there @ (p[row, 0] - (x, y)) for p in (moving.goal, moving.centre))
        front = variation.FREE_SPEED * moving.arrives[row, 0] + variation.ROBOT_LENGTH
        gap = goal[0] - np.hypot(*moving.half_size[row, 0]) - front
        assert variation.GAP[0] - 1e-5 <= gap <= variation.GAP[1] + 1e-5
        assert abs(goal[1]) <= variation.OFFSET + 1e-5
        assert goal[0] == pytest.approx(centre[0], abs=1e-5)
        assert variation.LATERAL[0] - 1e-5 <= abs(goal[1] - centre[1]) <= variation.LATERAL[1] + 1e-5
        from_left.append(centre[1] > goal[1])
    assert 0.2 < np.mean(from_left) < 0.8
    for name in ("centre", "goal", "half_size", "top"):
        np.testing.assert_array_equal(getattr(moving, name)[:, 1:], getattr(still, name)[:, 1:])
        np.testing.assert_array_equal(getattr(moving, name)[~moves], getattr(still, name)[~moves])


def test_obstacles_move_in_the_learners_episodes_only():
    """And its later starts are free where the obstacles have arrived."""
    first = room_batches.LEARNER_EPISODES[0]
    for episode, moves in ((0, False), (first - 1, False), (first, True), (room_batches.LEARNER_EPISODES.stop, False)):
        room = room_batches.training_rooms(3, episode, 8)
        assert np.any(np.asarray(room.arena.boxes.arrives) > 0) == moves
    moved = room_batches.training_rooms(3, first, 8)
    clearances = jax.vmap(lambda room: arena.pose_clearances(arena.at_time(room.arena, 60.0), room.starts[1:]))(moved)
    assert np.mean(np.asarray(clearances) >= 0.45 - 1e-6) > 0.98
