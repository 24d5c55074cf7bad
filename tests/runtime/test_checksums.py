"""Files that are not as they were written are refused; those of older versions, without checksums, are read."""

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest

from lgmdjax import paths
from lgmdjax.errors import InputError
from lgmdjax.runtime import checksums, storage


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    """A finished stage with a file and one in a folder below."""
    folder = tmp_path / "collect"
    (folder / "deep" / "er").mkdir(parents=True)
    storage.write_json(folder / "a.json", {"threshold": 0.25})
    storage.write_arrays(folder / "deep" / "er" / "b.npz", {"gain": np.ones(3)})
    storage.write_stamp(folder, {"fingerprint": "f"})
    return folder


def test_done_json_lists_checksums(stage: Path) -> None:
    stamp = json.loads((stage / "done.json").read_text())
    assert stamp["files"] == {
        name: hashlib.sha256((stage / name).read_bytes()).hexdigest() for name in ("a.json", "deep/er/b.npz")
    }
    assert storage.read_json(stage / "a.json") == {"threshold": 0.25}
    assert storage.read_arrays(stage / "deep" / "er" / "b.npz")["gain"].tolist() == [1.0, 1.0, 1.0]


def test_another_number_in_a_file_of_a_stage_is_refused(stage: Path) -> None:
    """The document is as valid as before, and as long."""
    text = (stage / "a.json").read_text()
    (stage / "a.json").write_text(text.replace("0.25", "9.25"))
    with pytest.raises(InputError, match=r"another checksum than in .*done\.json.*; delete its folder"):
        storage.read_json(stage / "a.json")
    storage.write_arrays(stage / "deep" / "er" / "b.npz", {"gain": np.full(3, 2.0)})
    with pytest.raises(InputError, match="another checksum"):
        storage.read_arrays(stage / "deep" / "er" / "b.npz")


def test_a_file_that_was_added_is_refused(stage: Path) -> None:
    storage.write_json(stage / "new.json", {})
    with pytest.raises(InputError, match=r"it is not in .*done\.json"):
        storage.read_json(stage / "new.json")


@pytest.mark.parametrize(
    "content", [b"", b"\xff", b"[1]", b'{"files": [], "sha256": ""}', b'{"files": {"a.json": "0"}}']
)
def test_a_damaged_done_json_is_refused(stage: Path, content: bytes) -> None:
    (stage / "done.json").write_bytes(content)
    with pytest.raises(InputError, match=r"done\.json"):
        storage.read_json(stage / "a.json")


@pytest.mark.parametrize("stamp", [{"seconds": 3.0}, {"files": {"a.json": 7}}])
def test_files_of_older_versions_are_read_without_checksums(stage: Path, stamp: dict) -> None:
    (stage / "done.json").write_text(json.dumps(stamp))
    (stage / "a.json").write_text('{"threshold": 9.25}')
    assert storage.read_json(stage / "a.json") == {"threshold": 9.25}


def test_a_json_object_with_another_checksum_than_its_own_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    storage.write_json(path, checksums.add_checksum({"seed": 1, "scale": "quick"}))
    assert storage.read_json(path)["seed"] == 1
    path.write_text(path.read_text().replace('"seed": 1', '"seed": 2'))
    with pytest.raises(InputError, match="checksum is not that of its contents"):
        storage.read_json(path)


def test_left_overs_are_no_results(tmp_path: Path) -> None:
    for name in ("a.json", "done.json.12.partial", "b.parquet.3.partial", "c.part"):
        (tmp_path / name).write_text("x")
    assert list(checksums.list_files(tmp_path)) == ["a.json"]


def test_the_package_lists_the_checksums_of_all_its_weights() -> None:
    weights = {path for path in paths.DATA_DIR.rglob("*") if path.is_file()} - {paths.DATA_DIR / "done.json"}
    files = checksums.read_stamp(paths.DATA_DIR).files
    assert files == {
        path.relative_to(paths.DATA_DIR).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in weights
    }


def test_files_are_synced_before_they_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order in which a power cut can do no harm: content, name, folder; the list of files when all are there."""
    calls: list[tuple[str, str]] = []
    sync, move = os.fsync, os.replace

    def recorded_sync(descriptor: int) -> None:
        calls.append(("sync", Path(os.readlink(f"/proc/self/fd/{descriptor}")).name))
        sync(descriptor)

    def recorded_move(source: Path, target: Path) -> None:
        calls.append(("name", Path(target).name))
        move(source, target)

    monkeypatch.setattr(os, "fsync", recorded_sync)
    monkeypatch.setattr(os, "replace", recorded_move)
    folder = tmp_path / "stage"
    folder.mkdir()
    storage.write_json(folder / "a.json", {})
    partial = f"a.json.{os.getpid()}.partial"
    assert calls == [("sync", partial), ("name", "a.json"), ("sync", "stage")]
    (folder / "figure.svg").write_text("<svg/>")  # written by a library
    calls.clear()
    storage.write_stamp(folder, {})
    before, after = calls[: calls.index(("name", "done.json"))], calls[calls.index(("name", "done.json")) :]
    assert {("sync", "a.json"), ("sync", "figure.svg"), ("sync", "stage")} < set(before)
    assert before[-1] == ("sync", f"done.json.{os.getpid()}.partial") and after[-1] == ("sync", "stage")
