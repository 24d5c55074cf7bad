"""The command line: a user's mistake is one line on stderr and exit code 2, and help loads no JAX."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from lgmdjax import __version__, paths
from lgmdjax.cli import main
from lgmdjax.pipeline import scales
from lgmdjax.runtime import storage
from lgmdjax.studies.settings import FailureModesSettings

STAGES = ("reproduce", "fit-gait", "collect", "train", "evaluate", "report")
HEAVY = ("jax", "mujoco", "matplotlib", "av", "numpy")


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that must end with exit code 2, and return its line on stderr."""
    assert main.main(arguments) == 2
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == 1, captured.err
    assert captured.err.startswith("lgmdjax: expected ")
    return captured.err


@pytest.mark.parametrize("command", STAGES)
def test_a_folder_that_cannot_be_written_is_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    line = refused([command, "--scale", "smoke", "--out", str(tmp_path / "file")], capsys)
    assert "can be written" in line and str(tmp_path / "file") in line and "choose another" in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_another_scale_or_seed_in_the_same_folder_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from lgmdjax.runtime.run_folders import open_run

    open_run(tmp_path, "mine", "smoke", 0, scales.SCALES["smoke"])
    line = refused(["reproduce", "--scale", "quick", "--name", "mine", "--out", str(tmp_path)], capsys)
    assert "scale = quick" in line and "made with smoke" in line
    assert "seed = 1" in refused(["train", "--scale=smoke", "--name=mine", f"--out={tmp_path}", "--seed=1"], capsys)
    for seed in (-1, 2**32, 10**20):
        assert str(seed) in refused(["train", "--scale=smoke", f"--out={tmp_path / 'new'}", f"--seed={seed}"], capsys)
    assert not (tmp_path / "new").exists()
    assert sorted(path.name for path in (tmp_path / "mine").iterdir()) == [".lock", "run.json"]


@pytest.fixture
def executed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Replace the execution of stages; the list gets the run folder of each command."""
    folders: list[Path] = []

    def execute(run, stages, target: str) -> Path:
        folders.append(run.folder)
        return run.folder / target

    monkeypatch.setattr("lgmdjax.runtime.run_folders.execute", execute)
    return folders


@pytest.mark.parametrize("command", STAGES)
def test_changed_settings_are_recorded_and_name_the_run_folder(
    command: str, tmp_path: Path, executed: list[Path]
) -> None:
    flags = ["--train.epochs", "7", "--collect.eyes.width=128", "--evaluate.unseen.seeds", "6", "--fit-gait.steps", "9"]
    assert main.main([command, "--scale", "smoke", "--seed", "3", "--out", str(tmp_path), *flags]) == 0
    name = "smoke-3_fit-gait.steps=9_collect.eyes.width=128_train.epochs=7_evaluate.unseen.seeds=6"
    assert executed == [tmp_path / name]
    record = storage.read_json(tmp_path / name / "run.json")
    settings = record["settings"]
    assert (record["scale"], record["seed"]) == ("smoke", 3)
    assert settings["train"]["epochs"] == 7
    assert settings["train"]["robots"] == 4
    assert settings["collect"]["eyes"]["width"] == 128
    assert settings["fit-gait"]["steps"] == 9
    assert [plan["seeds"] for plan in settings["evaluate"]["trials"]] == [4, 6]


def test_a_setting_equal_to_that_of_the_scale_changes_nothing(tmp_path: Path, executed: list[Path]) -> None:
    assert main.main(["train", "--scale", "smoke", "--out", str(tmp_path)]) == 0
    assert main.main(["train", "--scale", "smoke", "--out", str(tmp_path), "--collect.seconds", "10.0"]) == 0
    assert executed == 2 * [tmp_path / "smoke-0"]


def test_other_settings_in_the_same_folder_are_one_line(
    tmp_path: Path, executed: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "--scale", "smoke", "--name", "mine", "--out", str(tmp_path)]
    assert main.main([*command, "--train.epochs", "7"]) == 0
    before = (tmp_path / "mine" / "run.json").read_bytes()
    line = refused([*command, "--train.epochs", "8"], capsys)
    assert "settings.train.epochs = 8" in line and "made with 7" in line and "choose another --name" in line
    assert "settings.train.epochs = 5" in refused(command, capsys)
    line = refused([*command, "--train.epochs", "7", "--evaluate.unseen.seeds", "6"], capsys)
    assert "settings.evaluate.trials.1.seeds = 6" in line and "made with 4" in line
    assert (tmp_path / "mine" / "run.json").read_bytes() == before
    assert executed == [tmp_path / "mine"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--train.epochs", "-1"], "more than 0 for --train.epochs, got -1"),
        (["--train.epochs", "0"], "more than 0 for --train.epochs, got 0"),
        (["--collect.seconds", "inf"], "--collect.seconds, got inf"),
        (["--train.turn-gains", "1.5", "-2"], "--train.turn-gains, got -2"),
        (["--train.dagger-rounds", "-1"], "0 or more for --train.dagger-rounds"),
        (["--evaluate.unseen.trial", "tube"], "--evaluate.unseen.trial"),
        (
            ["--train.turn-gains", *(f"1.{k:03}" for k in range(100))],
            "a --name for a run with so many changed settings",
        ),
    ],
)
def test_a_setting_that_makes_no_sense_is_one_line(
    flags: list[str], words: str, tmp_path: Path, executed: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert words in refused(["train", "--scale", "smoke", "--out", str(tmp_path), *flags], capsys)
    assert not any(tmp_path.iterdir())


def test_an_impossible_field_of_the_eyes_is_refused_before_anything_runs(
    tmp_path: Path, executed: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value, limits in (
        ("overlap", "nan", "0.5 to 1"),
        ("overlap", "0.2", "0.5 to 1"),
        ("ground", "1.0", "0 to"),
    ):
        with pytest.raises(SystemExit) as ended:
            main.main(["train", "--scale", "smoke", "--out", str(tmp_path), f"--collect.eyes.{name}", value])
        assert ended.value.code == 2
        words = capsys.readouterr().err.replace("│", " ").split()
        assert f"collect.eyes: expected a{'n' * (name == 'overlap')} {name} of the eyes of {limits}" in " ".join(words)
    assert not executed and not any(tmp_path.iterdir())


def test_a_setting_that_does_not_exist_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for flags in (["--scale", "smoke", "--velocity.robots", "3"], ["--train.epoch", "3"], ["--scale", "huge"]):
        with pytest.raises(SystemExit) as ended:
            main.main(["train", *flags])
        assert ended.value.code == 2
        assert flags[-2] in capsys.readouterr().err


def test_studies_of_recorded_walks_need_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("sensitivity", "overlap", "lgmd-gradient"):
        assert "--run" in refused(["study", name], capsys)
    assert "--settings.robots, got 0" in refused(["study", "velocity", "--settings.robots", "0"], capsys)


def test_every_study_has_a_question_settings_and_a_module() -> None:
    from lgmdjax.cli import study

    presets = {**scales.SCALES["paper"], **scales.STUDY_PRESETS}
    assert list(main.STUDIES) == list(study.MODULES)
    assert set(main.STUDIES) <= set(presets)
    assert set(presets) - set(main.STUDIES) == set(scales.SCALES["quick"])
    assert all(callable(module.run) and callable(module.plot) for module in study.MODULES.values())


def test_a_study_gets_its_changed_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = {}
    monkeypatch.setattr("lgmdjax.cli.study.run_study", lambda name, flags: given.setdefault(name, flags))
    assert main.main(["study", "failure-modes", "--out", str(tmp_path), "--settings.benchmark.robots", "2"]) == 0
    flags, preset = given["failure_modes"], scales.SCALES["paper"]["failure_modes"]
    assert isinstance(preset, FailureModesSettings)
    assert flags.settings == replace(preset, benchmark=replace(preset.benchmark, robots=2))
    assert (flags.name, flags.out, flags.run) == ("failure_modes-0_benchmark.robots=2", tmp_path, None)


def test_trials_and_policies_are_compared_line_by_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = {
        "testing": {"per_100_m": {}, "collisions": 3, "distance": 41.2, "progress": {"coverage": {"value": 18.21}}},
        "indoor": {"robots": 12, "untouched": 11, "passed": 3, "retreated": 8},
    }

    def run_trial(name: str, policy: str, **flags: object) -> Path:
        folder = tmp_path / f"{name}-{policy}"
        folder.mkdir()
        storage.write_json(folder / "outcome.json", outcomes[name])
        return folder

    monkeypatch.setattr("lgmdjax.evaluation.run_trial.run_trial", run_trial)
    assert main.main(["trial", "testing", "indoor", "--policy", "blind", "learned", "blind"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"testing, blind: 3 collisions in 41 m, 18.2 new cells a minute; results in {tmp_path / 'testing-blind'}",
        f"testing, learned: 3 collisions in 41 m, 18.2 new cells a minute; results in {tmp_path / 'testing-learned'}",
        f"indoor, blind: 11 of 12 untouched; 3 passed, 8 turned back; results in {tmp_path / 'indoor-blind'}",
        f"indoor, learned: 11 of 12 untouched; 3 passed, 8 turned back; results in {tmp_path / 'indoor-learned'}",
    ]


def test_all_stands_for_the_five_policies() -> None:
    from lgmdjax.cli import flags
    from lgmdjax.control.names import POLICY_NAMES

    given = flags.parse_trial("", ["indoor", "--policy", "random", "all"])
    assert given.trials == ("indoor",)
    assert given.policies() == ("random", *(name for name in POLICY_NAMES if name != "random"))
    assert flags.parse_trial("", ["tube"]).policies() == ("learned",)


def test_no_trial_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert "choose from testing, unseen, tube" in refused(["trial"], capsys)


def test_export_lists_its_files_and_replaces_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["export", "pretrained", str(tmp_path / "robot"), "--formats", "c"]
    assert main.main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[:3]] == [
        str(tmp_path / "robot" / name) for name in ("nervous_system.c", "nervous_system.h", "card.json")
    ]
    memory = json.loads((tmp_path / "robot" / "card.json").read_text())["memory"]
    sizes = f"{memory['state'] / 1000:.1f} kB of state, {memory['constants'] / 1000:.1f} kB of constants"
    assert lines[3] == f"static memory of the C program: {sizes}"
    assert "empty or a new folder" in refused(command, capsys)
    assert "lgmdjax train" in refused(["export", str(tmp_path), str(tmp_path / "new"), "--formats", "c"], capsys)
    assert "choose from onnx, stablehlo, c" in refused([*command[:2], str(tmp_path / "new"), "--formats"], capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["robot"]


def test_an_interruption_is_exit_code_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("lgmdjax.cli.doctor.run_checks", interrupted)
    assert main.main(["doctor"]) == 130
    assert capsys.readouterr().err == "lgmdjax: interrupted; the same command starts again\n"
    monkeypatch.setattr("lgmdjax.cli.flags.parse_trial", interrupted)
    assert main.main(["trial"]) == 130
    assert capsys.readouterr().err == "lgmdjax: interrupted; the same command resumes\n"


def test_the_exit_code_of_a_command_is_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lgmdjax.cli.doctor.run_checks", lambda out: 1)
    assert main.main(["doctor"]) == 1


@pytest.mark.parametrize(("arguments", "choice"), [(["reprodce"], "reproduce"), (["study", "speed"], "velocity")])
def test_an_unknown_name_is_answered_with_those_that_exist(
    arguments: list[str], choice: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(arguments)
    assert ended.value.code == 2
    assert choice in capsys.readouterr().err


def help_texts(*calls: tuple[str, ...], heavy: tuple[str, ...] = HEAVY) -> list[str]:
    """Print the help of each call in one new process, which must not load heavy modules, and return the texts."""
    program = (
        "import json, sys\nfrom lgmdjax.cli import main\n"
        "for call in json.loads(sys.argv[1]):\n"
        "    try: main.main(call)\n"
        "    except SystemExit as ended: assert ended.code == 0\n"
        "    print(chr(12), end='')\n"
        f"print('heavy:', sorted(set({heavy}) & set(sys.modules)))"
    )
    environment = os.environ | {"PYTHONPATH": str(paths.PACKAGE_DIR.parent)}
    command = [sys.executable, "-c", program, json.dumps(calls)]
    out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    *texts, loaded = out.split(chr(12))
    assert loaded == "heavy: []\n" and len(texts) == len(calls), out
    return texts


def test_help_and_version_load_nothing_heavy() -> None:
    calls = ("--version",), ("--help",), ("study", "--help")
    version, commands, studies = help_texts(*calls, heavy=(*HEAVY, "tyro"))
    assert version == f"lgmdjax {__version__}\n"
    assert all(f"  {name} " in commands for name in main.COMMANDS)
    assert all(name in studies and question in studies for name, question in main.STUDIES.items())


def test_help_of_a_command_loads_no_jax() -> None:
    names = [name for name in main.COMMANDS if name != "study"]
    texts = dict(zip(names, help_texts(*((name, "--help") for name in names)), strict=True))
    assert all(f"lgmdjax {name}" in text for name, text in texts.items())
    for name in STAGES:
        for flag in ("--fit-gait.steps", "--collect.eyes.width", "--train.epochs", "--evaluate.testing.seeds"):
            assert flag in texts[name], name


def test_help_of_a_study_loads_no_jax() -> None:
    (text,) = help_texts(("study", "gait_gradient", "--help"))
    assert main.STUDIES["gait_gradient"] in text and "--settings.learning-rate" in text
