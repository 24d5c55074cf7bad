"""The teacher in closed loop with the body: it avoids obstacles and goes on; eq. 22 alone does not."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, policies
from lgmdjax.evaluation import metrics, trials
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches
from lgmdjax.world import scenes

pytestmark = [pytest.mark.optimised, pytest.mark.usefixtures("float32")]
TEACHER = braitenberg.Params()
RULE = {"base": 1.2, "full_turn": 0.0, "tie_tolerance": 0.0, "corridor": 0.0}  # eq. 22, limited to the gait's range


def roll_out(rooms: closed_loop.Room, seconds: float, teacher: braitenberg.Params = TEACHER) -> closed_loop.Record:
    """Roll out eight robots with a teacher; one compiled program serves all tests."""
    params = assembly.assemble(teacher, teacher_params=teacher, camera_params=camera.Params(width=16, height=12))
    chunks = rollout.rollout_chunks(params, hexapod.build(), rooms, policies.TEACHER, seconds, render=False)
    return rollout.concatenate_time(list(chunks))


@cache  # two tests use the record of the same rule
def rollout_teacher(**changes: float) -> closed_loop.Record:
    """Roll out eight robots for a minute from the centre of the training room, each with another heading."""
    rooms = room_batches.replicate_room(jax.random.key(0), scenes.training_room(), 8)
    return roll_out(rooms, 60.0, replace(TEACHER, **changes))


@pytest.mark.slow
def test_teacher_explores_the_training_room_without_contact():
    record = rollout_teacher()
    assert record.ok.all() and not record.contact.any()
    assert record.clearance.min() > 0.05
    assert record.corridor.min(axis=(1, 2)).max() < TEACHER.turn_distance  # all robots had to avoid something
    found = metrics.progress(record)
    assert found.coverage.value > 18 and found.hard_turning.value < 0.15 and found.longest_rotation < 1.5


def test_teacher_passes_what_stands_in_its_way():
    """Two robots in each of the paper's scenes, one of them in its mirror image, and two before a gap of 0.8 m."""
    names = ("indoor", "outdoor", "dynamic", "gap")
    batches = [trials.sample_rooms(name, 2, seed=31) for name in names]
    record = roll_out(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches), 90.0)
    passed = {
        name: trials.find_outcome(trials.TRIALS[name], jax.tree.map(lambda x, k=k: x[2 * k : 2 * k + 2], record)).passed
        for k, name in enumerate(names)
    }
    assert sum(map(sum, passed.values())) >= 7, passed


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
