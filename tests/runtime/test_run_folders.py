"""Stages run once, run again when something they depend on changes, and never leave half a result."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

import lgmdjax
from lgmdjax.errors import InputError
from lgmdjax.runtime import run_folders
from lgmdjax.runtime.run_folders import Run, Stage, execute, open_run


@dataclass(frozen=True)
class Number:
    value: int
    parts: tuple[int, ...] = (1, 2)


@dataclass
class Pipeline:
    """Two numbers and their sum; lists the stages that ran."""

    ran: list[str] = field(default_factory=list)
    interrupt: bool = False

    def number(self, folder: Path, inputs: Mapping[str, Path], settings: Number, seed: int) -> None:
        self.ran.append(folder.name.partition(".")[0])
        (folder / "value.txt").write_text(str(settings.value + seed))

    def total(self, folder: Path, inputs: Mapping[str, Path], settings: Number, seed: int) -> None:
        self.ran.append("total")
        values = [int((inputs[name] / "value.txt").read_text()) for name in ("left", "right")]
        first = folder / "first" / "half.txt"
        if first.exists():
            self.ran.append("resumed")
        else:
            first.parent.mkdir()
            first.write_text(str(values[0]))
            if self.interrupt:
                raise KeyboardInterrupt
        (folder / "value.txt").write_text(str(int(first.read_text()) + values[1]))

    @property
    def stages(self) -> tuple[Stage, ...]:
        return (
            Stage(name="left", run=self.number),
            Stage(name="right", run=self.number),
            Stage(name="total", run=self.total, inputs=("left", "right")),
        )

    def execute(self, run: Run, target: str = "total") -> list[str]:
        self.ran.clear()
        execute(run, self.stages, target)
        return list(self.ran)


SETTINGS = {"left": Number(1), "right": Number(10), "total": Number(0)}


@pytest.fixture
def pipeline() -> Pipeline:
    return Pipeline()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return open_run(tmp_path, "try", "smoke", 5, SETTINGS)


def test_a_finished_run_is_up_to_date(pipeline: Pipeline, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert pipeline.execute(run) == ["left", "right", "total"]
    assert (run.folder / "total" / "value.txt").read_text() == "21"
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("total: starts on 2 x cpu", "seed 5", str(run.folder), "jax"))
    assert pipeline.execute(run) == []
    assert capsys.readouterr().out.count("up to date") == 3


def test_one_stage_runs_alone(pipeline: Pipeline, run: Run) -> None:
    assert pipeline.execute(run, "right") == ["right"]
    assert not (run.folder / "left").exists()


def test_a_changed_setting_runs_the_stages_that_depend_on_it(pipeline: Pipeline, run: Run) -> None:
    pipeline.execute(run)
    changed = replace(run, settings=SETTINGS | {"left": Number(2)})
    assert pipeline.execute(changed) == ["left", "total"]
    assert (run.folder / "total" / "value.txt").read_text() == "22"


def test_another_seed_runs_everything(pipeline: Pipeline, run: Run) -> None:
    pipeline.execute(run)
    assert pipeline.execute(replace(run, seed=6)) == ["left", "right", "total"]


def test_another_version_of_a_stage_runs_it(pipeline: Pipeline, run: Run) -> None:
    pipeline.execute(run)
    execute(run, [replace(stage, version=2) for stage in pipeline.stages[:1]], "left")
    assert pipeline.ran[-1] == "left"


@pytest.mark.parametrize("damage", ["lost", "cut", "stamp", "seal"])
def test_a_damaged_stage_runs_again(pipeline: Pipeline, run: Run, damage: str) -> None:
    pipeline.execute(run)
    if damage == "seal":
        path = run.folder / "right" / "done.json"
        path.write_text(path.read_text().replace('"seconds": ', '"seconds": 1'))
    elif damage == "stamp":
        (run.folder / "right" / "done.json").write_text('{"fingerpr')
    elif damage == "cut":
        (run.folder / "right" / "value.txt").write_text("")
    else:
        (run.folder / "right" / "value.txt").unlink()
    assert pipeline.execute(run) == ["right"]
    assert (run.folder / "right" / "value.txt").read_text() == "15"


def test_a_stage_with_another_number_in_a_file_runs_again(
    pipeline: Pipeline, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its size is the same."""
    pipeline.execute(run)
    (run.folder / "right" / "value.txt").write_text("95")
    assert pipeline.execute(run) == ["right"]
    assert "right: done again, because" in capsys.readouterr().out
    assert (run.folder / "right" / "value.txt").read_text() == "15"


def test_a_stage_of_a_version_without_checksums_is_judged_by_sizes(pipeline: Pipeline, run: Run) -> None:
    pipeline.execute(run)
    path = run.folder / "right" / "done.json"
    stamp = json.loads(path.read_text())
    del stamp["sha256"]
    path.write_text(json.dumps(stamp | {"files": {"value.txt": 2}}))
    assert pipeline.execute(run) == []
    path.write_text(json.dumps(stamp | {"files": {"value.txt": 3}}))
    assert pipeline.execute(run) == ["right"]


def test_a_stage_that_was_killed_before_done_json_got_its_name_is_not_repeated(pipeline: Pipeline, run: Run) -> None:
    pipeline.execute(run)
    fingerprint = json.loads((run.folder / "right" / "done.json").read_text())["fingerprint"]
    partial = (run.folder / "right").rename(run.folder / f"right.partial-{fingerprint}")
    (partial / "done.json").rename(partial / "done.json.123.partial")
    assert pipeline.execute(run) == []
    assert sorted(path.name for path in (run.folder / "right").iterdir()) == ["done.json", "value.txt"]
    partial = (run.folder / "right").rename(run.folder / f"right.partial-{fingerprint}")
    content = (partial / "done.json").read_bytes()
    (partial / "done.json").unlink()
    (partial / "done.json.123.partial").write_bytes(content[:-20])
    assert pipeline.execute(run) == ["right"]
    assert sorted(path.name for path in (run.folder / "right").iterdir()) == ["done.json", "value.txt"]


def test_a_stage_with_additional_files_is_up_to_date(pipeline: Pipeline, run: Run) -> None:
    pipeline.execute(run)
    (run.folder / "total" / "my notes.txt").write_text("fine")
    assert pipeline.execute(run) == []


def test_an_interrupted_stage_leaves_no_result_and_resumes(
    pipeline: Pipeline, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    pipeline.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        pipeline.execute(run)
    assert not (run.folder / "total").exists()
    capsys.readouterr()
    (partial,) = run.folder.glob("total.partial-*")
    (partial / "first" / "half.txt.123.partial").write_text("of a process that was killed")
    assert pipeline.execute(run) == ["total", "resumed"]
    assert "total: resumes" in capsys.readouterr().out
    assert (run.folder / "total" / "value.txt").read_text() == "21"
    assert sorted(p.name for p in run.folder.iterdir()) == [".lock", "left", "right", "run.json", "total"]
    assert [p.name for p in (run.folder / "total" / "first").iterdir()] == ["half.txt"]


def test_an_interrupted_stage_is_not_resumed_with_other_inputs(pipeline: Pipeline, run: Run) -> None:
    pipeline.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        pipeline.execute(run)
    pipeline.interrupt = False
    assert pipeline.execute(replace(run, settings=SETTINGS | {"left": Number(2)})) == ["left", "total"]
    assert (run.folder / "total" / "value.txt").read_text() == "22"
    assert not list(run.folder.glob("*.partial-*"))


def test_a_stage_that_fails_keeps_its_last_result(pipeline: Pipeline, run: Run) -> None:
    pipeline.execute(run)
    pipeline.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        pipeline.execute(replace(run, settings=SETTINGS | {"total": Number(9)}))
    assert (run.folder / "total" / "value.txt").read_text() == "21"


def test_a_killed_run_can_be_resumed(tmp_path: Path) -> None:
    """Kill the process inside the stage, and then again between its last file and the move into place."""
    script = textwrap.dedent("""
        import os, signal, sys
        from pathlib import Path
        from lgmdjax.runtime import run_folders
        def work(folder, inputs, settings, seed):
            if not (folder / "a").exists():
                (folder / "a").write_text("a")
                os.kill(os.getpid(), signal.SIGKILL)
            (folder / "b").write_text("b")
        def die(*_):
            os.kill(os.getpid(), signal.SIGKILL)
        if sys.argv[2] == "die":
            move = os.replace
            os.replace = lambda source, to: die() if str(to).endswith("stage") else move(source, to)
        run = run_folders.open_run(Path(sys.argv[1]), "try", "smoke", 0, {"stage": 1})
        stage = run_folders.Stage(name="stage", run=work)
        print(run_folders.execute(run, [stage], "stage"))
    """)
    (tmp_path / "script.py").write_text(script)
    stage = tmp_path / "try" / "stage"

    def start(how: str) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": str(Path(lgmdjax.__file__).parent.parent)}
        command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path), how]
        return subprocess.run(command, capture_output=True, text=True, env=environment)

    assert start("live").returncode == -signal.SIGKILL
    assert not stage.exists()
    assert start("die").returncode == -signal.SIGKILL
    assert not stage.exists()
    finished = start("live")
    assert finished.returncode == 0, finished.stderr
    assert "starts" not in finished.stdout  # all files were there: only the move was missing
    assert sorted(path.name for path in stage.iterdir()) == ["a", "b", "done.json"]


def test_other_settings_are_refused(tmp_path: Path, run: Run) -> None:
    for scale, seed, settings, named in [
        ("quick", 5, SETTINGS, "scale = quick"),
        ("smoke", 6, SETTINGS, "seed = 6"),
        ("smoke", 5, SETTINGS | {"left": Number(3)}, "settings.left.value = 3"),
        ("smoke", 5, SETTINGS | {"left": Number(1, (1, 3))}, "settings.left.parts.1 = 3"),
    ]:
        with pytest.raises(InputError, match=f"expected .*{named}, got .* made with .*; choose"):
            open_run(tmp_path, "try", scale, seed, settings)
    assert open_run(tmp_path, "try", "smoke", 5, SETTINGS) == run


def test_settings_are_recorded(run: Run) -> None:
    made = json.loads((run.folder / "run.json").read_text())
    assert made["settings"]["left"] == {"value": 1, "parts": [1, 2]}
    assert made["seed"] == 5 and made["scale"] == "smoke" and "jax" in made["versions"]


@pytest.mark.parametrize(("change", "maker"), [(-1, "older"), (1, "newer")])
def test_a_folder_of_another_format_is_refused(tmp_path: Path, run: Run, change: int, maker: str) -> None:
    path = run.folder / "run.json"
    made = json.loads(path.read_text())
    path.write_text(json.dumps({"format": run_folders.FORMAT + change, "settings": made["settings"]}))
    with pytest.raises(InputError, match=f"made by an? {maker} lgmdjax; .*--run; choose another --name") as caught:
        open_run(tmp_path, "try", "smoke", 5, SETTINGS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", ["", '{"format": 2', "[]", '{"format": 2}', '{"format": "two"}', "{}"])
def test_unreadable_settings_are_refused(tmp_path: Path, run: Run, content: str) -> None:
    (run.folder / "run.json").write_text(content)
    with pytest.raises(InputError, match=r"run\.json.*(cannot be read|expected .*, got .*; delete the folder)"):
        open_run(tmp_path, "try", "smoke", 5, SETTINGS)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", Path("/proc/nowhere")):
        with pytest.raises(InputError, match="expected a folder that can be written, got"):
            open_run(out, "try", "smoke", 0, SETTINGS)


def test_messages_name_what_the_command_offers(tmp_path: Path) -> None:
    def make(scale: str) -> Run:
        return open_run(tmp_path, "tube-learned-0", scale, 5, SETTINGS, remedy="choose another --out")

    run = make("trial")
    with pytest.raises(InputError, match="choose another --out, or delete the folder"):
        make("study")

    def work(folder: Path, inputs: Mapping[str, Path], settings: Number, seed: int) -> None:
        with pytest.raises(InputError, match=r"wait, or choose another --out$"):
            execute(run, [Stage(name="right", run=work)], "right")

    execute(run, [Stage(name="left", run=work)], "left")


@pytest.mark.parametrize("name", ["", "a/b", "..", "/tmp", "a\x1b[2J", "a\nb"])
def test_a_name_with_a_path_in_it_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="plain folder name"):
        open_run(tmp_path, name, "smoke", 0, SETTINGS)


def test_a_name_that_is_not_utf_8_is_refused(tmp_path: Path) -> None:
    """Before hours of work: the checkpoints of a fit could not be written there."""
    with pytest.raises(InputError, match=r"expected a folder with a name in UTF-8, got .*caf\\udce9"):
        open_run(tmp_path / os.fsdecode(b"caf\xe9"), "run", "quick", 0, {})
    assert not any(tmp_path.iterdir())


def test_a_run_folder_is_locked_while_stages_run(run: Run) -> None:
    refusals: list[str] = []

    def work(folder: Path, inputs: Mapping[str, Path], settings: Number, seed: int) -> None:
        with pytest.raises(InputError, match="another process runs stages") as caught:
            execute(run, [Stage(name="right", run=work)], "right")
        refusals.append(str(caught.value))

    execute(run, [Stage(name="left", run=work)], "left")
    assert len(refusals) == 1


def test_a_run_folder_is_locked_for_other_processes(run: Run) -> None:
    script = textwrap.dedent("""
        import sys
        from pathlib import Path
        from lgmdjax.runtime.run_folders import Run, Stage, execute
        execute(Run(folder=Path(sys.argv[1]), seed=5, settings={"right": 1}), [Stage(name="right", run=print)], "right")
    """)

    def work(folder: Path, inputs: Mapping[str, Path], settings: Number, seed: int) -> None:
        command = [sys.executable, "-c", script, str(run.folder)]
        other = subprocess.run(command, capture_output=True, text=True)
        (folder / "stderr").write_text(other.stderr)

    folder = execute(run, [Stage(name="left", run=work)], "left")
    assert "another process runs stages" in (folder / "stderr").read_text()
    assert not list(run.folder.glob("right*"))
