"""The whole pipeline at smoke scale, started like a user does, and the files of its stages."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from lgmdjax.cli import main
from lgmdjax.control import navigator
from lgmdjax.control.policies import POLICIES
from lgmdjax.locomotion import shaping
from lgmdjax.simulation import episodes

ROOT = Path(__file__).parents[2]


def command(*arguments: str) -> subprocess.CompletedProcess:
    """Run lgmdjax in its own process, in single precision like a user."""
    call = [sys.executable, "-m", "lgmdjax", *arguments]
    return subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)


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
def test_every_stage_writes_its_files(run):
    for stage, names in {
        "fit-gait": ("shaping.safetensors", "gait.json", "cpg.npz", "foot.npz"),
        "collect": ("calibration.json", "episodes/chunk-00000.parquet", "episodes/chunk-00001.parquet"),
        "train": ("controller.safetensors", "training.json", "prediction.npz", "baselines.npz"),
        "evaluate": ("evaluation.json", "trajectories.npz", "walk.npz", "layers.npz"),
        "report": ("index.html",),
    }.items():
        for name in names:
            assert (run / stage / name).stat().st_size > 0, f"{stage}/{name}"


def test_the_fitted_gait_walks_and_the_printed_input_hardly_does(run):
    gait = json.loads((run / "fit-gait" / "gait.json").read_text())
    forward = next(row for row in gait["sweep"] if row["velocity"] == [1.0, 1.0])
    assert 0.03 < forward["mjx"] < 0.06
    assert abs(forward["mjx"] - forward["c"]) < 0.003
    assert abs(gait["literal"]["mjx"]) < 0.02
    left = next(row for row in gait["sweep"] if row["velocity"] == [-1.0, 1.0])
    assert left["yaw_rate_mjx"] > 0.06


def test_recorded_walks_are_complete_and_in_different_rooms(run):
    walks = episodes.read(run / "collect" / "episodes")
    assert len(walks) == 8
    assert len({walk.room for walk in walks}) == 8
    for walk in walks:
        assert len(walk) == 300
        np.testing.assert_allclose(np.diff(walk.time), 1 / 30, atol=1e-4)
        np.testing.assert_array_equal(walk.label, walk.velocity)
        assert np.all((walk.u >= 0.5) & (walk.u <= 1))
    # Not all: thresholds calibrated on 20 s of walking may be too high for the room with the least contrast.
    assert sum(walk.u[5:].max() > 0.5 for walk in walks) >= 6


def test_the_controllers_header_has_its_detector_and_camera(run):
    params, header = navigator.load(run / "train" / "controller.safetensors")
    calibration = json.loads((run / "collect" / "calibration.json").read_text())
    assert params.variant == "lstm"
    assert header["lgmd"]["threshold"] == calibration["threshold"]
    assert header["eyes"]["width"] == 80
    assert not shaping.load(run / "fit-gait" / "shaping.safetensors").printed_input


def test_every_policy_is_scored_from_the_same_starts_in_both_trials(run):
    scores = json.loads((run / "evaluate" / "evaluation.json").read_text())
    assert set(scores) == {"testing", "unseen"}
    for table in scores.values():
        assert set(table) == {policy.name for policy in POLICIES}
        for score in table.values():
            assert score["distance"] > 0.5
            assert score["per_100_m"]["low"] <= score["per_100_m"]["value"] <= score["per_100_m"]["high"]
    walks = np.load(run / "evaluate" / "trajectories.npz")
    starts = [walks[f"unseen_{policy.name}"][:, 0] for policy in POLICIES]
    for start in starts[1:]:
        np.testing.assert_allclose(start, starts[0], atol=1e-6)


def test_a_finished_run_is_not_repeated(out, run):
    files = [path for path in run.rglob("*") if path.is_file() and path.name != ".lock"]
    before = {path: path.stat().st_mtime_ns for path in files}
    again = command("reproduce", "--scale", "smoke", "--out", str(out), "--seed", "3", "--name", "smoke")
    assert again.returncode == 0
    assert again.stdout.count("up to date") == 5
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_training_that_is_interrupted_before_the_rollout_gives_the_same_result(run, tmp_path):
    """The fit of the DAgger round is restored; its rollout and the later fits are repeated."""
    copy = tmp_path / "smoke"
    shutil.copytree(run, copy)
    fingerprint = json.loads((copy / "train" / "done.json").read_text())["fingerprint"]
    partial = (copy / "train").rename(copy / f"train.partial-{fingerprint}")
    for left in set(partial.iterdir()) - {partial / "checkpoints"}:
        shutil.rmtree(left) if left.is_dir() else left.unlink()
    done = command("train", "--scale", "smoke", "--out", str(tmp_path), "--seed", "3", "--name", "smoke")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "train: resumes" in done.stdout
    before, after = (navigator.load(folder / "train" / "controller.safetensors")[0] for folder in (run, copy))
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_another_seed_in_the_same_folder_is_refused_in_one_line(out, capsys):
    assert main.main(["reproduce", "--scale", "smoke", "--out", str(out), "--seed", "4", "--name", "smoke"]) == 2
    stderr = capsys.readouterr().err
    assert "seed" in stderr and stderr.count("\n") == 1


@pytest.mark.extended
def test_a_stage_with_a_damaged_episode_is_done_again(run, tmp_path):
    copy = tmp_path / "smoke"
    shutil.copytree(run, copy)
    for stage in ("train", "evaluate", "report"):
        shutil.rmtree(copy / stage)
    chunk = copy / "collect" / "episodes" / "chunk-00001.parquet"
    size = chunk.stat().st_size
    chunk.write_bytes(os.urandom(size))  # same size, so that only its checksum shows the damage
    again = command("collect", "--scale", "smoke", "--out", str(tmp_path), "--seed", "3", "--name", "smoke")
    assert again.returncode == 0, again.stderr[-3000:]
    assert "fit-gait: up to date" in again.stdout and "collect: done again, because" in again.stdout
    before, after = (episodes.read(folder / "collect" / "episodes") for folder in (run, copy))
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one.u, other.u)
