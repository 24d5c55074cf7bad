"""The comparison in the closed loop: what is planned, refused, recorded, scored and written, on synthetic walks."""

import csv
import json
from dataclasses import replace

import jax
import numpy as np
import pytest
import synthetic

from lgmdjax.bench import closed_loop, cost, fitting, stages, tables, worlds
from lgmdjax.bench.settings import CAMERA_FAULTS, CLOSED_LOOP_SCALES
from lgmdjax.cli import bench_all, main
from lgmdjax.cli.flags import BenchFlags
from lgmdjax.detectors import dsn
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, stimulus_scores
from lgmdjax.learning import detector_calibration
from lgmdjax.reporting import video_io
from lgmdjax.reporting.figures import detector_walks
from lgmdjax.runtime import storage
from lgmdjax.sensors import camera_faults
from lgmdjax.simulation import assembly, episodes, recording, rerender

SMOKE = CLOSED_LOOP_SCALES["smoke"]
OWN = [stages.OWN]


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


def test_all_detectors_that_see_steer_and_the_robots_own_comes_first():
    names = stimulus_scores.choose_seeing(["all"], OWN)
    assert names[0] == "robot" and "lgmd2" in names and not {"eta", "tau"} & set(names)
    assert stimulus_scores.choose_seeing(["emd", "all"], OWN)[:2] == ["emd", "robot"]
    assert len(stimulus_scores.choose_seeing(["emd", "emd"])) == 1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["eta"], "expected a detector that sees, got eta, which is given the geometry"),
        (["lgmd", "nothing"], "expected a detector among lgmd, .*, got nothing"),
        (["robot", "tau"], "got tau.*choose from robot, lgmd, "),
        (["lgmdjax.detectors:missing"], r"got lgmdjax\.detectors:missing"),
    ],
)
def test_a_wrong_detector_is_refused_before_any_work(given, words):
    with pytest.raises(InputError, match=words):
        stimulus_scores.choose_seeing(given, OWN)


def test_a_plan_has_a_stage_for_each_detector(robot):
    names = ["robot", "emd", "lgmdjax.detectors:dsn"]
    planned, settings = closed_loop.plan(robot, names, SMOKE)
    assert [stage.name for stage in planned] == [
        "walks", "detector-robot", "detector-emd", "detector-lgmdjax.detectors-dsn", "references", "scores",
    ]  # fmt: skip
    assert {stage.name for stage in planned} == set(settings)
    assert settings["detector-lgmdjax.detectors-dsn"].source == "dsn"
    assert planned[-1].inputs == tuple(stage.name for stage in planned[1:-1])


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
def films(tmp_path_factory):
    """Return a folder of labelled films: a square that grows, on two sides, and one that shrinks."""
    folder = tmp_path_factory.mktemp("films")
    film = np.full((45, 48, 64, 3), 200, np.uint8)
    for k, half in enumerate(np.linspace(2, 22, 45).astype(int)):
        film[k, 24 - half : 24 + half, 30 - half : 30 + half] = 20
    for name, frames in (("left.mp4", film), ("right.mp4", film[:, :, ::-1]), ("shrinks.mp4", film[::-1])):
        with video_io.open_writer(folder / name, 64, 48, 30, fast=True) as write:
            for frame in frames:
                write(np.ascontiguousarray(frame))
    (folder / "labels.csv").write_text(
        "clip,kind,contact_s\nleft.mp4,approach,\nright.mp4,approach,\nshrinks.mp4,recede,\n"
    )
    return folder


@pytest.fixture(scope="module")
def results(tmp_path_factory, films):
    """All benchmarks, with walks and pictures replaced; searches, fits and trainings are real, and small."""
    out = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(False):
        patch.setattr(recording, "record_rollouts", fake_walks)
        patch.setattr(rerender, "render_walks", fake_pictures)
        patch.setattr(detector_calibration, "POOLINGS", (3,))
        patch.setattr(detector_calibration, "CONTRASTS", (4.0, 8.0))
        patch.setattr(detector_calibration, "MIN_SECONDS", 1.0)
        patch.setattr(detector_calibration.lgmd_grid_search, "correlations", lambda u, nearness: {"score": 0.5})
        patch.setattr(fitting, "CONTRASTS", (1.0, 2.0))
        arguments = ["bench", "all", str(films), "--scale", "smoke", "--detector", "dsn", "tau", "--out", str(out)]
        assert main.main(arguments) == 0
        yield out, arguments


def test_every_row_has_all_scores(results):
    folder = results[0] / "closed-loop-smoke"
    facts = storage.read_json(folder / "scores.json")
    assert [row["detector"] for row in facts["rows"]] == ["dsn", "teacher", "blind"]
    assert facts["seed"] == 0 and facts["versions"]["jax"] == jax.__version__
    row, teacher, _ = facts["rows"]
    assert set(row) >= {*worlds.WORLDS, "fits", "microseconds"} and row["microseconds"] > 0
    assert row["rooms"]["collisions"] == 0 and row["rooms"]["per_100_m"]["low"] == 0
    assert row["scenes"]["white"]["robots"] == 2 and row["calibration"]["contrast"] in (4.0, 8.0)
    assert "noise" not in teacher
    kinds = {f"scores.{kind}" for kind in ("json", "md", "csv", "tex", "png")}
    for name in ("closed-loop-smoke", "fit-smoke", "stimuli-smoke"):
        assert {path.name for path in (results[0] / name).glob("scores.*")} == kinds


def test_fits_have_scores_and_constants_before_and_after(results):
    facts = storage.read_json(results[0] / "fit-smoke" / "scores.json")
    (row,) = facts["rows"]
    assert facts["settings"]["fit"]["steps"] == 2
    for data in (row["stimuli"], *row["walks"]["runs"]):
        assert list(data["scores"]) == list(fitting.STEPS) and len(data["curve"]) == 3
        changed = [k for k, own in data["constants"].items() if not np.allclose(own["before"], own["after"], 1e-6)]
        best = max(data["curve"], key=lambda point: (point["score"], -point["step"]))
        assert bool(changed) == (best["step"] > 0)
    assert set(row["walks"]["scores"]["fitted"]) == {"value", "low", "high"}


def test_one_table_and_one_page_have_all_benchmarks(results):
    folder = results[0] / "all-smoke"
    header, *rows = csv.reader((folder / "scores.csv").read_text().splitlines())
    table = {row[0]: dict(zip(header, row, strict=True)) for row in rows}
    assert set(table) == {"dsn", "tau", "teacher", "blind"}
    assert table["tau"]["collisions / 100 m"] == "-" and table["teacher"]["slope"] == "-"
    assert "-" not in (table["dsn"][head] for head in header if head != "slope")
    assert table["dsn"]["hits, false"].split(", ")[0].endswith("of 2") and table["dsn"]["walls"] == "2 of 2"
    page = (folder / "index.html").read_text()
    assert page.count("data:image/png;base64,") == 4 and "http" not in page.replace("data:", "")
    assert f"jax {jax.__version__}" in page and page.count("<td>dsn</td>") == 5
    facts = storage.read_json(folder / "scores.json")
    assert set(facts["benchmarks"]) == {"stimuli", "clips", "fit", "closed-loop"} and facts["versions"]


def test_a_finished_comparison_is_not_repeated(results, monkeypatch, capsys):
    for module, function in ((closed_loop, "train"), (fitting, "fit_on_walks")):
        monkeypatch.setattr(module, function, lambda *_: pytest.fail("done again"))
    out = ["--scale", "smoke", "--detector", "dsn", "--out", str(results[0])]
    with jax.enable_x64(False):
        for benchmark in ("closed-loop", "fit"):
            assert main.main(["bench", benchmark, *out]) == 0
            assert "detector-dsn: up to date" in capsys.readouterr().out
            assert main.main(["bench", benchmark, *out, "--seed", "1"]) == 2
            assert "made with seed = 1, got" in capsys.readouterr().err


def test_each_benchmark_gets_the_detectors_that_it_can_run(films):
    flags = BenchFlags(on="all", detector=("robot", "emd", "eta"))
    plan = {name: own.detector for name, own in bench_all.choose(flags).items()}
    assert plan == {"stimuli": ("emd", "eta"), "fit": ("emd",), "closed-loop": ("robot", "emd")}
    assert set(bench_all.choose(replace(flags, paths=(films,)))) == {*plan, "clips"}
    assert list(bench_all.choose(replace(flags, detector=("robot",)))) == ["closed-loop"]
    for wrong in (replace(flags, detector=("none",)), replace(flags, paths=(films / "none",))):
        with pytest.raises(InputError):
            bench_all.choose(wrong)


def test_paths_are_for_clips_alone(tmp_path, capsys):
    for benchmark in ("closed-loop", "fit"):
        assert main.main(["bench", benchmark, "folder", "--out", str(tmp_path)]) == 2
        assert f"expected no paths after bench {benchmark}, got folder" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_the_table_shows_estimates_with_intervals(results):
    rows = storage.read_json(results[0] / "closed-loop-smoke" / "scores.json")["rows"]
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
    rows = storage.read_json(results[0] / "closed-loop-smoke" / "scores.json")["rows"]
    found = tables.Results(rows, tables.closed_loop(rows), detector_walks.plot(rows, ["rooms"]), "", SMOKE)
    written = tables.write(tmp_path, found, 3)
    assert all(file.stat().st_size > 100 for file in written)
    assert json.loads((tmp_path / "scores.json").read_text())["seed"] == 3
