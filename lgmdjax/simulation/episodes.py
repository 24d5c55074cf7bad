"""Recorded walks on disk: Parquet, one row for each frame, with units, parameters and versions in every file.

A walk is the recorded trajectory of one robot in one room.

| column                        | unit     | what                                                        |
| ----------------------------- | -------- | ----------------------------------------------------------- |
| episode, robot, room, seed    | -        | which walk: index of batch and robot, room and its seed     |
| time                          | s        | since the start of the walk                                 |
| x, y, z, qw, qx, qy, qz       | m, 1     | pose of the trunk, from which the pictures were rendered    |
| joint_0 .. joint_17           | rad      | coxa, femur, tibia of legs 0..5                             |
| u_*, feed_forward_*           | 1, grey  | outputs of the LGMD of the left and the right eye           |
| excitation_*                  | grey     | mean excitation of the LGMD, before feed-forward inhibition |
| distance_*                    | m        | nearest obstacle in the left and the right hemifield        |
| corridor_*                    | m        | nearest obstacle in the way, on either side                 |
| label_*, velocity_*           | nominal  | velocity of the teacher, and velocity of the policy         |
| clearance, contact            | m, -     | smallest clearance within the frame, and whether it was <= 0 |
| is_first, resets, ok          | -        | first frame after a start or reset, resets so far, healthy  |

Pictures are not stored: `lgmdjax.simulation.rerender` renders them again from the poses. A walk is written in chunks.
Each chunk is a file that gets its name when it is complete, so that an interruption loses only the present chunk. It
may be an object of a store instead, with a pointer in the folder (`lgmdjax.runtime.object_store`).
Numbers keep their precision. The header has a checksum of the columns and of itself; files of earlier versions have
none. A file is refused if it has other columns or types, missing or infinite numbers in frames that are ok, time that
does not increase, or a walk in two rooms.

Version 1 called the columns `is_first` and `resets` "fresh" and "setbacks"; versions 1 and 2 lack `corridor_*`, for
which `distance_*` is read. Both can still be read.

Source: Cizek & Faigl, sec. 4.2 and 5.1: the training data are segments of collision-free walking.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from flax import struct

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import checksums, distributed, object_store, partial_files, schema, versions
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield
from lgmdjax.simulation import episode_tables, finite
from lgmdjax.simulation.closed_loop import Record
from lgmdjax.simulation.episode_tables import COLUMNS as COLUMNS
from lgmdjax.simulation.episode_tables import FIELDS as FIELDS
from lgmdjax.simulation.episode_tables import ORIGIN

FORMAT, VERSION = "lgmdjax episodes", 3
RENAMED = {1: {"fresh": "is_first", "setbacks": "resets"}, 2: {}, VERSION: {}}
"""Versions that can be read, each with its former names of columns and their present names."""
NEAREST_ONLY = (1, 2)
"""Versions without distances along the corridor: their teacher reacted to the nearest distances."""

PARQUET: Mapping[str, Any] = {"compression": "zstd", "write_page_checksum": True}
"""How a chunk is written."""

HEADER = schema.Object(
    {"format": schema.Text((FORMAT,)), "parameters": schema.Object()},
    {checksums.CHECKSUM_KEY: schema.Text(), "units": schema.Object(), "versions": schema.Object()},
)
"""Schema of the header of a chunk, without its version."""


@struct.dataclass(kw_only=True)
class Walk(Record):
    """Recorded trajectory of one robot in one room: a `Record` with axis (frame) of NumPy arrays, and its origin."""

    episode: int = struct.field(pytree_node=False)
    robot: int = struct.field(pytree_node=False)
    room: int = struct.field(pytree_node=False)
    seed: int = struct.field(pytree_node=False)

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, frames: slice) -> "Walk":
        """Return a slice of the frames."""
        return jax.tree.map(lambda leaf: leaf[frames], self)


class Writer:
    """Writes walks into a folder, one file for each chunk, after or between the chunks that are already there.

    Of several processes (`lgmdjax.runtime.distributed`) only the first looks at those that are there.

    Args:
        folder: created if missing.
        parameters: JSON values that identify the rollout; chunks of other parameters are refused.
    """

    def __init__(self, folder: Path | str, parameters: JsonObject):
        self.folder = Path(folder)
        try:
            self.parameters = json.loads(json.dumps(parameters, allow_nan=False))
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(f"episodes parameters: expected JSON values, got {error}; convert them") from error
        schema.check(schema.Object(), self.parameters, "episodes parameters", "name them")
        partial_files.require_utf8(self.folder)
        try:
            partial_files.make_folder(self.folder)
            if distributed.is_first():
                partial_files.remove_partial_files(self.folder)
        except OSError as error:
            raise InputError(f"{folder}: expected a folder to write to, got {error}; choose another") from error
        if distributed.is_first():
            _tables(self.folder, self.parameters, may_lack_chunks=True)
        self.chunks = max(_numbers(self.folder), default=-1) + 1

    def missing(self, total: int) -> list[int]:
        """Return the numbers below `total` of the chunks that the folder does not have."""
        return sorted(set(range(total)) - set(_numbers(self.folder)))

    def write(
        self, record: Record, *, episode: int, rooms: Sequence[int], seed: int, number: int | None = None
    ) -> Path:
        """Write one chunk of a batch of walks; return its path, or that of its pointer if it goes to an object store.

        Args:
            record: axes (robot, frame), finite in all frames that are ok.
            episode: index of the batch.
            rooms: index of the room of each robot.
            seed: seed of the rooms.
            number: of the chunk; the next one if None.
        """
        table = episode_tables.from_record(record, episode, rooms, seed)
        number = self.chunks if number is None else number
        path = self.folder / f"chunk-{number:05d}.parquet"
        table = table.replace_schema_metadata(self._metadata(table))
        url = object_store.url_of(path)
        if url:
            path = path.with_suffix(object_store.POINTER_SUFFIX)
            object_store.write(url, _encode(table), path)
        else:
            try:
                with partial_files.replacing(path) as partial:
                    pq.write_table(table, partial, **PARQUET)
            except OSError as error:
                raise InputError(f"{path}: expected to write a chunk, got {error}; free some disk") from error
        self.chunks = max(self.chunks, number + 1)
        return path

    def _metadata(self, table: pa.Table) -> dict[str, str]:
        header = {
            "format": FORMAT,
            "version": VERSION,
            "units": episode_tables.UNITS,
            "parameters": self.parameters,
            "versions": versions.installed(),
        }
        return {
            "lgmdjax": json.dumps(header | {checksums.CHECKSUM_KEY: episode_tables.digest(table, header)}),
            **episode_tables.pandas_attributes(),
        }


def read(folder: Path | str, parameters: JsonObject | None = None) -> list[Walk]:
    """Return all walks of a folder, by episode and robot; raise `InputError` for damaged or mixed files.

    Args:
        folder: of a `Writer`.
        parameters: required parameters of the walks; any if None.
    """
    tables = _tables(Path(folder), parameters)
    if not tables:
        raise InputError(f"{folder}: expected recorded walks, got no chunk-*.parquet; `lgmdjax collect` makes some")
    try:
        table = pa.concat_tables(tables)
    except pa.ArrowException as error:
        raise InputError(f"{folder}: expected chunks of one precision, got mixed ones; collect again") from error
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    # The sort is stable: frames of a walk stay in the order of the chunks.
    order = np.lexsort((columns["robot"], columns["episode"]))
    columns = {name: values[order] for name, values in columns.items()}
    changes = (np.diff(columns["episode"]) != 0) | (np.diff(columns["robot"]) != 0)
    return [_walk(folder, {name: values[slice(*span)] for name, values in columns.items()}) for span in _runs(changes)]


def read_parameters(folder: Path | str) -> JsonObject:
    """Return the parameters of the walks in a folder; empty if there are none."""
    return read_header(folder).get("parameters", {})


def read_header(folder: Path | str) -> JsonObject:
    """Return the header of the first chunk in a folder: parameters, versions, units; empty if there is none."""
    files = _files(Path(folder))
    return _load(files[0])[0] if files else {}


def stack_walks(walks: Sequence[Walk]) -> Record:
    """Stack walks of equal length to one record with axes (robot, frame)."""
    return Record(**{name: np.stack([getattr(walk, name) for walk in walks]) for name in FIELDS})


def segments(walks: Sequence[Walk], min_frames: int = 90, settle_frames: int = 2) -> list[Walk]:
    """Cut walks into segments without contact, reset, fall or missing frames.

    Args:
        walks: whole walks.
        min_frames: minimum length of a segment.
        settle_frames: frames dropped after a start or reset, since the LGMDs first need two pictures to compare.
    """
    cut = (segment for walk in walks for segment in _segments(walk, settle_frames))
    return [segment for segment in cut if len(segment) >= max(min_frames, 1)]


def _segments(walk: Walk, settle_frames: int) -> Iterator[Walk]:
    good = walk.ok & ~walk.contact & finite.find_finite(walk)
    period = np.median(np.diff(walk.time)) if len(walk) > 1 else 0.0
    gap = np.diff(walk.time) > 1.5 * period
    changes = (np.diff(good) != 0) | (np.diff(walk.resets) != 0) | gap
    for first, end in _runs(changes):
        if good[first]:
            after_reset = first == 0 or walk.is_first[first]
            yield walk[first + settle_frames * after_reset : end]


def _runs(changes: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield (first, end) of the runs between changes; `changes[k]` is true where item k + 1 differs from item k."""
    bounds = [0, *(np.flatnonzero(changes) + 1).tolist(), len(changes) + 1]
    yield from pairwise(bounds)


def _walk(folder: Path | str, columns: Mapping[str, np.ndarray]) -> Walk:
    """Return the walk of some rows; raise `InputError` unless time increases and the room is the same."""
    episode, robot, room, seed = (int(columns[name][0]) for name in ORIGIN)
    backward, time = np.flatnonzero(~(np.diff(columns["time"]) > 0)), columns["time"]
    if len(backward) or np.ptp(columns["room"]) or np.ptp(columns["seed"]):
        found = f"time {time[backward[0] + 1]:g} after {time[backward[0]]:g}" if len(backward) else "several"
        raise InputError(
            f"{folder}: expected increasing time and one room of robot {robot} in episode {episode}, got {found}; "
            "is a chunk there twice? collect again"
        )
    arrays: dict[str, np.ndarray] = {}
    for name, field in FIELDS.items():
        values = [columns[column] for column in field.columns]
        arrays[name] = np.stack(values, axis=1) if len(values) > 1 else values[0]
    arrays["joints"] = arrays["joints"].reshape(-1, 6, 3)
    return Walk(episode=episode, robot=robot, room=room, seed=seed, **arrays)


def has_chunks(folder: Path) -> bool:
    """Tell whether a folder has recorded walks."""
    return bool(_files(folder))


def count_chunks(folder: Path) -> int:
    """Return the number of chunks in a folder."""
    return len(_files(folder))


def chunk_paths(folder: Path, numbers: Iterable[int]) -> list[Path]:
    """Return the paths that chunks of some numbers have in a folder: of their files, or of their pointers."""
    paths = [folder / f"chunk-{number:05d}.parquet" for number in numbers]
    return [path.with_suffix(object_store.POINTER_SUFFIX) if object_store.url_of(path) else path for path in paths]


def _files(folder: Path) -> list[Path]:
    """Return the files and pointers of all chunks, in order."""
    suffixes = (".parquet", object_store.POINTER_SUFFIX)
    return sorted((path for path in folder.glob("chunk-*") if path.suffix in suffixes), key=lambda path: path.stem)


def _numbers(folder: Path) -> list[int]:
    return [int(number) for path in _files(folder) if (number := path.stem.removeprefix("chunk-")).isdecimal()]


def _encode(table: pa.Table) -> bytes:
    """Return a table as the bytes of a Parquet file."""
    stream = pa.BufferOutputStream()
    pq.write_table(table, stream, **PARQUET)
    return stream.getvalue().to_pybytes()


def _tables(folder: Path, parameters: JsonObject | None, *, may_lack_chunks: bool = False) -> list[pa.Table]:
    """Return the checked tables of all chunks, in order."""
    tables = []
    expected = None if parameters is None else json.loads(json.dumps(parameters))
    for number, path in enumerate(_files(folder)):
        if path.stem != f"chunk-{number:05d}" and not may_lack_chunks:
            raise InputError(f"{folder}: expected chunk-{number:05d}.parquet, got {path.name}; a chunk is missing")
        header, table = _load(path)
        found = header["parameters"]
        expected = found if expected is None else expected
        if found != expected:
            raise InputError(
                f"{path}: expected walks of the same settings, got {_differences(expected, found)}; use another folder"
            )
        tables.append(_with_present_columns(table, header["version"], path))
    return tables


def _load(path: Path) -> tuple[JsonObject, pa.Table]:
    """Return the checked header and the table of a chunk."""
    try:
        is_pointer = path.suffix == object_store.POINTER_SUFFIX
        content = pa.BufferReader(object_store.read(path) if is_pointer else checksums.read_bytes(path))
        with pq.ParquetFile(content, page_checksum_verification=True) as file:
            header = _check_header(path, file.schema_arrow.metadata or {})
            if file.metadata.num_rows > episode_tables.MAX_ROWS:  # before memory is allocated
                raise checksums.ChecksumError(f"{file.metadata.num_rows} rows")
            table = file.read()
        if header.get(checksums.CHECKSUM_KEY) not in (None, episode_tables.digest(table, header)):
            raise checksums.ChecksumError("another checksum in its header")
    except InputError:
        raise
    except Exception as error:  # whatever a damaged file makes Arrow raise
        line = one_line(error)[:200]
        raise InputError(
            f"{path}: expected a whole Parquet file, got: {line}; remove it, or collect it again"
        ) from error
    return header, table


def _check_header(path: Path, metadata: Mapping[bytes, bytes]) -> JsonObject:
    """Return the header of a chunk; raise `InputError` for one of another kind or version."""
    try:
        header = json.loads(metadata.get(b"lgmdjax", b"{}"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected a header in JSON, got {one_line(error)}; collect it again") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(f"{path}: expected recorded walks, got Parquet of another kind; move it elsewhere")
    if not isinstance(header.get("version"), int) or header["version"] not in RENAMED:
        readable = " or ".join(map(str, RENAMED))
        raise InputError(
            f"{path}: expected walks of version {readable}, got {header.get('version')}; collect them again"
        )
    schema.check(HEADER, header, f"{path}: header", "collect it again")
    return header


def _with_present_columns(table: pa.Table, version: int, path: Path) -> pa.Table:
    """Return the columns of a chunk of some version, under their present names."""
    table = table.rename_columns([RENAMED[version].get(name, name) for name in table.column_names])
    if version in NEAREST_ONLY:
        for side in hemifield.SIDES:
            if f"distance_{side}" in table.column_names:
                table = table.append_column(f"corridor_{side}", table[f"distance_{side}"])
    return episode_tables.check(table, path)


def _differences(expected: JsonObject, found: JsonObject) -> str:
    """Return the differences of two sets of parameters as one line."""
    names = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
    return ", ".join(f"{name} {found.get(name)} for {expected.get(name)}" for name in names)
