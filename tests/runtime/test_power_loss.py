"""A power cut leaves no half file under a final name: what gets a name is on the disk first, and its folder afterwards.

The disk is a model: it keeps the content that a file, and the names that a folder, had when it was last synced.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import synthetic

from lgmdjax.hardware import drive_log, joint_map, lens
from lgmdjax.locomotion import shaping
from lgmdjax.runtime import partial_files, run_folders, storage
from lgmdjax.simulation import episodes


class Disk:
    """What would be there after a power cut, and what got a name before it was there."""

    def __init__(self) -> None:
        self.kept: dict[int, object] = {}  # content of files, names in folders, by inode
        self.named: list[Path] = []
        self.lost: list[Path] = []

    def sync(self, descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        self.kept[path.stat().st_ino] = self.content(path)

    def name(self, source: Path, target: Path) -> None:
        """Look at everything that is about to get its final name."""
        self.lost += [path for path in (source, *source.rglob("*")) if not self.has(path)]
        self.named.append(target)

    def has(self, path: Path) -> bool:
        kept, content = self.kept.get(path.stat().st_ino), self.content(path)
        return content <= kept if isinstance(content, set) and isinstance(kept, set) else content == kept

    @staticmethod
    def content(path: Path) -> object:
        return {entry.name for entry in path.iterdir()} if path.is_dir() else path.read_bytes()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    made, sync, replace = Disk(), os.fsync, os.replace

    def synced(descriptor: int) -> None:
        sync(descriptor)
        made.sync(descriptor)

    def replaced(source: Path, target: Path) -> None:
        made.name(Path(source), Path(target))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    yield made


def write_tree(folder: Path) -> None:
    """Write a file, and another two folders below."""
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "README.md").write_text("walks")
    (folder / "data" / "chunk-000" / "file-000.parquet").write_bytes(b"walks")


def write_dataset(folder: Path) -> None:
    with partial_files.new_folder(folder / "new") as work:
        write_tree(work)


def write_results(folder: Path) -> None:
    with partial_files.replacing_all(folder / "clip.mp4") as work:
        (work / "response.csv").write_text("time,u")
        storage.write_json(work / "alarms.json", {})


def write_log(folder: Path) -> None:
    with drive_log.Writer(folder / "log", {}) as log:
        log.add({"time": 0.0})


def run_stage(folder: Path) -> None:
    stage = run_folders.Stage(name="collect", run=lambda work, *_: write_tree(work))
    run = run_folders.open_run(folder, "quick-0", "quick", 0, {"collect": None})
    run_folders.execute(run, [stage], "collect")


LENS = lens.Lens(model="fisheye", size=(8, 6), K=np.array([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), D=np.zeros(4))
WRITERS: dict[str, Callable[[Path], object]] = {
    "JSON": lambda folder: storage.write_json(folder / "a.json", [1]),
    "npz": lambda folder: storage.write_arrays(folder / "a.npz", {"a": np.ones(3)}),
    "safetensors": lambda folder: shaping.save(folder / "a.safetensors", shaping.load_pretrained()),
    "walks": lambda folder: episodes.Writer(folder, {}).write(synthetic.walk(1, 3), episode=0, rooms=[0], seed=0),
    "log": write_log,
    "lens": lambda folder: lens.write(folder / "a.json", LENS),
    "lens in YAML": lambda folder: lens.write(folder / "a.yaml", LENS),
    "joint map": lambda folder: joint_map.write(folder / "a.toml", joint_map.default()),
    "data set": write_dataset,
    "results": write_results,
    "stage": run_stage,
}


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs the names of open files")
@pytest.mark.parametrize("kind", WRITERS)
def test_what_gets_a_name_is_on_the_disk(disk: Disk, tmp_path: Path, kind: str) -> None:
    WRITERS[kind](tmp_path / "new" / "folder" if kind in ("walks", "log", "data set", "results", "stage") else tmp_path)
    assert disk.named and not disk.lost
    above = {folder for target in disk.named if target.exists() for folder in target.parents if folder >= tmp_path}
    assert [folder for folder in above if not disk.has(folder)] == []  # else a power cut would take names


def test_the_model_notices_what_is_not_synced(disk: Disk, tmp_path: Path) -> None:
    (tmp_path / "a.partial").write_text("half")
    os.replace(tmp_path / "a.partial", tmp_path / "a")
    assert disk.lost == [tmp_path / "a.partial"] and not disk.has(tmp_path)


def test_a_file_does_not_take_the_place_of_a_folder(tmp_path: Path) -> None:
    """And none of the others is replaced."""
    (tmp_path / "response.csv").mkdir()
    (tmp_path / "alarms.json").write_text("before")
    with (
        contextlib.suppress(partial_files.InputError),
        partial_files.replacing_all(tmp_path) as work,
    ):
        (work / "alarms.json").write_text("after")
        (work / "response.csv").write_text("after")
    assert {path.name for path in tmp_path.iterdir()} == {"response.csv", "alarms.json"}
    assert (tmp_path / "alarms.json").read_text() == "before"
