"""Runs of a sweep as processes: all of them once, resumed after a failure, and their measures in a table.

A small program stands in for `lgmdjax`. It writes a result that depends on its arguments.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from lgmdjax.cli import flags
from lgmdjax.cli import sweep as command
from lgmdjax.errors import InputError
from lgmdjax.reporting.figures import sweeps as figure
from lgmdjax.sweeps import execution, results, sweep_file, task

FILE = """
command = ["measure"]
result = "out/*.json"
measures = ["rows.1.number"]
seeds = [0, 1, 2]
[grid]
gain = [1.0, 2.0]
"""
PROGRAM = """
import json, os, pathlib, sys, time
given = dict(zip(sys.argv[2::2], sys.argv[3::2]))
folder = pathlib.Path(given["--out"]) / "out"
folder.mkdir()
print("started", flush=True)
if given["--seed"] == os.environ.get("FAILS"):
    print("lgmdjax: expected luck, got none")
    sys.exit(int(os.environ["CODE"]))
number = float(given["--gain"]) * (1 + int(given["--seed"])) ** 2
(folder / "result.json").write_text(json.dumps({"rows": [{}, {"number": number}]}))
"""


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Let every run execute `PROGRAM`."""
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    monkeypatch.setattr(execution, "PROGRAM", (sys.executable, str(path)))
    monkeypatch.setattr(execution, "POLL", 0.01)


@pytest.fixture
def sweep(tmp_path) -> sweep_file.Sweep:
    (tmp_path / "sweep.toml").write_text(FILE)
    return sweep_file.read(tmp_path / "sweep.toml")


def expected_number(row) -> float:
    return row["setting"]["gain"] * (1 + row["seed"]) ** 2


@pytest.mark.parametrize("workers", [1, 3])
def test_every_run_is_measured(tmp_path, program, sweep, workers):
    rows = execution.run_sweep(tmp_path / "runs", sweep, workers)
    assert [(row["number"], row["seed"]) for row in rows] == [(k, seed) for k in range(2) for seed in range(3)]
    assert all(row["measures"] == {"rows.1.number": expected_number(row)} for row in rows)


def test_jobs_of_a_cluster_give_the_same(tmp_path, program):
    sweep = sweep_file.read(_rewritten(tmp_path, "[0, 1, 2]", "[1]"))
    cluster = execution.Cluster(name="local", minutes=5, cores=1)
    execution.check(1, cluster)
    rows = execution.run_sweep(tmp_path / "runs", sweep, cluster=cluster)
    assert len(rows) == 2
    assert all(row["measures"] == {"rows.1.number": expected_number(row)} for row in rows)


def test_only_failed_runs_are_repeated(tmp_path, program, sweep, monkeypatch):
    monkeypatch.setenv("FAILS", "1")
    monkeypatch.setenv("CODE", "1")
    with pytest.raises(InputError, match=r"got 2 that failed.*'gain': 1.0} and seed 1 \(expected luck, got none\)"):
        execution.run_sweep(tmp_path / "runs", sweep)
    monkeypatch.delenv("FAILS")
    for folder in (tmp_path / "runs").glob("*-seed-1"):
        (folder / "out").rmdir()
    assert len(execution.run_sweep(tmp_path / "runs", sweep)) == 6
    starts = {path.parent.name: path.read_text().count("started") for path in (tmp_path / "runs").glob("*/log.txt")}
    assert starts == {f"{number:04d}-seed-{seed}": 1 + (seed == 1) for number in range(2) for seed in range(3)}


def test_a_mistake_ends_the_sweep_at_once(tmp_path, program, sweep, monkeypatch):
    monkeypatch.setenv("FAILS", "0")
    monkeypatch.setenv("CODE", "2")
    with pytest.raises(InputError, match="got 1 that failed"):
        execution.run_sweep(tmp_path / "runs", sweep)
    assert len(list((tmp_path / "runs").iterdir())) == 1


def test_an_interruption_ends_the_processes(tmp_path, sweep, monkeypatch):
    started = []
    start = task.Task.start

    def start_and_interrupt(run):
        started.append(start(run))
        monkeypatch.setattr(execution.interruption, "check", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
        return started[-1]

    waiting = (sys.executable, "-c", "import time; time.sleep(600)")
    monkeypatch.setattr(execution, "PROGRAM", waiting)
    monkeypatch.setattr(task.Task, "start", start_and_interrupt)
    with pytest.raises(KeyboardInterrupt):
        execution.run_sweep(tmp_path / "runs", sweep)
    assert len(started) == 1
    assert started[0].poll() == -15


def test_the_table_has_means_with_student_intervals(tmp_path, program, sweep):
    rows = execution.run_sweep(tmp_path / "runs", sweep)
    summary = results.summarise(sweep, rows)
    numbers = np.array([1.0, 4.0, 9.0])
    low, high = stats.t.interval(0.95, 2, loc=numbers.mean(), scale=stats.sem(numbers))
    mean = summary[0]["means"]["rows.1.number"]
    np.testing.assert_allclose([mean["value"], mean["low"], mean["high"]], [numbers.mean(), low, high])
    assert f"| 1.0 | 4.67 [{low:.3g}, {high:.3g}] |\n" in results.table(sweep, summary)
    panel = figure.plot(summary).axes[0]
    assert panel.get_ylabel() == "rows.1.number"
    assert panel.figure.axes[-1].get_xlabel() == "gain"


def test_a_single_seed_has_no_interval(tmp_path, program, sweep):
    single = sweep_file.read(_rewritten(tmp_path, "[0, 1, 2]", "[2]"))
    summary = results.summarise(single, execution.run_sweep(tmp_path / "runs", single))
    assert "| 1.0 | 9 |\n" in results.table(single, summary)
    figure.plot(summary)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("out/*.json", "*.json", "expected one file .* found 0; correct result"),
        ("rows.1.number", "rows.2.number", "found at '2' only 0, 1; correct measures"),
        ("rows.1.number", "rows.1", "expected a finite number at rows.1"),
        ("rows.1.number", "rows.1.number.value", "found at 'value' only 1.0"),
    ],
)
def test_wrong_results_are_named(tmp_path, program, old, new, message):
    wrong = sweep_file.read(_rewritten(tmp_path, old, new))
    with pytest.raises(InputError, match=message):
        execution.run_sweep(tmp_path / "runs", wrong)


def _rewritten(folder: Path, old: str, new: str) -> Path:
    path = folder / "other.toml"
    path.write_text(FILE.replace(old, new))
    return path


def test_the_command_writes_its_files_and_is_not_repeated(tmp_path, program, sweep, capsys):
    given = flags.parse_sweep("", [str(tmp_path / "sweep.toml"), "--out", str(tmp_path / "sweeps")])
    folder = command.run(given)
    assert {path.name for path in folder.iterdir()} >= {"runs.json", "sweep.json", "sweep.md", "sweep.png"}
    assert len(json.loads((folder / "runs.json").read_text())) == 6
    capsys.readouterr()
    assert command.run(given) == folder
    assert "up to date" in capsys.readouterr().out
    (tmp_path / "sweep.toml").write_text(FILE.replace("2.0", "3.0"))
    with pytest.raises(InputError, match="choose another --name"):
        command.run(given)


@pytest.mark.parametrize(("words", "message"), [
    (["--workers", "0"], "one or more --workers"),
    (["--submitit", "local", "--minutes", "-1"], "one or more --minutes"),
])  # fmt: skip
def test_impossible_numbers_are_refused(tmp_path, sweep, words, message):
    given = flags.parse_sweep("", [str(tmp_path / "sweep.toml"), "--out", str(tmp_path / "sweeps"), *words])
    with pytest.raises(InputError, match=message):
        command.run(given)
    assert not (tmp_path / "sweeps").exists()


@pytest.mark.skipif(os.path.exists("/usr/bin/srun"), reason="here is a cluster")
def test_slurm_is_refused_where_there_is_none(tmp_path, sweep):
    given = flags.parse_sweep("", [str(tmp_path / "sweep.toml"), "--submitit", "slurm"])
    with pytest.raises(InputError, match="expected SLURM's srun on this machine, found none"):
        command.run(given)
