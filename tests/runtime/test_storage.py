"""Files appear whole or not at all; missing, damaged and foreign files are refused in one line."""

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from lgmdjax.errors import InputError
from lgmdjax.runtime import partial_files, storage

KIND = storage.TensorFile(format="test weights", version="3", name="weights", remedy="`lgmdjax train` makes some")
SHAPES = {"a": (2, 3), "b": (1,)}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "weights.safetensors"


def test_a_file_is_replaced_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with partial_files.replacing(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
        assert partial.parent == tmp_path and str(os.getpid()) in partial.name
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_file_stays_if_writing_fails(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(error), partial_files.replacing(path) as partial:
        partial.write_text("half")
        raise error
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_nothing_is_replaced_by_no_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), partial_files.replacing(tmp_path / "file.txt"):
        pass
    assert not list(tmp_path.iterdir())


def test_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    names = ["a.json.123.partial", "below/b.parquet.4.partial", "old.part", "kept.json", "folder.partial/c.json"]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    partial_files.remove_partial_files(tmp_path)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"kept.json", str(Path("folder.partial/c.json"))}


def test_several_files_are_replaced_at_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    with partial_files.replacing_all(folder) as partial:
        (partial / "a").write_text("a")
        (partial / "b").write_text("b")
        assert not (folder / "a").exists()
    assert sorted(path.name for path in folder.iterdir()) == ["a", "b"]
    with pytest.raises(ValueError), partial_files.replacing_all(folder) as partial:
        (partial / "a").write_text("half")
        raise ValueError
    assert (folder / "a").read_text() == "a" and len(list(folder.iterdir())) == 2


def test_a_folder_is_not_made_if_writing_fails(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), partial_files.replacing_all(tmp_path / "new"):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="expected a folder that can be written"),
        partial_files.replacing_all(tmp_path / "file"),
    ):
        pass


def test_json_is_read_as_it_was_written(tmp_path: Path) -> None:
    content = {"a": [1, 2.5, None], "b": {"c": "d"}}
    storage.write_json(tmp_path / "a.json", content)
    assert storage.read_json(tmp_path / "a.json") == content
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_damaged_files_of_a_stage_are_named(tmp_path: Path) -> None:
    stage = tmp_path / "collect"
    stage.mkdir()
    (stage / "a.json").write_text('{"threshold": ')
    np.savez(stage / "b.npz", gain=1.0)
    assert storage.read_arrays(stage / "b.npz")["gain"] == 1.0
    (stage / "b.npz").write_bytes((stage / "b.npz").read_bytes()[:-20])
    for read, name, found in (
        (storage.read_json, "a.json", "cannot be read"),
        (storage.read_arrays, "b.npz", "cannot be read"),
        (storage.read_json, "none.json", "none"),
    ):
        with pytest.raises(InputError, match=f"expected .*{name}.*{found}.*`lgmdjax collect`"):
            read(stage / name)


def test_an_array_file_loads_no_pickle(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", allow_pickle=True, objects=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="cannot be read"):
        storage.read_arrays(tmp_path / "a.npz")


def weights() -> dict[str, np.ndarray]:
    return {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.ones(1)}


def test_tensors_and_metadata_are_read_as_they_were_written(path: Path) -> None:
    metadata = {"steps": 3, "note": 'a "quote"', "flag": True, "camera": {"width": 320}}
    storage.save_tensors(path, weights(), KIND, metadata)
    tensors, read = storage.load_tensors(path, KIND)
    assert read == metadata
    for name, value in weights().items():
        np.testing.assert_array_equal(tensors[name], value)
        assert tensors[name].dtype == value.dtype
    storage.check_weights(path, tensors, KIND, SHAPES)


@pytest.mark.parametrize(
    ("changed", "header", "message"),
    [
        ({}, {"format": "other weights"}, "expected weights, got another kind"),
        ({}, {"version": "2"}, "expected version 3, got 2"),
        ({"b": np.full(1, np.nan)}, {}, "expected finite weights"),
        ({}, {"steps": "{"}, "expected safetensors with weights"),
        ({"a": np.ones(3)}, {}, "expected weights .*, got"),
        ({"c": np.ones(3)}, {}, "expected weights .*, got"),
    ],
)
def test_other_tensors_are_refused(
    path: Path, changed: dict[str, np.ndarray], header: dict[str, str], message: str
) -> None:
    save_file(weights() | changed, path, {"format": KIND.format, "version": KIND.version} | header)
    with pytest.raises(InputError, match=f"{path}: {message}.*; `lgmdjax train` makes some") as caught:
        storage.check_weights(path, storage.load_tensors(path, KIND)[0], KIND, SHAPES)
    assert "\n" not in str(caught.value)


def test_damaged_tensors_are_refused(path: Path) -> None:
    with pytest.raises(InputError, match="expected safetensors with weights"):
        storage.load_tensors(path, KIND)
    storage.save_tensors(path, weights(), KIND, {})
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="expected safetensors with weights"):
        storage.load_tensors(path, KIND)


def test_tensors_are_not_written_if_they_are_not_finite_or_cannot_be(path: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected finite weights to save"):
        storage.save_tensors(path, weights() | {"b": np.full(1, np.inf)}, KIND, {})
    with pytest.raises(InputError, match="expected a place to write to"):
        storage.save_tensors(tmp_path / "none" / "weights.safetensors", weights(), KIND, {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"b": np.ones(1, int)}, "finite floats.*got int64"),
        ({"b": np.ones(1, bool)}, "finite floats.*got bool"),
        ({"b": np.ones(1, np.float16)}, "finite floats.*got float16"),
        ({"b": np.full(1, 1e38)}, "finite floats of -1e\\+06 to 1e\\+06.*1e\\+38"),
    ],
)
def test_weights_of_other_types_or_without_bounds_are_refused(path: Path, changed: dict, words: str) -> None:
    save_file(weights() | changed, path, {"format": KIND.format, "version": KIND.version})
    with pytest.raises(InputError, match=words):
        storage.check_weights(path, storage.load_tensors(path, KIND)[0], KIND, SHAPES)


def test_every_bit_of_tensors_is_checked(path: Path) -> None:
    """Damage is refused, or it is in what JSON does not need; it never gives other numbers."""
    storage.save_tensors(path, weights(), KIND, {"steps": 3})
    whole = path.read_bytes()
    refused = 0
    for position in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << position % 8
        path.write_bytes(damaged)
        try:
            tensors, metadata = storage.load_tensors(path, KIND)
        except InputError:
            refused += 1
            continue
        assert metadata.get("steps") == 3
        np.testing.assert_equal(tensors, weights())
    assert refused > 0.8 * len(whole) / 3


def crafted_npz(shape: str) -> bytes:
    """An npz file with two numbers, which says that it has another shape."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(16)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("gain.npy", member)
    return file.getvalue()


@pytest.mark.parametrize("content", [crafted_npz("(1000000000000,)"), crafted_npz("(-2,)")])
def test_an_array_that_says_it_is_larger_is_refused_before_memory_is_asked_for(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputError, match="cannot be read"):
        storage.read_arrays(tmp_path / "a.npz")
    (tmp_path / "a.npz").write_bytes(crafted_npz("(2,)"))
    assert storage.read_arrays(tmp_path / "a.npz")["gain"].tolist() == [0.0, 0.0]


def test_numbers_that_are_not_finite_are_null_in_json_and_nan_in_tables(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    storage.write_json(path, {"low": float("nan"), "all": (1.0, float("inf"))})
    assert json.loads(path.read_text(), parse_constant=pytest.fail) == {"low": None, "all": [1.0, None]}
    table = storage.read_table(path)
    assert np.isnan(table["low"]) and np.isnan(table["all"][1]) and table["all"][0] == 1.0


@pytest.mark.parametrize("content", [b"[" * 100_000, b"\xff\xfe", b"NaN]", b""])
def test_what_is_no_json_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match="cannot be read"):
        storage.read_json(tmp_path / "a.json")


def test_folders_of_killed_processes_are_removed_but_not_those_of_living_ones(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys, time; from pathlib import Path; from lgmdjax.runtime import partial_files\n"
        "with partial_files.replacing_all(Path(sys.argv[1])) as work:\n"
        "    (work / 'half').write_text('half'); print(flush=True); time.sleep(60)\n"
    )
    start = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(start, stdout=subprocess.PIPE) as killed:
        assert killed.stdout is not None and killed.stdout.readline()
        (work,) = [path for path in tmp_path.glob(".partial-*") if path.is_dir()]
        with partial_files.replacing_all(tmp_path) as own:
            (own / "a").write_text("a")
        assert (work / "half").exists(), "the process that writes it lives"
        killed.kill()
    with partial_files.replacing_all(tmp_path) as own:
        (own / "b").write_text("b")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
