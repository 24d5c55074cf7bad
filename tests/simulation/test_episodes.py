"""Recorded walks on disk: exact, complete up to the present chunk, damaged files refused in one line."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lgmdjax.errors import InputError
from lgmdjax.simulation import episodes
from lgmdjax.simulation.closed_loop import Record

SHAPES = {
    "position": (3,),
    "quaternion": (4,),
    "joints": (6, 3),
    "u": (2,),
    "feed_forward": (2,),
    "excitation": (2,),
    "distances": (2,),
    "corridor": (2,),
    "label": (2,),
    "velocity": (2,),
    "clearance": (),
}
SETTINGS = {"camera": {"width": 320}, "threshold": 4.5}


VERSION_1 = Path(__file__).parents[1] / "data" / "v0.1.0" / "smoke-0" / "collect" / "episodes"


def record(robots=2, frames=20, start=0, dtype: type = np.float32) -> Record:
    """Random numbers in the shapes of a rollout, with axes (robot, frame), so that exchanged columns are noticed."""
    rng = np.random.default_rng(start)
    is_first = np.zeros((robots, frames), bool)
    is_first[:, 0] = start == 0
    return Record(
        **{name: rng.normal(size=(robots, frames, *shape)).astype(dtype) for name, shape in SHAPES.items()},
        time=np.tile(((start + np.arange(frames)) / 30).astype(dtype), (robots, 1)),
        contact=np.zeros((robots, frames), bool),
        is_first=is_first,
        resets=np.zeros((robots, frames), np.int32),
        ok=np.ones((robots, frames), bool),
    )


def write(folder, *records, settings=SETTINGS, episode=0, rooms=None, seed=7):
    writer = episodes.Writer(folder, settings)
    for chunk in records:
        of_chunk = range(len(chunk.time)) if rooms is None else rooms
        writer.write(chunk, episode=episode, rooms=of_chunk, seed=seed)
    return writer


def test_every_field_of_a_record_has_columns():
    assert list(episodes.FIELDS) == [field.name for field in fields(Record)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_walks_are_read_as_they_were_written(tmp_path, dtype):
    """Bit for bit, robot by robot, chunks joined in order."""
    first, second = record(dtype=dtype), record(start=20, dtype=dtype)
    write(tmp_path, first, second, rooms=[5, 8])
    walks = episodes.read(tmp_path)
    assert [(w.episode, w.robot, w.room, w.seed, len(w)) for w in walks] == [
        (0, 0, 5, 7, 40),
        (0, 1, 8, 7, 40),
    ]
    for robot, walk in enumerate(walks):
        for name in episodes.FIELDS:
            expected = np.concatenate([getattr(both, name)[robot] for both in (first, second)])
            np.testing.assert_array_equal(getattr(walk, name), expected)
            assert getattr(walk, name).dtype == expected.dtype


def test_episodes_are_separate_walks(tmp_path):
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


def test_a_file_describes_itself(tmp_path):
    """It has names, units, parameters and versions."""
    write(tmp_path, record())
    table = pq.read_table(tmp_path / "chunk-00000.parquet")
    header = json.loads(table.schema.metadata[b"lgmdjax"])
    assert table.num_rows == 40 and table.column_names == list(episodes.COLUMNS)
    assert header["units"]["distance_left"] == "m" and header["units"]["joint_17"] == "rad"
    assert header["parameters"] == SETTINGS == episodes.read_parameters(tmp_path)
    assert set(header["versions"]) >= {"jax", "mujoco"}
    assert header["version"] == episodes.VERSION


def test_version_1_is_read_and_continued(tmp_path):
    """Its columns "fresh" and "setbacks" are now `is_first` and `resets`; new chunks have the present version."""
    old = VERSION_1 / "chunk-00000.parquet"
    shutil.copyfile(old, tmp_path / old.name)
    writer = episodes.Writer(tmp_path, episodes.read_parameters(tmp_path))
    before = episodes.read(tmp_path)
    np.testing.assert_array_equal(before[0].is_first, pq.read_table(old)["fresh"].to_numpy()[: len(before[0])])
    np.testing.assert_array_equal(before[0].corridor, before[0].distances)  # of their teacher
    dtype = before[0].position.dtype
    added = record(robots=2, start=60, dtype=dtype.type)
    writer.write(added, episode=before[0].episode, rooms=[walk.room for walk in before], seed=before[0].seed)
    after = episodes.read(tmp_path)
    assert [len(walk) for walk in after] == [len(walk) + 20 for walk in before]
    np.testing.assert_array_equal(after[1].resets, np.concatenate([before[1].resets, added.resets[1]]))


def test_an_interruption_loses_only_the_present_chunk(tmp_path, monkeypatch):
    """Also in the middle of the file, before it gets its name."""
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


def test_segments_have_no_contact_reset_or_fall(tmp_path):
    """Robot 0 has contact at frame 8 and is reset; robot 1 falls at frame 12 of 20."""
    recorded = record()
    recorded.contact[0, 8] = True
    recorded.resets[0, 9:] = 1
    recorded.is_first[0, 9] = True
    recorded.ok[1, 12:] = False
    write(tmp_path, recorded)
    walks = episodes.read(tmp_path)
    frames = [np.round(s.time * 30).astype(int) for s in episodes.segments(walks, min_frames=5)]
    assert [(f[0], f[-1]) for f in frames] == [(2, 7), (11, 19), (2, 11)]
    assert [len(s) for s in episodes.segments(walks, min_frames=9, settle_frames=0)] == [11, 12]
    assert not episodes.segments(walks, min_frames=30)


def test_missing_frames_end_a_segment(tmp_path):
    write(tmp_path, record(), record(start=35))
    assert [len(s) for s in episodes.segments(episodes.read(tmp_path), min_frames=1)] == [18, 20] * 2


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
    refused(tmp_path, "expected walks of version 1 or 2 or 3, got 0")
    del header["sha256"]
    table = table.replace_schema_metadata({"lgmdjax": json.dumps(header)})
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


def test_records_of_a_wrong_shape_are_refused(tmp_path):
    with pytest.raises(InputError, match="a room for each of 2 robots, got 3"):
        write(tmp_path, record(), rooms=range(3))
    with pytest.raises(InputError, match=r"episodes u: expected 2 numbers a frame .* got shape \(2, 20, 3\)"):
        write(tmp_path, replace(record(), u=np.zeros((2, 20, 3))))
    assert not list(tmp_path.iterdir())
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(InputError, match="expected a folder to write to"):
        episodes.Writer(file, SETTINGS)


def rewrite(folder, change, *, sealed=False, version=episodes.VERSION):
    """Write a chunk again as another program would: `change` gets its columns; without a checksum in the header."""
    path = folder / "chunk-00000.parquet"
    table = pq.read_table(path)
    header = json.loads(table.schema.metadata[b"lgmdjax"]) | {"version": version}
    if not sealed:
        del header["sha256"]
    columns = {name: table[name] for name in table.column_names}
    changed = change(columns) or columns
    pq.write_table(pa.table(changed).replace_schema_metadata({"lgmdjax": json.dumps(header)}), path)


def as_type(name, values):
    return lambda columns: columns.update({name: pa.array([values] * len(columns[name]))})


def with_value(name, row, value):
    def change(columns):
        values = columns[name].to_numpy().copy()
        values[row] = value
        columns[name] = pa.array(values)

    return change


def rows(selected):
    return lambda columns: {name: column.take(pa.array(selected, pa.int64())) for name, column in columns.items()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (as_type("x", "1"), "floats in column x, got string"),
        (as_type("x", [1.0]), "floats in column x, got list"),
        (as_type("x", None), "floats in column x, got null"),
        (as_type("u_left", 1), "floats in column u_left, got int64"),
        (as_type("ok", 1), "booleans in column ok, got int64"),
        (as_type("resets", 1.0), "integers in column resets, got double"),
        (as_type("robot", True), "integers in column robot, got bool"),
        (lambda columns: columns.update(x=pa.array([None, *range(1, 40)], pa.float32())), "float with 1 nulls"),
        (with_value("x", 3, np.nan), "in frames that are ok, got x nan of robot 0 in row 3"),
        (with_value("time", 22, np.nan), "got time nan of robot 1 in row 22"),
        (with_value("clearance", 3, np.inf), "got clearance inf"),
        (with_value("distance_left", 3, -np.inf), "got distance_left -inf"),
        (with_value("joint_17", 3, 1e38), "got joint_17"),
        (with_value("resets", 3, -1), "got resets -1"),
        (with_value("time", 3, 0.0), "increasing time and one room of robot 0 in episode 0, got time 0 after"),
        (with_value("room", 3, 9), "one room of robot 0"),
        (with_value("seed", 3, 9), "one room of robot 0"),
        (rows([]), "expected 1 to 10000000 rows"),
        (rows([*range(20), *range(20)]), "increasing time"),
        (rows(range(19, -1, -1)), "increasing time"),
    ],
)
def test_walks_that_no_robot_recorded_are_refused(tmp_path, change, words):
    write(tmp_path, record())
    rewrite(tmp_path, change)
    refused(tmp_path, words)


@pytest.mark.parametrize(
    "change", [rows(range(10)), rows([0]), with_value("u_left", 3, 0.7), with_value("contact", 3, True)]
)
def test_other_numbers_than_were_written_are_refused(tmp_path, change):
    """Each is a sound walk, so that only the checksum tells."""
    write(tmp_path, record())
    rewrite(tmp_path, change)
    episodes.read(tmp_path)
    shutil.rmtree(tmp_path)
    write(tmp_path, record())
    rewrite(tmp_path, change, sealed=True)
    refused(tmp_path, "another checksum in its header")


def test_a_chunk_that_is_there_twice_is_refused(tmp_path):
    write(tmp_path, record())
    shutil.copy(tmp_path / "chunk-00000.parquet", tmp_path / "chunk-00001.parquet")
    refused(tmp_path, "is a chunk there twice")


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (b"{", "expected a header in JSON"),
        (b"[" * 100_000, "expected a header in JSON"),
        (b"[]", "another kind"),
        (b'{"format": "lgmdjax episodes", "version": 3}', "header: expected an object with format, parameters"),
        (b'{"format": "lgmdjax episodes", "version": 3, "parameters": []}', "header.parameters: expected an object"),
        (b'{"format": "lgmdjax episodes", "version": [3], "parameters": {}}', "expected walks of version"),
        (b'{"format": "lgmdjax episodes", "version": 3, "parameters": {}, "sha256": 1}', "header.sha256"),
    ],
)
def test_headers_of_another_form_are_refused(tmp_path, header, words):
    write(tmp_path, record())
    path = tmp_path / "chunk-00000.parquet"
    pq.write_table(pq.read_table(path).replace_schema_metadata({"lgmdjax": header}), path)
    refused(tmp_path, words)
    with pytest.raises(InputError, match=words):
        episodes.read_parameters(tmp_path)


def test_frames_that_are_not_ok_may_lack_numbers_in_older_files(tmp_path):
    """They are read as zero, so that no sum over frames becomes nan."""
    write(tmp_path, record())

    def lose(columns):
        with_value("ok", 5, False)(columns)
        with_value("clearance", 5, np.nan)(columns)

    rewrite(tmp_path, lose)
    walk = episodes.read(tmp_path)[0]
    assert walk.clearance[5] == 0.0 and not walk.ok[5] and np.isfinite(walk.clearance).all()
    assert [len(segment) for segment in episodes.segments([walk], min_frames=1, settle_frames=0)] == [5, 14]


def test_segments_have_no_frame_that_is_not_finite(tmp_path):
    write(tmp_path, record())
    walk = episodes.read(tmp_path)[0]
    joints = walk.joints.copy()
    joints[5, 2, 1] = np.nan
    walk = replace(walk, joints=joints)
    assert [len(segment) for segment in episodes.segments([walk], min_frames=1, settle_frames=0)] == [5, 14]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"u": "dark"}, "episodes u: .* got shape"),
        ({"time": 3.0}, "episodes time"),
        ({"u": np.zeros((2, 2, 20))}, r"got shape \(2, 2, 20\)"),
        ({"joints": np.zeros((2, 20, 18))}, "expected 18 numbers a frame"),
        ({"clearance": np.zeros((2, 20), complex)}, "clearance: expected floats, got complex128"),
        ({"clearance": np.zeros((2, 20), int)}, "clearance: expected floats, got int64"),
        ({"clearance": np.zeros((2, 20), np.float16)}, "clearance: expected floats, got float16"),
        ({"ok": np.ones((2, 20))}, "ok: expected booleans, got float64"),
        ({"resets": np.zeros((2, 20))}, "resets: expected integers, got float64"),
        ({"clearance": None}, "episodes clearance"),
        ({"clearance": [[1.0], [1.0, 2.0]]}, "episodes clearance: expected an array"),
        ({"clearance": np.full((2, 20), np.nan)}, "got clearance nan of robot 0, frame 0"),
    ],
)
def test_records_of_other_types_are_refused(tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        write(tmp_path, replace(record(), **changes), rooms=range(2))
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("walk", "words"),
    [
        ({"seed": 2**63}, "seed: expected an integer of 0 to"),
        ({"seed": "7"}, "seed: expected an integer"),
        ({"seed": -1}, "seed: expected an integer"),
        ({"episode": 2**31}, "episode: expected an integer"),
        ({"episode": 1.5}, "episode: expected an integer"),
        ({"rooms": [0, 2**31]}, "room: expected an integer"),
        ({"settings": {"f": print}}, "expected JSON values"),
        ({"settings": {"f": float("nan")}}, "expected JSON values"),
        ({"settings": [1]}, "parameters: expected an object"),
    ],
)
def test_other_origins_are_refused(tmp_path, walk, words):
    with pytest.raises(InputError, match=words):
        write(tmp_path, record(), **walk)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("unchecked")
def test_a_record_without_a_field_is_refused(tmp_path):
    writer = episodes.Writer(tmp_path, SETTINGS)
    with pytest.raises(InputError, match="episodes position: expected an array"):
        writer.write(SimpleNamespace(time=np.zeros((2, 20))), episode=0, rooms=[0, 1], seed=0)  # pyright: ignore
