"""The loop that saves progress and resumes: which steps it saves and yields."""

from contextlib import closing

import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.errors import InputError
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


FIT = {"weights": jnp.arange(50, dtype=jnp.float32), "curve": jnp.full(3, jnp.nan)}


def saved_fit(folder):
    with closing(Checkpoints(folder, {"fit": 1})) as saved:
        saved.save(1, FIT)
    return folder


def restored(folder, initial=FIT):
    with closing(Checkpoints(folder, {"fit": 1})) as saved:
        return saved.restore_latest(initial)[1]


def test_a_checkpoint_with_other_weights_is_refused(tmp_path, monkeypatch):
    """It is whole for orbax, which does not check what it reads."""
    with monkeypatch.context() as changed:
        changed.setattr("lgmdjax.learning.checkpoints._digest", lambda progress: "0" * 64)
        saved_fit(tmp_path)
    with pytest.raises(InputError, match="another checksum than the saved one; remove it to start again"):
        restored(tmp_path)


def test_a_checkpoint_without_a_checksum_is_older_and_read_if_it_is_finite(tmp_path, monkeypatch):
    monkeypatch.setattr("lgmdjax.learning.checkpoints._digest", lambda progress: None)
    np.testing.assert_array_equal(restored(saved_fit(tmp_path / "sound"))["weights"], FIT["weights"])
    with closing(Checkpoints(tmp_path / "nan", {"fit": 1})) as saved:
        saved.save(1, FIT | {"weights": FIT["weights"].at[3].set(jnp.nan)})
    with pytest.raises(InputError, match="numbers that are not finite"):
        restored(tmp_path / "nan")


@pytest.mark.parametrize("error", [ValueError("No space left on device"), OSError(28, "No space left on device")])
def test_a_full_disk_is_one_line(tmp_path, monkeypatch, error):
    def fail(*_, **__):
        raise error

    with closing(Checkpoints(tmp_path, {"fit": 1})) as saved:
        monkeypatch.setattr(saved.manager, "save", fail)
        with pytest.raises(InputError, match="No space left on device; free some disk") as caught:
            saved.save(1, FIT)
    assert "\n" not in str(caught.value)
