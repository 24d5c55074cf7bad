"""The teacher in its body: what it teaches is a walk that touches nothing, where eq. 22 by itself does."""

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
RULE = {"full_turn": 0.0, "symmetry": 0.0}  # eq. 22 within the gait's range


@cache  # two tests look at the walks of the same rule
def walked(**changes: float) -> closed_loop.Record:
    """Put eight robots into the middle of the paper's training room, each turned its own way, for a minute."""
    teacher = replace(TEACHER, **changes)
    params = closed_loop.assemble(teacher, teacher=teacher, eyes=camera.Params(width=16, height=12))
    rooms = room_batches.copies(jax.random.key(0), scenes.training_room(), 8)
    chunks = rollout.chunks(params, hexapod.build(), rooms, policies.TEACHER, 60.0, draw=False)
    return rollout.together(list(chunks))


@pytest.mark.slow
def test_teacher_walks_the_training_room_and_touches_nothing():
    """It goes 2.7 to 3.7 m, all robots meet something to turn from, and no leg comes nearer to it than 0.25 m."""
    record = walked()
    assert record.ok.all() and not record.contact.any()
    assert record.clearance.min() > 0.1
    assert record.distances.min(axis=(1, 2)).max() < 0.7
    places = record.position[..., :2]
    assert np.linalg.norm(np.diff(places, axis=1), axis=-1).sum(axis=1).min() > 2.5
    assert np.linalg.norm(places - places[:, :1], axis=-1).max(axis=1).min() > 1.0  # nor does it circle


def test_vehicle_2a_alone_runs_into_things_and_3b_alone_hardly_gets_on():
    """Sec. 4.2 calls both poor: half of the robots touch something by the one; the other loses a third of the pace."""
    alone_2a, alone_3b, both = (walked(**RULE, **gain) for gain in ({"gain_3b": 0.0}, {"gain_2a": 0.0}, {}))
    assert alone_2a.contact.any(axis=1).sum() >= 4
    assert alone_3b.contact.any(axis=1).sum() <= 2
    ways = [np.linalg.norm(np.diff(record.position[..., :2], axis=1), axis=-1) for record in (alone_3b, both)]
    slow, quick = (np.median(way, axis=1).mean() for way in ways)  # a setback is a single step
    assert slow < 0.7 * quick


def test_rule_without_the_tie_break_does_touch_what_is_in_it():
    """From the same starts: seven of eight do."""
    record = walked(**RULE)
    assert record.ok.all()
    assert record.contact.any(axis=1).sum() >= 4
