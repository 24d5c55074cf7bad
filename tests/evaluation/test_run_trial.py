"""`lgmdjax trial` and `run_trial` with the pretrained robot, and rollouts in batches of one size."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from synthetic import walk

from lgmdjax import geometry
from lgmdjax.body import hexapod
from lgmdjax.cli import flags, main
from lgmdjax.cli import trial as cli_trial
from lgmdjax.errors import InputError
from lgmdjax.evaluation import run_trial
from lgmdjax.simulation import assembly, episodes, recording, room_batches

ROOT = Path(__file__).parents[2]
SEEDS = 2


def trial(*arguments: str) -> subprocess.CompletedProcess:
    """Run `lgmdjax trial` in its own process, in single precision."""
    words = [sys.executable, "-m", "lgmdjax", "trial", *arguments]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trials")
    done = trial("indoor", "--seeds", str(SEEDS), "--out", str(folder))
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.fixture(scope="module")
def folder(out):
    return out / "indoor-learned-0" / "trial"


@pytest.mark.slow
def test_the_learned_policy_avoids_the_box_ahead(folder):
    outcome = json.loads((folder / "outcome.json").read_text())
    assert (outcome["robots"], outcome["untouched"]) == (SEEDS, SEEDS)
    assert min(outcome["clearance"]) > 0
    for recorded in episodes.read(folder):
        turned = np.abs(np.unwrap(geometry.yaw(np.asarray(recorded.quaternion))))
        near = recorded.position[:, 0] > 0.75  # m; the face of the box is at 1.2 m
        assert not near.any() or turned[: near.argmax() + 60].max() > 0.3


def test_writes_a_plot_and_a_video(folder):
    assert (folder / "paths.png").read_bytes().startswith(b"\x89PNG")
    assert b"ftyp" in (folder / "walk.mp4").read_bytes()[:16]


def test_runs_once_and_refuses_other_settings(out):
    again = trial("indoor", "--seeds", str(SEEDS), "--out", str(out))
    assert again.returncode == 0 and "up to date" in again.stdout
    other = trial("indoor", "--seeds", "3", "--out", str(out))
    assert other.returncode == 2
    assert "seeds = 3" in other.stderr and other.stderr.count("\n") == 1


@pytest.mark.usefixtures("float32")
def test_outcomes_are_described_in_one_line_per_trial_and_policy(out):
    """Recorded walks are not simulated again."""
    (line,) = cli_trial.run_trials(flags.TrialFlags(trials=("indoor",), policy=("learned",), seeds=SEEDS, out=out))
    assert f"indoor, learned: {SEEDS} of {SEEDS} untouched" in line
    score = {"collisions": 3, "distance": 41.2, "per_100_m": {}, "progress": {"coverage": {"value": 18.2}}}
    assert cli_trial.describe(score) == "3 collisions in 41 m, 18.2 new cells a minute"


@pytest.mark.parametrize(("trial", "policy"), [("indoors", "learned"), ("indoor", "expert")])
@pytest.mark.usefixtures("unchecked")
def test_an_unknown_name_is_an_input_error(tmp_path, trial, policy):
    with pytest.raises(InputError, match="expected the name of a"):
        run_trial.run_trial(trial, policy, out=tmp_path)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("tube", "--seeds", "0"), "expected one or more --seeds, got 0"),
        (("tube", "--width", "100"), "expected a --width whose cells are whole pixels"),
        (("tube", "--run", "nowhere"), "`lgmdjax train` makes one"),
    ],
)
def test_wrong_arguments_give_an_error_of_one_line(tmp_path, capsys, arguments, line):
    assert main.main(["trial", *arguments, "--out", str(tmp_path / "out")]) == 2
    stderr = capsys.readouterr().err
    assert line in stderr and stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_any_number_of_robots_is_rolled_out_in_batches_of_one_size(monkeypatch):
    """Each robot is identified by its room's first start."""
    sizes = []

    def stand(params, model, rooms, seconds, label, *, render):
        starts = np.asarray(rooms.starts)[:, :1]
        sizes.append(len(starts))
        record = walk(len(starts), frames=3)
        yield replace(record, position=np.repeat(starts, 3, axis=1))

    monkeypatch.setattr(recording, "rollout_with_progress", stand)
    monkeypatch.setattr(recording, "BATCH_SIZES", (2, 4))
    rooms = room_batches.random_rooms(jax.random.key(0), 9)
    robot = assembly.assemble(assembly.make_policies())
    batches = list(recording.rollout_in_batches(robot, hexapod.build(), rooms, 0.1, "standing", batches=[1, 2]))
    assert sizes == [4, 4]
    assert [numbers for numbers, _ in batches] == [[4, 5, 6, 7], [8]]
    stood = np.concatenate([record.position[:, 0] for _, record in batches])
    np.testing.assert_array_equal(stood, rooms.starts[4:, 0])
