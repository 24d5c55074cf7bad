"""`lgmdjax doctor`: nothing is wrong here, and each fault is reported in one line."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.cli import doctor, main
from lgmdjax.errors import InputError


def test_no_check_fails_on_this_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = doctor.run_checks(tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert code == 0, lines
    assert len(lines) == 9
    assert all(line.startswith(("OK ", "WARN")) for line in lines)


def test_jax_computes_the_canary_program_correctly() -> None:
    assert doctor.check_arithmetic().level == doctor.OK


def test_a_miscompiled_program_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def skip_rows(function: object) -> object:
        return lambda rows: np.where(np.arange(len(rows)) % 2, np.sum(rows**2, axis=1), 0.0)

    monkeypatch.setattr(jax, "jit", skip_rows)
    finding = doctor.check_arithmetic()
    assert finding.level == doctor.FAIL
    assert "16385 of 32769 results wrong" in finding.text


@pytest.mark.parametrize(
    ("required", "level", "words"),
    [
        (["jax>=0.9.2,!=0.10.*", "numpy>=1"], doctor.OK, "jax 0."),
        (["jax>=99"], doctor.FAIL, "expected >=99"),
        (["no-such-package>=1"], doctor.FAIL, "no-such-package none"),
        (["no-such-package>=1; extra == 'gym'"], doctor.OK, ""),
    ],
)
def test_versions_out_of_range_are_reported(
    monkeypatch: pytest.MonkeyPatch, required: list[str], level: str, words: str
) -> None:
    monkeypatch.setattr(doctor, "requires", lambda name: required)
    finding = doctor.check_packages()
    assert finding.level == level
    assert words in finding.text


def test_different_versions_of_mujoco_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "requires", lambda name: [])
    monkeypatch.setattr(doctor, "version", lambda name: {"mujoco": "3.18.0"}.get(name, "3.17.0"))
    assert doctor.check_packages().level == doctor.FAIL


def test_a_failing_check_is_one_line_and_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise InputError("expected the robot,\ngot nothing")

    monkeypatch.setattr(hexapod, "load", fail)
    assert doctor.run_checks(tmp_path) == 1
    lines = capsys.readouterr().out.splitlines()
    (failed,) = [line for line in lines if line.startswith("FAIL")]
    assert failed.startswith("FAIL  physics      InputError: expected the robot, got nothing")


def test_physics_that_cannot_be_imported_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "lgmdjax.runtime.mjx", None)
    assert main.main(["doctor", "--out", str(tmp_path)]) == 1
    assert "FAIL  physics      ModuleNotFoundError" in capsys.readouterr().out


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert doctor.check_folder(tmp_path / "new" / "folder").level == doctor.OK
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]
    for path in (tmp_path / "file", tmp_path / "file" / "inside", Path("/proc/nowhere")):
        assert doctor.check_folder(path).level == doctor.FAIL


def test_a_full_disk_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for enough, minimum, level in ((0.0, 0.0, doctor.OK), (1e9, 0.0, doctor.WARN), (1e9, 1e9, doctor.FAIL)):
        monkeypatch.setattr(doctor, "ENOUGH_GB", enough)
        monkeypatch.setattr(doctor, "MIN_GB", minimum)
        assert doctor.check_disk(tmp_path).level == level


def test_variables_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "x")

    def fail() -> None:
        raise AssertionError

    monkeypatch.setattr(hexapod, "load", fail)
    assert doctor.run_checks(tmp_path) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(
        line.startswith("FAIL  environment") and "JAX_NUM_CPU_DEVICES" in line and "'x'" in line for line in lines
    )
    assert any(
        line.startswith("FAIL  physics      AssertionError") and "JAX_NUM_CPU_DEVICES='x'" in line for line in lines
    )
