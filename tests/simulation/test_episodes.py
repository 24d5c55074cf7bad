"""Walks on disk: the same numbers back, nothing lost but a running chunk, bad files told in one line."""

import json
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lgmdjax.errors import InputError
from lgmdjax.simulation import episodes

SHAPES = {
    "position": (3,),
    "quaternion": (4,),
    "joints": (6, 3),
    "u": (2,),
    "feed_forward": (2,),
    "excitation": (2,),
    "distances": (2,),
    "label": (2,),
    "velocity": (2,),
    "clearance": (),
}
SETTINGS = {"camera": {"width": 320}, "threshold": 4.5}


def record(robots=2, frames=20, start=0, dtype: type = np.float32) -> dict[str, np.ndarray]:
    """What a rollout gives: arrays with axes (robot, frame); noise, so that a mix-up shows."""
    rng = np.random.default_rng(start)
    fields: dict[str, np.ndarray] = {
        name: rng.normal(size=(robots, frames, *shape)).astype(dtype) for name, shape in SHAPES.items()
    }
    fields["time"] = np.tile(((start + np.arange(frames)) / 30).astype(dtype), (robots, 1))
    fields["contact"] = np.zeros((robots, frames), bool)
    fields["fresh"] = np.zeros((robots, frames), bool)
    fields["fresh"][:, 0] = start == 0
    fields["setbacks"] = np.zeros((robots, frames), np.int32)
    fields["ok"] = np.ones((robots, frames), bool)
    return fields


def write(folder, *records, settings=SETTINGS, **walk):
    writer = episodes.Writer(folder, settings)
    for chunk in records:
        robots = len(chunk["time"] if isinstance(chunk, dict) else chunk.time)
        writer.write(chunk, **{"episode": 0, "rooms": range(robots), "seed": 7} | walk)
    return writer


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_comes_back_is_what_was_written(tmp_path, dtype):
    """Bit for bit, robot by robot, chunks joined in order; from a mapping as from an object."""
    first, second = record(dtype=dtype), record(start=20, dtype=dtype)
    write(tmp_path, first, SimpleNamespace(**second), rooms=[5, 8])
    walks = episodes.read(tmp_path)
    assert [(w.episode, w.robot, w.room, w.seed, len(w)) for w in walks] == [
        (0, 0, 5, 7, 40),
        (0, 1, 8, 7, 40),
    ]
    for robot, walk in enumerate(walks):
        for name in episodes.FIELDS:
            expected = np.concatenate([first[name][robot], second[name][robot]])
            np.testing.assert_array_equal(getattr(walk, name), expected)
            assert getattr(walk, name).dtype == expected.dtype


def test_episodes_are_told_apart(tmp_path):
    write(tmp_path, record(), record(start=20), episode=0)
    write(tmp_path, record(robots=3), episode=1, seed=8)
    walks = episodes.read(tmp_path, SETTINGS)
    assert [(w.episode, w.robot, w.seed, len(w)) for w in walks] == [
        (0, 0, 7, 40),
        (0, 1, 7, 40),
        (1, 0, 8, 20),
        (1, 1, 8, 20),
        (1, 2, 8, 20),
    ]


def test_a_stranger_can_read_the_file(tmp_path):
    """Names, units, parameters and versions are in the Parquet file itself."""
    write(tmp_path, record())
    table = pq.read_table(tmp_path / "chunk-00000.parquet")
    header = json.loads(table.schema.metadata[b"lgmdjax"])
    assert table.num_rows == 40 and table.column_names == list(episodes.COLUMNS)
    assert header["units"]["distance_left"] == "m" and header["units"]["joint_17"] == "rad"
    assert header["parameters"] == SETTINGS == episodes.parameters(tmp_path)
    assert set(header["versions"]) >= {"jax", "mujoco"}
    assert header["version"] == 1


def test_a_kill_loses_the_running_chunk_at_most(tmp_path, monkeypatch):
    """Whatever the moment: in the middle of the file, or before it gets its name."""
    writer = write(tmp_path, record(), record(start=20))

    def killed(table, path, **options):
        path.write_bytes(b"PAR1 half a chu")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pq, "write_table", killed)
        with pytest.raises(KeyboardInterrupt):
            writer.write(record(start=40), episode=0, rooms=[0, 1], seed=7)
    assert [len(walk) for walk in episodes.read(tmp_path)] == [40, 40]
    again = write(tmp_path, record(start=40))
    assert again.chunks == 3
    assert [len(walk) for walk in episodes.read(tmp_path)] == [60, 60]
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".parquet"] * 3


def test_stretches_are_sound_uninterrupted_and_touch_nothing(tmp_path):
    """Robot 0 touches something at frame 8 and is put down; robot 1 falls at frame 12 of 20."""
    walked = record()
    walked["contact"][0, 8] = True
    walked["setbacks"][0, 9:] = 1
    walked["fresh"][0, 9] = True
    walked["ok"][1, 12:] = False
    write(tmp_path, walked)
    walks = episodes.read(tmp_path)
    frames = [np.round(s.time * 30).astype(int) for s in episodes.stretches(walks, minimum=5)]
    assert [(f[0], f[-1]) for f in frames] == [(2, 7), (11, 19), (2, 11)]
    assert [len(s) for s in episodes.stretches(walks, minimum=9, settle=0)] == [11, 12]
    assert not episodes.stretches(walks, minimum=30)


def test_a_missing_stretch_of_time_ends_a_stretch(tmp_path):
    write(tmp_path, record(), record(start=35))
    assert [len(s) for s in episodes.stretches(episodes.read(tmp_path), minimum=1)] == [18, 20] * 2


def refused(folder, match, **arguments):
    with pytest.raises(InputError, match=match) as caught:
        episodes.read(folder, **arguments)
    line = str(caught.value)
    assert "\n" not in line and "expected" in line and "got" in line and str(folder) in line


def test_a_folder_without_walks_is_refused(tmp_path):
    refused(tmp_path, "lgmdjax collect")
    refused(tmp_path / "nowhere", "lgmdjax collect")


def test_damaged_files_are_refused(tmp_path):
    write(tmp_path, record(), record(start=20))
    path = tmp_path / "chunk-00001.parquet"
    whole = path.read_bytes()
    for size in (0, 3, 12, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        refused(tmp_path, "chunk-00001.*whole Parquet file")
    path.write_bytes(whole[: len(whole) // 4] + bytes(200) + whole[len(whole) // 4 + 200 :])
    refused(tmp_path, "chunk-00001.*whole Parquet file")
    (tmp_path / "chunk-00000.parquet").unlink()
    path.write_bytes(whole)
    refused(tmp_path, "a chunk is missing")


def test_files_of_another_kind_or_version_are_refused(tmp_path):
    write(tmp_path, record())
    path = tmp_path / "chunk-00000.parquet"
    table = pq.read_table(path)
    header = json.loads(table.schema.metadata[b"lgmdjax"])
    pq.write_table(table.replace_schema_metadata({"lgmdjax": json.dumps(header | {"version": 0})}), path)
    refused(tmp_path, "expected walks of version 1, got 0")
    pq.write_table(table.drop_columns("u_left"), path)
    refused(tmp_path, "got none called u_left")
    pq.write_table(pa.table({"u": [1.0]}), path)
    refused(tmp_path, "another kind")


def test_walks_of_other_settings_are_refused(tmp_path):
    write(tmp_path, record())
    refused(tmp_path, r"threshold 4.5 for 6.0", parameters=SETTINGS | {"threshold": 6.0})
    with pytest.raises(InputError, match=r"threshold 4.5 for 6.0"):
        episodes.Writer(tmp_path, SETTINGS | {"threshold": 6.0})
    other = tmp_path / "other"
    write(other, record(dtype=np.float64))
    (other / "chunk-00000.parquet").rename(tmp_path / "chunk-00001.parquet")
    refused(tmp_path, "one precision")


def test_records_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(InputError, match="a room for each of 2 robots, got 3"):
        write(tmp_path, record(), rooms=range(3))
    with pytest.raises(InputError, match=r"episodes u: expected 2 numbers a frame .* got shape \(2, 20, 3\)"):
        write(tmp_path, record() | {"u": np.zeros((2, 20, 3))})
    assert not list(tmp_path.iterdir())
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(InputError, match="expected a folder to write to"):
        episodes.Writer(file, SETTINGS)
