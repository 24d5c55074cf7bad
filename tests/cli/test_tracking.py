"""`--track`: event files that TensorBoard reads, a user's function, and one line for what leads nowhere."""

import struct
from pathlib import Path

import pytest
from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]  # protobuf makes it on import

from lgmdjax.cli import main, tracking
from lgmdjax.errors import InputError
from lgmdjax.runtime.tracking import log


def read_events(path: Path) -> list[tuple[int, str, float]]:
    """Read the records of an event file: length, checksum, content, checksum (TFRecord)."""
    content, events, at = path.read_bytes(), [], 0
    while at < len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        event = Event.FromString(content[at + 12 : at + 12 + length])
        events += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
        at += length + 16
    return events


@pytest.fixture
def fitting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the execution of stages by a fit of two epochs."""

    def execute(run, stages, target: str) -> Path:
        log(1, {"round-0/train_mse": 0.5, "round-0/test_mse": 0.75})
        log(2, {"round-0/train_mse": 0.25})
        return run.folder / target

    monkeypatch.setattr("lgmdjax.runtime.run_folders.execute", execute)


@pytest.mark.usefixtures("fitting")
def test_tensorboard_gets_the_curves_of_every_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["train", "--scale", "smoke", "--out", str(tmp_path), "--track", "tensorboard"]) == 0
    (file,) = (tmp_path / "smoke-0" / "tensorboard").glob("events.out.tfevents.*")
    train, test = "round-0/train_mse", "round-0/test_mse"
    assert sorted(read_events(file)) == [(1, test, 0.75), (1, train, 0.5), (2, train, 0.25)]
    assert f"tensorboard --logdir {file.parent}" in capsys.readouterr().out


@pytest.mark.usefixtures("fitting")
def test_a_users_function_gets_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.py").write_text("seen = []\ndef log(step, values):\n    seen.append((step, dict(values)))\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert main.main(["train", "--scale", "smoke", "--out", str(tmp_path), "--track", "mine:log"]) == 0
    import mine  # pyright: ignore[reportMissingImports]

    assert mine.seen == [(1, {"round-0/train_mse": 0.5, "round-0/test_mse": 0.75}), (2, {"round-0/train_mse": 0.25})]
    log(3, {"round-0/train_mse": 0.125})  # the command is over
    assert len(mine.seen) == 2


def test_what_leads_nowhere_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for track, words in (
        ("wandb", "got wandb; choose one"),
        ("no_such_module:log", "is its folder on PYTHONPATH?"),
        ("math:pi", "math:pi, which can't be called"),
    ):
        assert main.main(["train", "--scale", "smoke", "--out", str(tmp_path), "--track", track]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("lgmdjax: expected --track tensorboard, or module:function") and words in line
    monkeypatch.setattr(tracking, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"expected tensorboardX .* pip install 'lgmdjax\[tracking\]'"):
        tracking.check("tensorboard")
    assert not any(tmp_path.iterdir())


def test_a_function_that_raises_is_one_line(tmp_path: Path) -> None:
    words = r"expected operator:add to take step 5, got TypeError: .*leave --track out"
    with pytest.raises(InputError, match=words), tracking.log_to("operator:add", tmp_path):
        log(5, {"fit/loss": 1.0})
