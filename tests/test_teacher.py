"""The teacher in closed loop with the body: it avoids all obstacles; eq. 22 alone does not."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, policies
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop, rollout, room_batches
from lgmdjax.world import scenes

pytestmark = pytest.mark.usefixtures("float32")
TEACHER = braitenberg.Params()
RULE = {"full_turn": 0.0, "tie_tolerance": 0.0}  # eq. 22, limited to the gait's range


@cache  # two tests use the record of the same rule
def rollout_teacher(**changes: float) -> closed_loop.Record:
    """Roll out eight robots for a minute from the centre of the training room, each with another heading."""
    teacher = replace(TEACHER, **changes)
    params = closed_loop.assemble(teacher, teacher_params=teacher, camera_params=camera.Params(width=16, height=12))
    rooms = room_batches.replicate_room(jax.random.key(0), scenes.training_room(), 8)
    chunks = rollout.rollout_chunks(params, hexapod.build(), rooms, policies.TEACHER, 60.0, render=False)
    return rollout.concatenate_time(list(chunks))


@pytest.mark.slow
def test_teacher_explores_the_training_room_without_contact():
    """All robots walk 2.7 to 3.7 m and have to avoid something; the minimum clearance is 0.25 m."""
    record = rollout_teacher()
    assert record.ok.all() and not record.contact.any()
    assert record.clearance.min() > 0.1
    assert record.distances.min(axis=(1, 2)).max() < 0.7
    positions = record.position[..., :2]
    assert np.linalg.norm(np.diff(positions, axis=1), axis=-1).sum(axis=1).min() > 2.5
    assert np.linalg.norm(positions - positions[:, :1], axis=-1).max(axis=1).min() > 1.0  # no robot circles


def test_vehicle_2a_alone_collides_and_3b_alone_is_slow():
    """Sec. 4.2 calls both poor: with 2a half of the robots collide; 3b loses a third of the speed."""
    only_2a, only_3b, both = (rollout_teacher(**RULE, **gain) for gain in ({"gain_3b": 0.0}, {"gain_2a": 0.0}, {}))
    assert only_2a.contact.any(axis=1).sum() >= 4
    assert only_3b.contact.any(axis=1).sum() <= 2
    steps = [np.linalg.norm(np.diff(record.position[..., :2], axis=1), axis=-1) for record in (only_3b, both)]
    # A reset is a single step and does not change the median.
    slow, fast = (np.median(lengths, axis=1).mean() for lengths in steps)
    assert slow < 0.7 * fast


def test_rule_without_tie_break_collides():
    """From the same starts, seven of eight robots collide."""
    record = rollout_teacher(**RULE)
    assert record.ok.all()
    assert record.contact.any(axis=1).sum() >= 4
