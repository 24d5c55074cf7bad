"""The loop that saves progress and resumes: which steps it saves and yields."""

from contextlib import closing

import jax.numpy as jnp
import pytest

from lgmdjax.learning.checkpoints import Checkpoints, resumable


def advance(progress, step, end):
    """Count the calls and the steps."""
    return {"calls": progress["calls"] + 1, "steps": progress["steps"] + end - step}


INITIAL = {"calls": jnp.asarray(0), "steps": jnp.asarray(0)}


def test_steps_are_taken_in_chunks_and_the_last_one_is_shorter():
    steps = [(step, int(progress["steps"])) for step, progress in resumable(advance, INITIAL, None, total=5, chunk=2)]
    assert steps == [(0, 0), (2, 2), (4, 4), (5, 5)]


def test_an_interrupted_loop_resumes_from_its_newest_checkpoint(tmp_path):
    with closing(Checkpoints(tmp_path, {"fit": 1})) as saved:
        loop = resumable(advance, INITIAL, saved, total=4)
        assert [step for step, _ in (next(loop), next(loop), next(loop))] == [0, 1, 2]
    with closing(Checkpoints(tmp_path, {"fit": 1})) as saved:
        steps = [(step, int(progress["calls"])) for step, progress in resumable(advance, INITIAL, saved, total=4)]
    assert steps == [(2, 2), (3, 3), (4, 4)]


@pytest.mark.parametrize(("interval", "expected"), [(0.0, [1, 2, 3]), (1e9, [3])])
def test_the_last_step_is_always_saved(interval, expected, tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(Checkpoints, "save", lambda self, step, progress: saved.append(step))
    with closing(Checkpoints(tmp_path, {})) as checkpoints:
        list(resumable(advance, INITIAL, checkpoints, total=3, interval=interval))
    assert saved == expected
