"""A frame that is not finite in every field is not ok, and no metric is computed from one that says it is."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, trials
from lgmdjax.simulation import finite, rollout
from lgmdjax.simulation.closed_loop import Record


def damaged(name: str, value: float) -> Record:
    """A record of two robots; the second has another number in its frame 3."""
    record = synthetic.walk(robots=2, frames=60)
    values = np.array(getattr(record, name), dtype=float)
    values[1, 3, ...] = value
    return replace(record, **{name: values})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", finite.FLOATS)
def test_every_field_is_looked_at(name: str, value: float) -> None:
    record = damaged(name, value)
    flagged = finite.flag_nonfinite(record)
    expected = np.ones((2, 60), bool)
    expected[1, 3] = False
    np.testing.assert_array_equal(flagged.ok, expected)
    assert all(np.isfinite(getattr(flagged, field)).all() for field in finite.FLOATS)
    np.testing.assert_array_equal(getattr(flagged, name)[0], getattr(record, name)[0])
    with pytest.raises(InputError, match=f"got {name} .* of robot 1, frame 3; flag the frame"):
        finite.require_finite(record, "here")
    assert finite.require_finite(flagged, "here") is flagged


def test_a_finite_record_is_unchanged() -> None:
    record = synthetic.walk()
    assert finite.flag_nonfinite(record) is record


@pytest.mark.parametrize("name", ["clearance", "position", "quaternion"])
def test_scores_refuse_what_is_not_finite_in_a_frame_that_counts(name: str) -> None:
    record = damaged(name, np.nan)
    for compute in (metrics.score, metrics.progress, lambda record: trials.find_outcome(trials.TRIALS["tube"], record)):
        with pytest.raises(InputError, match="robot 1, frame 3"):
            compute(record)


def test_a_lost_robot_does_not_make_scores_nan() -> None:
    record = damaged("clearance", np.nan)
    ok = np.ones((2, 60), bool)
    ok[1, 3:] = False
    score = metrics.score(replace(record, ok=ok))
    assert score.lost == 1 and np.isfinite([score.clearance.value, score.distance, score.turning]).all()


@pytest.mark.usefixtures("unchecked")
def test_a_rollout_flags_what_is_not_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "reset_batch", lambda *_, **__: None)
    monkeypatch.setattr(rollout, "rollout_batch", lambda *_, **__: (None, damaged("u", np.nan)))
    chunks = list(rollout.rollout_chunks(None, None, None, None, 3.0, chunk_seconds=2.0))  # pyright: ignore
    assert [chunk.ok[1, 3] for chunk in chunks] == [False, False]
    assert all(np.isfinite(chunk.u).all() and chunk.ok[0].all() for chunk in chunks)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_detector_does_not_hide_a_pixel_that_is_not_finite(value: float) -> None:
    """In the frame with the pixel all outputs but FF, which is a frame late, are nan; a frame later FF too."""
    params = lgmd.Params(threshold=2.0)
    image = jnp.full((8, 8), 100.0)
    state = lgmd.init(params, image)
    state, response = lgmd.step(params, state, image.at[3, 3].set(value))
    assert not np.isfinite(response.excitation) and (np.isnan(response.u) or np.isinf(value))
    _, response = lgmd.step(params, state, image)
    assert np.isnan(response.u) and not np.isfinite(response.feed_forward)
