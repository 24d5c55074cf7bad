"""The benchmark on laboratory stimuli: clips and their geometry, scores of detectors whose answer is known."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.cli import main
from lgmdjax.errors import InputError
from lgmdjax.evaluation import stimulus_scores
from lgmdjax.evaluation.settings import STIMULUS_SCALES

SMOKE = STIMULUS_SCALES["smoke"]


def _step(params, state, frame):
    """Answer to the part of the image that is dark."""
    dark = jnp.mean(frame < 100.0)
    return state, SimpleNamespace(u=0.5 + 0.5 * dark, excitation=dark)


darkness = SimpleNamespace(Params=lambda: (), init=lambda params, frame: (), step=_step)
"""A detector with a known answer, found by `test_stimulus_scores:darkness`."""


@pytest.fixture(scope="module")
def bench():
    return stimulus_scores.render_clips(SMOKE, 0)


def test_clips_have_the_geometry_that_they_show(bench):
    """The square's darkness in the middle row, against the angle that an ideal observer is told."""
    clips = bench.selection
    k = clips.names.index("approach dark 0.1 s")
    pitch = np.radians(170) / SMOKE.width
    seen = (160 - clips.frames[k][:, SMOKE.height // 2]).sum(axis=1) / 120 * pitch
    small = np.asarray(clips.geometry.size[k]) < 2.0
    np.testing.assert_allclose(seen[small], np.asarray(clips.geometry.size[k])[small], atol=0.5 * pitch)
    grown = np.gradient(np.asarray(clips.geometry.size[k]), clips.time)
    np.testing.assert_allclose(clips.geometry.rate[k][5:45], grown[5:45], rtol=0.05)
    flash = clips.frames[clips.names.index("flash")]
    assert flash[0].max() < flash[-1].min()


def test_a_detector_of_darkness_is_scored_as_it_must_be(bench):
    scores = stimulus_scores.score("test_stimulus_scores:darkness", bench)
    assert scores["selectivity"]["approach dark 0.1 s"] == pytest.approx(1.0, abs=0.01)
    assert scores["peaks"]["translate 1 rad/s"] < 0.1
    before = scores["timing"]["before_contact"]
    assert all(abs(time) <= 0.05 for time in before)  # all is dark at contact
    assert scores["contrast"]["peaks"][-1] == 0  # nothing is darker than 100
    assert scores["auc_dark"] < 1  # recession begins as dark


def test_the_line_of_peaks_is_that_of_eta(bench):
    timing = stimulus_scores.score("eta", bench)["timing"]
    assert timing["slope"] == pytest.approx(4.7, abs=0.5) and timing["r"] > 0.99
    assert timing["intercept"] == pytest.approx(-0.027, abs=1 / 30)


def test_area_under_roc_counts_ties_half():
    peaks = {"approach dark 1 s": 0.3, "approach bright 1 s": 0.2, "recede dark 1 s": 0.2, "flash": 0.1, "yaw": 0.0}
    scores = stimulus_scores.compare(peaks)
    assert (scores["auc_dark"], scores["auc_bright"]) == (1.0, pytest.approx(2.5 / 3))


@pytest.mark.parametrize(
    ("name", "message"),
    [("lgmd3", "a detector among lgmd, "), ("no.such:thing", "PYTHONPATH"), ("json:dumps", "without Params, init")],
)
def test_unknown_detectors_are_refused(name, message):
    with pytest.raises(InputError, match=message):
        stimulus_scores.get_detector(name)


def test_the_command_writes_table_json_and_figure(tmp_path, capsys):
    out = ["--out", str(tmp_path), "--scale", "smoke"]
    assert main.main(["bench", "stimuli", "--detector", "tau", "test_stimulus_scores:darkness", *out]) == 0
    folder = tmp_path / "stimuli-smoke"
    rows = json.loads((folder / "scores.json").read_text())["rows"]
    assert [row["detector"] for row in rows] == ["tau", "test_stimulus_scores:darkness"]
    assert (folder / "scores.md").read_text().count("\n") == 4
    assert (folder / "scores.png").read_bytes().startswith(b"\x89PNG")
    assert "area under ROC" in capsys.readouterr().out
    assert main.main(["bench", "stimuli", "--detector", "none", *out]) == 2
