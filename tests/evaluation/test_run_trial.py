"""`lgmdjax trial`: the robot that comes with the package, in one of the paper's experiments, as a user starts it."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from synthetic import walk

from lgmdjax.body import hexapod
from lgmdjax.cli import main, study
from lgmdjax.evaluation import metrics
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, room_batches

ROOT = Path(__file__).parents[2]
SEEDS = 2


def trial(*arguments: str) -> subprocess.CompletedProcess:
    """Run `lgmdjax trial` as its own process, in single precision as users do."""
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
def test_learned_controller_avoids_the_box_ahead(folder):
    outcome = json.loads((folder / "outcome.json").read_text())
    assert (outcome["robots"], outcome["untouched"]) == (SEEDS, SEEDS)
    assert min(outcome["clearance"]) > 0
    for walked in episodes.read(folder):
        turned = np.abs(np.unwrap(metrics.yaws(walked.quaternion)))
        near = walked.position[:, 0] > 0.75  # of the box's face, at 1.2 m
        assert not near.any() or turned[: near.argmax() + 60].max() > 0.3


def test_leaves_a_picture_and_a_film(folder):
    assert (folder / "paths.png").read_bytes().startswith(b"\x89PNG")
    assert b"ftyp" in (folder / "walk.mp4").read_bytes()[:16]


def test_is_done_once_and_refuses_other_settings(out):
    again = trial("indoor", "--seeds", str(SEEDS), "--out", str(out))
    assert again.returncode == 0 and "up to date" in again.stdout
    other = trial("indoor", "--seeds", "3", "--out", str(out))
    assert other.returncode == 2
    assert "seeds = 3" in other.stderr and other.stderr.count("\n") == 1


@pytest.mark.usefixtures("float32")
def test_drivers_are_compared_in_a_line_each(out, capsys):
    """The walk that is there already is taken as it is."""
    study.walked_by(("indoor",), main.Attempts(seeds=SEEDS, out=out), ("learned",))
    assert f"indoor, learned: {SEEDS} of {SEEDS} untouched" in capsys.readouterr().out
    scored = {"collisions": 3, "distance": 41.2, "per_100_m": {}}
    assert study.told(scored) == "3 collisions in 41 m"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("tube", "--seeds", "0"), "expected one or more --seeds, got 0"),
        (("tube", "--width", "100"), "expected a --width whose cells are whole pixels"),
        (("tube", "--run", "nowhere"), "`lgmdjax train` makes one"),
    ],
)
def test_bad_arguments_end_in_a_line(tmp_path, arguments, line):
    done = trial(*arguments, "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert line in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_any_number_of_robots_walks_in_crowds_of_one_size(monkeypatch):
    """Each robot is told by where its room's first start is."""
    sizes = []

    def stand(params, model, rooms, seconds, label, *, draw):
        starts = np.asarray(rooms.starts)[:, :1]
        sizes.append(len(starts))
        record = walk(len(starts), frames=3)
        yield replace(record, position=np.repeat(starts, 3, axis=1))

    monkeypatch.setattr(recording, "walks", stand)
    monkeypatch.setattr(recording, "CROWD", 4)
    rooms = room_batches.random_rooms(jax.random.key(0), 9)
    robot = closed_loop.assemble(assembly.everyone())
    crowds = list(recording.crowds(robot, hexapod.build(), rooms, 0.1, "standing", done=1))
    assert sizes == [4, 4]
    assert [numbers for numbers, _ in crowds] == [[4, 5, 6, 7], [8]]
    stood = np.concatenate([record.position[:, 0] for _, record in crowds])
    np.testing.assert_array_equal(stood, rooms.starts[4:, 0])
