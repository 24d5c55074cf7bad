"""The whole pipeline at smoke scale, as a user starts it, and what the stages leave for each other."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from lgmdjax.control import navigator
from lgmdjax.control.policies import ALL
from lgmdjax.locomotion import shaping
from lgmdjax.simulation import episodes

ROOT = Path(__file__).parents[2]


def command(*arguments: str) -> subprocess.CompletedProcess:
    """Run lgmdjax as its own process, in single precision as users do."""
    words = [sys.executable, "-m", "lgmdjax", *arguments]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    done = command("reproduce", "--scale", "smoke", "--out", str(folder), "--seed", "3", "--name", "smoke")
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.fixture(scope="module")
def run(out):
    return out / "smoke"


@pytest.mark.slow
def test_every_stage_left_its_files(run):
    for stage, names in {
        "fit-gait": ("shaping.safetensors", "gait.json", "cpg.npz", "foot.npz"),
        "collect": ("calibration.json", "episodes/chunk-00000.parquet", "episodes/chunk-00001.parquet"),
        "train": ("controller.safetensors", "training.json", "prediction.npz", "baselines.npz"),
        "evaluate": ("evaluation.json", "trajectories.npz", "walk.npz", "layers.npz"),
        "report": ("index.html",),
    }.items():
        for name in names:
            assert (run / stage / name).stat().st_size > 0, f"{stage}/{name}"


def test_robot_of_the_run_walks_and_the_literal_input_hardly_does(run):
    gait = json.loads((run / "fit-gait" / "gait.json").read_text())
    forward = next(row for row in gait["sweep"] if row["velocity"] == [1.0, 1.0])
    assert 0.03 < forward["mjx"] < 0.06
    assert abs(forward["mjx"] - forward["c"]) < 0.003
    assert abs(gait["literal"]["mjx"]) < 0.02
    left = next(row for row in gait["sweep"] if row["velocity"] == [-1.0, 1.0])
    assert left["yaw_rate_mjx"] > 0.06


def test_recorded_walks_are_whole_and_in_rooms_of_their_own(run):
    walks = episodes.read(run / "collect" / "episodes")
    assert len(walks) == 8
    assert len({walk.room for walk in walks}) == 8
    for walk in walks:
        assert len(walk) == 300
        np.testing.assert_allclose(np.diff(walk.time), 1 / 30, atol=1e-4)
        np.testing.assert_array_equal(walk.label, walk.velocity)
        assert np.all((walk.u >= 0.5) & (walk.u <= 1))
    # All but some saw something move: of what 20 s of walking choose, thresholds may be too high for the dimmest room.
    assert sum(walk.u[5:].max() > 0.5 for walk in walks) >= 6


def test_controller_says_what_eyes_it_needs(run):
    params, header = navigator.load(run / "train" / "controller.safetensors")
    calibration = json.loads((run / "collect" / "calibration.json").read_text())
    assert params.variant == "lstm"
    assert header["lgmd"]["threshold"] == calibration["threshold"]
    assert header["eyes"]["width"] == 64
    assert not shaping.load(run / "fit-gait" / "shaping.safetensors").literal


def test_every_driver_is_scored_on_the_same_seeds_in_both_places(run):
    scores = json.loads((run / "evaluate" / "evaluation.json").read_text())
    assert set(scores) == {"testing", "unseen"}
    for place in scores.values():
        assert set(place) == {driver.name for driver in ALL}
        for score in place.values():
            assert score["distance"] > 0.5
            assert score["per_100_m"]["low"] <= score["per_100_m"]["value"] <= score["per_100_m"]["high"]
    walks = np.load(run / "evaluate" / "trajectories.npz")
    starts = [walks[f"unseen_{driver.name}"][:, 0] for driver in ALL]
    for start in starts[1:]:
        np.testing.assert_allclose(start, starts[0], atol=1e-6)


def test_run_again_does_nothing_again(out, run):
    files = [path for path in run.rglob("*") if path.is_file() and path.name != ".lock"]
    before = {path: path.stat().st_mtime_ns for path in files}
    again = command("reproduce", "--scale", "smoke", "--out", str(out), "--seed", "3", "--name", "smoke")
    assert again.returncode == 0
    assert again.stdout.count("up to date") == 5
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_training_interrupted_before_its_own_walk_ends_the_same(run, tmp_path):
    """The fit of the round is read back, the walk that it was to drive is walked, and all else fitted again."""
    copy = tmp_path / "smoke"
    shutil.copytree(run, copy)
    fingerprint = json.loads((copy / "train" / "done.json").read_text())["fingerprint"]
    partial = (copy / "train").rename(copy / f"train.partial-{fingerprint}")
    for left in set(partial.iterdir()) - {partial / "checkpoints"}:
        shutil.rmtree(left) if left.is_dir() else left.unlink()
    done = command("train", "--scale", "smoke", "--out", str(tmp_path), "--seed", "3", "--name", "smoke")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "train: carries on" in done.stdout
    before, after = (navigator.load(folder / "train" / "controller.safetensors")[0] for folder in (run, copy))
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_other_seed_in_the_same_folder_is_refused_in_one_line(out):
    refused = command("reproduce", "--scale", "smoke", "--out", str(out), "--seed", "4", "--name", "smoke")
    assert refused.returncode == 2
    assert "seed" in refused.stderr
    assert "Traceback" not in refused.stderr


def test_broken_episode_is_named_and_nothing_is_half_written(out, run, tmp_path):
    """A run whose recorded walks were damaged trains nothing."""
    copy = tmp_path / "smoke"
    shutil.copytree(run, copy)
    for stage in ("train", "evaluate", "report"):
        shutil.rmtree(copy / stage)
    chunk = copy / "collect" / "episodes" / "chunk-00001.parquet"
    size = chunk.stat().st_size
    chunk.write_bytes(os.urandom(size))  # as long as before, so that only reading it can tell
    failed = command("train", "--scale", "smoke", "--out", str(tmp_path), "--seed", "3", "--name", "smoke")
    assert failed.returncode == 2
    assert "chunk-00001.parquet" in failed.stderr
    assert "Traceback" not in failed.stderr
    assert not (copy / "train").exists()
