"""A user's mistake ends in one line on stderr and exit code 2; help does not wait for JAX."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lgmdjax import __version__, paths
from lgmdjax.cli import main


def fails(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that must end in exit code 2; give its line."""
    assert main.main(arguments) == 2
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == 1, captured.err
    assert captured.err.startswith("lgmdjax: expected ")
    return captured.err


@pytest.mark.parametrize("command", ["reproduce", "fit-gait", "collect", "train", "evaluate", "report"])
def test_a_folder_that_cannot_be_written_is_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    line = fails([command, "--scale", "smoke", "--out", str(tmp_path / "file")], capsys)
    assert "can be written" in line and str(tmp_path / "file") in line and "choose another --out" in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_other_settings_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from lgmdjax.pipeline.scales import SCALES
    from lgmdjax.runtime.run_folders import open_run

    open_run(tmp_path, "mine", "smoke", 0, SCALES["smoke"])
    line = fails(["reproduce", "--scale", "quick", "--name", "mine", "--out", str(tmp_path)], capsys)
    assert "scale = quick" in line and "made with smoke" in line
    assert "seed = 1" in fails(["train", "--scale=smoke", "--name=mine", f"--out={tmp_path}", "--seed=1"], capsys)
    for seed in (-1, 2**32, 10**20):
        assert str(seed) in fails(["train", "--scale=smoke", f"--out={tmp_path / 'new'}", f"--seed={seed}"], capsys)
    assert not (tmp_path / "new").exists()
    assert sorted(path.name for path in (tmp_path / "mine").iterdir()) == [".lock", "run.json"]


def test_an_interruption_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(out: Path) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("lgmdjax.cli.doctor.examine", interrupted)
    assert main.main(["doctor"]) == 130
    assert "the same command carries on" in capsys.readouterr().err


def test_the_exit_code_of_a_command_is_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lgmdjax.cli.doctor.examine", lambda out: 1)
    assert main.main(["doctor"]) == 1


def test_an_unknown_command_names_those_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(["reprodce"])
    assert ended.value.code == 2
    assert "reproduce" in capsys.readouterr().err


def test_help_and_version_load_nothing_heavy() -> None:
    program = (
        "import sys; from lgmdjax.cli import main\n"
        "for flag in ('--version', '--help'):\n"
        "    try: main.main([flag])\n"
        "    except SystemExit: pass\n"
        "print('heavy:', sorted({'jax', 'mujoco', 'matplotlib', 'av', 'numpy'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", program]
    environment = os.environ | {"PYTHONPATH": str(paths.PACKAGE.parent)}
    out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    assert out.startswith(f"lgmdjax {__version__}\n")
    assert all(name in out for name in main.COMMANDS)
    assert out.endswith("heavy: []\n")
