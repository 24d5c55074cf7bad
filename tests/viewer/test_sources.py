"""Recorded walks of a path, and the simulator's process."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic

from lgmdjax.errors import InputError
from lgmdjax.evaluation import trials
from lgmdjax.reporting.room_shape import centres_during, centres_of
from lgmdjax.simulation import episodes
from lgmdjax.viewer import sources, walk_paths
from lgmdjax.viewer.messages import Open, Status

SEED = 3


@pytest.fixture(scope="module")
def trial(tmp_path_factory) -> Path:
    """The folder of a trial of two walks, the second with a contact."""
    folder = tmp_path_factory.mktemp("trials") / "dynamic-learned-3" / "trial"
    contact = np.zeros((2, 600), bool)
    contact[1, 50] = True
    parameters = {"trial": "dynamic", "driver": "learned", "seeds": 2, "seconds": 20.0, "robot": "-"}
    writer = episodes.Writer(folder, parameters)
    writer.write(synthetic.walk(2, 600, contact=contact), episode=0, rooms=[0, 1], seed=SEED)
    return folder


def test_a_trial_its_folder_and_its_file_are_the_same_walks(trial):
    expected = trial, None
    assert walk_paths.find_walks(trial) == walk_paths.find_walks(trial.parent) == expected
    assert walk_paths.find_walks(trial / "chunk-00000.parquet") == (trial, {0})


def test_what_holds_no_walks_is_one_line(trial, tmp_path):
    (tmp_path / "nonsense.parquet").write_text("nonsense")
    (tmp_path / "chunk-00000.parquet").write_text("nonsense")
    (tmp_path / "film.mp4").write_text("nonsense")
    (tmp_path / "empty").mkdir()
    for name in ("nonsense.parquet", "film.mp4", "empty", "missing"):
        with pytest.raises(InputError, match=r"^[^\n]*expected [^\n]*; [^\n]*$"):
            walk_paths.find_walks(tmp_path / name)
    with pytest.raises(InputError, match="expected a whole Parquet file"):
        sources.WalkSource(Open(tmp_path / "chunk-00000.parquet"), lambda report: None)


def test_the_room_of_a_walk_is_that_of_its_trial(trial):
    walks, parameters = episodes.read(trial), episodes.read_parameters(trial)
    room, centres = sources.room_of(parameters, walks[1], 2, trial)
    expected = trials.sample_rooms("dynamic", 2, SEED).arena
    np.testing.assert_array_equal(room.boxes.texture, expected.boxes.texture[1])
    assert len(centres) == 600  # its boxes move
    np.testing.assert_allclose(centres[0], centres_of(room), atol=1e-6)
    box = centres[:, 0]  # departs at 10 s and arrives at 12 s
    np.testing.assert_allclose(box[:300], np.tile(box[0], (300, 1)), atol=1e-5)
    np.testing.assert_allclose(box[330], (box[0] + box[-1]) / 2, atol=1e-5)
    np.testing.assert_allclose(box[360:], np.asarray(room.boxes.goal[0])[None].repeat(240, 0), atol=1e-5)


def test_rooms_in_which_nothing_moves_have_one_row():
    assert centres_during(synthetic.room(), np.arange(5.0)).shape[0] == 1


def test_walks_of_unknown_rooms_are_one_line(trial):
    walk = episodes.read(trial)[0]
    for parameters in ({"mine": 1}, {"trial": "dynamic"}, {"trial": "nowhere", "seeds": 2}, {"live": {"arena": []}}):
        with pytest.raises(InputError, match=r"expected (walks of|a walk that|an object with trial|one of testing)"):
            sources.room_of(parameters, walk, 2, trial)


def test_the_simulator_reports_a_mistake_and_ends_with_its_input(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "lgmdjax.viewer.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdin is not None and process.stdout is not None
    pickle.dump(Open(tmp_path / "missing"), process.stdin)
    process.stdin.flush()
    reports = [pickle.load(process.stdout) for _ in range(2)]
    assert reports[0] == Status(f"reading {tmp_path / 'missing'}")
    assert reports[1].failed and "found no" in reports[1].text
    process.stdin.close()
    assert process.wait(30) == 0
