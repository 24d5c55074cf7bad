"""`--distributed` and `--chunks`: what a user sees when processes do not find each other, or a store refuses."""

import socket

import pytest

from lgmdjax.cli import flags, main, processes
from lgmdjax.errors import InputError
from lgmdjax.runtime import distributed


def test_without_process_0_a_command_ends_in_one_line(tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    place = ["--coordinator", address, "--processes", "2", "--process", "1", "--wait", "0.3"]
    assert main.main(["collect", "--scale", "smoke", "--out", str(tmp_path), *place]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"lgmdjax: expected process 0 at {address} within 0.3 s, got none")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "match"),
    [
        (["--distributed"], "expected SLURM or Open MPI, or --coordinator"),
        (["--process", "1"], "expected all of --coordinator, --processes and --process"),
        (["--coordinator", "node:1", "--wait", "0"], "expected a --wait of more than 0 s"),
    ],
)
def test_impossible_flags_are_refused(given, match):
    parsed = flags.parse_pipeline("collect", "", ["--scale", "smoke", *given])
    with pytest.raises(InputError, match=match), processes.joined(parsed, "collect"):
        pass


def test_the_flags_do_not_change_the_name_of_the_run():
    given = ["--scale", "smoke", "--distributed", "--chunks", "memory://walks"]
    assert flags.parse_pipeline("collect", "", given).name == "smoke-0"


@pytest.mark.parametrize(
    ("error", "told"),
    [(InputError("expected a, got b"), "expected a, got b"), (distributed.OtherProcessError("process 0: x"), "")],
)
def test_only_a_fault_of_its_own_is_told_to_the_others(monkeypatch, error, told):
    left = []
    monkeypatch.setattr(distributed, "start", lambda *_, **__: None)
    monkeypatch.setattr(distributed, "leave", left.append)
    parsed = flags.parse_pipeline("collect", "", ["--scale", "smoke", "--distributed"])
    with pytest.raises(InputError, match=str(error)), processes.joined(parsed, "collect"):
        raise error
    assert left == [told]


def test_a_store_that_refuses_ends_in_one_line_before_any_stage(tmp_path, capsys):
    store = ["--chunks", f"file://{tmp_path}/file/below"]
    (tmp_path / "file").write_text("")
    assert main.main(["collect", "--scale", "smoke", "--out", str(tmp_path / "runs"), *store]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "to take an object, got " in line and "check that the bucket exists" in line
    assert [path.name for path in (tmp_path / "runs" / "smoke-0").iterdir() if path.is_dir()] == []
