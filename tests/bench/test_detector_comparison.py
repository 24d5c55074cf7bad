"""The comparison in the closed loop: what is planned, refused, recorded, scored and written, on synthetic walks."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
import synthetic

from lgmdjax.bench import closed_loop, cost, tables, worlds
from lgmdjax.bench.settings import CAMERA_FAULTS, CLOSED_LOOP_SCALES
from lgmdjax.cli import bench_closed_loop, main
from lgmdjax.detectors import dsn
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.learning import detector_calibration
from lgmdjax.runtime import storage
from lgmdjax.sensors import camera_faults
from lgmdjax.simulation import assembly, episodes, recording, rerender

SMOKE = CLOSED_LOOP_SCALES["smoke"]


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


def test_all_detectors_that_see_steer_and_the_robots_own_comes_first():
    names = closed_loop.choose(["all"])
    assert names[0] == closed_loop.OWN and "lgmd2" in names and not {"eta", "tau"} & set(names)
    assert closed_loop.choose(["emd", "all"])[:2] == ["emd", closed_loop.OWN]
    assert len(closed_loop.choose(["emd", "emd"])) == 1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["eta"], "expected a detector that sees, got eta, which is given the geometry"),
        (["lgmd", "nothing"], "expected a detector among lgmd, .*, got nothing"),
        (["lgmdjax.detectors:missing"], r"got lgmdjax\.detectors:missing"),
    ],
)
def test_a_wrong_detector_is_refused_before_any_work(given, words):
    with pytest.raises(InputError, match=words):
        closed_loop.choose(given)


def test_a_plan_has_a_stage_for_each_detector(robot):
    names = ["robot", "emd", "lgmdjax.detectors:dsn"]
    stages, settings = closed_loop.plan(robot, names, SMOKE)
    assert [stage.name for stage in stages] == [
        "walks", "detector-robot", "detector-emd", "detector-lgmdjax.detectors-dsn", "references", "scores",
    ]  # fmt: skip
    assert {stage.name for stage in stages} == set(settings)
    assert settings["detector-lgmdjax.detectors-dsn"].source == "dsn"
    assert stages[-1].inputs == tuple(stage.name for stage in stages[1:-1])


def test_the_worlds_have_the_rooms_that_they_should_have():
    rooms, seconds = worlds.sample(worlds.ROOMS, SMOKE, 0)
    assert rooms.faults is None and (len(rooms.starts), seconds) == (4, 5)
    for world in CAMERA_FAULTS:
        faulty, _ = worlds.sample(world, SMOKE, 0)
        jax.tree.map(np.testing.assert_array_equal, faulty.arena, rooms.arena)
        assert isinstance(faulty.faults, camera_faults.Params) and np.all(np.asarray(faulty.faults.noise) == 1)
        assert np.all(np.asarray(faulty.faults.vignetting) == 0)
        assert np.ptp(np.asarray(faulty.faults.gamma)) > 0.05 or world == "noise"  # each robot has its own
    scenes, _ = worlds.sample(worlds.SCENES, SMOKE, 0)
    assert len(scenes.starts) == 4


def test_scenes_are_told_apart_and_end_with_their_trial():
    record = synthetic.walk(4, 100 * 30)
    parts = worlds.split_scenes(record, SMOKE.scenes)
    assert list(parts) == ["indoor", "white"]
    assert parts["indoor"].time.shape == (2, 90 * 30) and parts["white"].time.shape == (2, 60 * 30)
    contact = np.zeros((4, 3000), bool)
    contact[2, 500] = contact[3, 1900] = True  # at a white wall, the second after the end
    found = worlds.summarise_scenes([replace(record, contact=contact)] * 2, SMOKE.scenes)
    assert (found["white"]["untouched"], found["white"]["robots"]) == (2, 4)
    assert found["indoor"]["untouched"] == 4 and found["indoor"]["passed"] == 4  # 4.5 m straight ahead


def fake_walks(folder, params, rooms, seconds, policy, *, seed, parameters, label, render=None):
    """Write walks in which the robots see something, in place of simulating them."""
    robots, frames = len(rooms.starts), round(30 * seconds)
    rng = np.random.default_rng(len(label))
    record = synthetic.walk(
        robots,
        frames,
        u=rng.uniform(0.5, 1, (robots, frames, 2)),
        label=rng.uniform(0.5, 1.5, (robots, frames, 2)),
        distances=rng.uniform(0.3, 3, (robots, frames, 2)),
    )
    writer = episodes.Writer(folder, parameters)
    if not writer.chunks:
        writer.write(record, episode=0, rooms=list(range(robots)), seed=seed)
    return episodes.stack_walks(episodes.read(folder))


def fake_pictures(camera_params, rooms, record):
    robots, frames = np.shape(record.time)
    return np.random.default_rng(0).uniform(90, 130, (robots, frames, 2, 30, 40)).astype(np.float32)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A run of the command with all walks and pictures replaced; training and calibration are real, and small."""
    out = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(False):
        patch.setattr(recording, "record_rollouts", fake_walks)
        patch.setattr(rerender, "render_walks", fake_pictures)
        patch.setattr(detector_calibration, "POOLINGS", (3,))
        patch.setattr(detector_calibration, "CONTRASTS", (4.0, 8.0))
        patch.setattr(detector_calibration, "MIN_SECONDS", 1.0)
        patch.setattr(detector_calibration.lgmd_grid_search, "correlations", lambda u, nearness: {"score": 0.5})
        arguments = ["bench", "closed-loop", "--scale", "smoke", "--detector", "dsn", "--out", str(out)]
        assert main.main(arguments) == 0
        yield out / "closed-loop-smoke", arguments


def test_every_row_has_all_scores(results):
    facts = storage.read_json(results[0] / "scores.json")
    assert [row["detector"] for row in facts["rows"]] == ["dsn", "teacher", "blind"]
    assert facts["seed"] == 0 and facts["versions"]["jax"] == jax.__version__
    row, teacher, _ = facts["rows"]
    assert set(row) >= {*worlds.WORLDS, "fits", "microseconds"} and row["microseconds"] > 0
    assert row["rooms"]["collisions"] == 0 and row["rooms"]["per_100_m"]["low"] == 0
    assert row["scenes"]["white"]["robots"] == 2 and row["calibration"]["contrast"] in (4.0, 8.0)
    assert "noise" not in teacher
    assert {path.name for path in results[0].glob("scores.*")} == {
        f"scores.{kind}" for kind in ("json", "md", "csv", "tex", "png")
    }


def test_a_finished_comparison_is_not_repeated(results, monkeypatch, capsys):
    monkeypatch.setattr(closed_loop, "train", lambda *_: pytest.fail("trained again"))
    with jax.enable_x64(False):
        assert main.main(results[1]) == 0
        assert "detector-dsn: up to date" in capsys.readouterr().out
        assert main.main([*results[1], "--seed", "1"]) == 2
    assert "made with seed = 1, got" in capsys.readouterr().err


def test_paths_are_for_clips_alone(tmp_path, capsys):
    assert main.main(["bench", "closed-loop", "folder", "--out", str(tmp_path)]) == 2
    assert "expected no paths after bench closed-loop, got folder" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_the_table_shows_estimates_with_intervals(results):
    rows = storage.read_json(results[0] / "scores.json")["rows"]
    table = tables.closed_loop(rows)
    own = dict(zip(table.header, table.rows[0], strict=True))
    assert own["detector"] == "dsn" and own["indoor passed"] == "0 of 2" and own["white untouched"] == "2 of 2"
    rate = metrics.poisson_rate(0, rows[0]["rooms"]["distance"] / 100)
    assert own["collisions / 100 m"] == f"0.0 (0.0 to {rate.high:.1f})"
    assert dict(zip(table.header, table.rows[-1], strict=True))["us a frame"] == "-"
    assert table.latex("a_b").count(r"\\") == len(rows) + 1
    header, first, *_ = tables.to_csv(rows).splitlines()
    assert dict(zip(header.split(","), first.split(","), strict=True))["rooms.per_100_m.low"] == "0.0"


def test_cost_is_that_of_the_detector(robot):
    with jax.enable_x64(False):
        assert 1 < cost.measure(assembly.with_detector(robot, dsn)) < 1e5


def test_what_is_written_can_be_read(results, tmp_path):
    rows = storage.read_json(results[0] / "scores.json")["rows"]
    written = bench_closed_loop.write(tmp_path, rows, SMOKE, 3)
    assert all(file.stat().st_size > 100 for file in written)
    assert json.loads((tmp_path / "scores.json").read_text())["seed"] == 3
