"""Environments in which a library does not start, and terminals that cannot show everything, end in one line."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lgmdjax import paths
from lgmdjax.cli import environment
from lgmdjax.errors import InputError
from lgmdjax.runtime import jax_setup


def command(
    *arguments: str, stdout: int | None = subprocess.PIPE, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run lgmdjax in its own process, with other environment variables."""
    full = os.environ | {"PYTHONPATH": str(paths.PACKAGE_DIR.parent)} | variables
    call = [sys.executable, "-m", "lgmdjax", *arguments]
    return subprocess.run(call, env=full, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)


def refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("lgmdjax: ") and len(done.stderr.splitlines()) == 1, done.stderr
    assert all(word in done.stderr for word in words), done.stderr


@pytest.mark.parametrize(
    ("name", "value", "library"),
    [
        ("JAX_PLATFORMS", "nonsense", "JAX"),
        ("JAX_TRANSFER_GUARD", "disallow", "JAX"),
        ("MUJOCO_GL", "nonsense", "MuJoCo"),
        ("MPLBACKEND", "nonsense", "Matplotlib"),
    ],
)
def test_a_variable_that_a_library_does_not_understand_is_named(
    name: str, value: str, library: str, tmp_path: Path
) -> None:
    done = command("trial", "corner", "--seeds", "1", "--out", str(tmp_path / "new"), **{name: value})  # pyright: ignore[reportArgumentType]
    refused(done, f"expected an environment in which {library} starts", f"{name}='{value}'")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("value", ["0", "x", "", "-1", "1e9", "²"])
def test_an_impossible_number_of_devices_is_named(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", value)
    with pytest.raises(InputError, match=f"expected JAX_NUM_CPU_DEVICES of 1 to 1024, got '{value}'"):
        environment.check_jax()


@pytest.mark.parametrize("value", ["nonsense", "--nonsense", "--xla_cpu_use_fusion_emitters=true -x", "xla_dump_to=a"])
def test_flags_with_which_xla_would_end_the_process_are_named(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", value)
    with pytest.raises(InputError, match=f"expected XLA_FLAGS of the form --xla_name=value, .*got '{value}'"):
        environment.check_jax()


def test_a_backend_that_is_missing_is_named() -> None:
    """JAX fails at the first attempt alone."""
    error = RuntimeError("Unable to initialize backend 'x': it is not in the list of known backends")
    assert environment.explain(error).startswith(
        "expected an environment in which JAX starts, got Unable to initialize"
    )


def test_a_limit_of_memory_in_which_xla_would_end_the_process_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    if jax_setup.resource is None:
        pytest.skip("there are no such limits")
    monkeypatch.setattr(jax_setup.resource, "getrlimit", lambda _: (10**9, -1))
    with pytest.raises(InputError, match="expected 2 GB of memory or more, got a limit of 1 GB"):
        environment.check_jax()


def test_a_fault_of_the_program_is_no_fault_of_the_environment() -> None:
    assert environment.explain(ZeroDivisionError()) == ""
    assert "more memory" in environment.explain(type("JaxRuntimeError", (Exception,), {})("RESOURCE_EXHAUSTED: 8 GB"))
    assert "ulimit" in environment.explain(RuntimeError("can't start new thread"))


def test_a_user_without_a_home_folder_has_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    jax_setup.prepare_jax()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_help_is_printed_in_any_terminal() -> None:
    for variables in ({"COLUMNS": "1"}, {"COLUMNS": "1000000000"}, {"PYTHONIOENCODING": "ascii"}):
        done = command("trial", "--help", **variables)  # pyright: ignore[reportArgumentType]
        assert done.returncode == 0 and "--policy" in done.stdout, done.stderr


def test_names_that_the_terminal_cannot_show_are_escaped() -> None:
    refused(command("watch", "/nowhere/für\x1b[2J.mp4", PYTHONIOENCODING="ascii"), "f\\xfcr\\x1b[2J.mp4")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["trial", "--help"]])
def test_output_that_cannot_be_written_is_one_line(arguments: list[str]) -> None:
    with open("/dev/full", "w") as full:
        refused(command(*arguments, stdout=full.fileno()), "No space left on device")


@pytest.mark.skipif(os.name == "nt", reason="needs a shell that closes streams")
@pytest.mark.parametrize(
    ("arguments", "closed", "code"),
    [("--version", "<&- >&- 2>&-", 0), ("nonsense", "2>&-", 2), ("--help", ">&-", 0)],
)
def test_a_closed_stream_is_no_fault_and_no_file_gets_its_number(arguments: str, closed: str, code: int) -> None:
    script = f'"{sys.executable}" -m lgmdjax {arguments} {closed}'
    done = subprocess.run(
        ["sh", "-c", script], capture_output=True, text=True, check=False, cwd=paths.PACKAGE_DIR.parent
    )
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


def test_null_devices_take_the_place_of_closed_streams() -> None:
    script = "import os\nfrom lgmdjax.cli.main import exit_code\n"
    script += "exit_code(lambda: os._exit(open('/dev/null').fileno()))"  # the first number that is free
    done = subprocess.run(["sh", "-c", f'"{sys.executable}" -c "{script}" <&- >&- 2>&-'], cwd=paths.PACKAGE_DIR.parent)
    assert done.returncode > 2


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_full_disk_is_one_line(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    from lgmdjax.cli.main import exit_code

    def write() -> None:
        raise OSError(number, os.strerror(number), "runs/new\n.npz")

    assert exit_code(write) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("lgmdjax: expected space on the disk for runs/new .npz, got ")


@pytest.mark.parametrize("arguments", [["trial", "corner", "--out", ""], ["trial", "corner", "--out="], ["watch", ""]])
def test_an_empty_path_is_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    from lgmdjax.cli import main

    assert main.main(arguments) == 2
    assert "expected a value for" in capsys.readouterr().err
