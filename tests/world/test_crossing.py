"""Obstacles that move into the way: where they come from, where and when they stop."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from lgmdjax.simulation import room_batches
from lgmdjax.world import arena, scenes

ROBOTS = 64


@pytest.fixture(scope="module")
def rooms():
    """Random rooms in which a box and a cylinder may cross the path of a robot from the first start."""
    drawn = room_batches.random_rooms(jax.random.key(5), ROBOTS)
    keys = jax.random.split(jax.random.key(6), ROBOTS)
    cross = jax.jit(jax.vmap(partial(scenes.cross_path, share=0.5)))
    return replace(drawn, arena=cross(drawn.arena, drawn.starts[:, 0], keys))


def crossings(rooms):
    """Yield the first prism of each kind, and the start, of all rooms in which it moves."""
    for kind in ("boxes", "cylinders"):
        prisms = getattr(rooms.arena, kind)
        for room in np.flatnonzero(np.asarray(prisms.arrives[:, 0]) > 0):
            yield jax.tree.map(lambda leaf, room=room: np.asarray(leaf[room, 0]), prisms), rooms.starts[room, 0]


def test_about_a_third_of_the_prisms_that_may_cross_do(rooms):
    """Each is chosen with probability 0.5; some motions would begin or end outside of the room."""
    count = sum(1 for _ in crossings(rooms))
    assert 0.15 * 2 * ROBOTS < count < 0.5 * 2 * ROBOTS


def test_they_come_from_the_side_and_stop_just_before_a_robot_that_walks_straight_on(rooms):
    for prism, start in crossings(rooms):
        x, y, yaw = np.asarray(start)
        to_robot = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        goal, origin = (to_robot @ (point - [x, y]) for point in (prism.goal, prism.centre))
        front = goal[0] - prism.half_size.max()
        nose = scenes.WALKING_SPEED * prism.arrives + scenes.HALF_ROBOT
        assert 0.2 - 1e-6 <= front - nose <= 0.7 + 1e-6
        assert abs(goal[1]) <= 0.1 + 1e-6
        np.testing.assert_allclose(origin[0], goal[0], atol=1e-5)
        assert 1.0 - 1e-6 <= abs(origin[1] - goal[1]) <= 2.5 + 1e-6
        assert 2 <= prism.departs <= 14 and 1.5 <= prism.arrives - prism.departs <= 3


def test_both_ends_of_a_motion_are_in_the_room(rooms):
    low, high = rooms.arena.bounds[:, None, 0::2], rooms.arena.bounds[:, None, 1::2]
    for prisms in (rooms.arena.boxes, rooms.arena.cylinders):
        moves = np.asarray(prisms.arrives > 0)
        for points in (prisms.centre, prisms.goal):
            assert np.all(np.asarray((points > low) & (points < high))[moves])


def test_nothing_moves_with_a_share_of_zero_and_the_rest_of_the_room_never_changes():
    room = scenes.random_room(jax.random.key(2))
    start = arena.sample_free_pose(jax.random.key(3), room)
    same = scenes.cross_path(room, start, jax.random.key(4), 0.0)
    jax.tree.map(np.testing.assert_array_equal, room, same)
    changed = [scenes.cross_path(room, start, jax.random.key(k), 1.0) for k in range(20)]
    assert any(np.any(np.asarray(each.boxes.arrives) > 0) for each in changed)
    for each in changed:
        for old, new in ((room.boxes, each.boxes), (room.cylinders, each.cylinders)):
            jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[1:], b[1:]), old, new)
            np.testing.assert_array_equal(old.half_size, new.half_size)
