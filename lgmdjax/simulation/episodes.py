"""Recorded walks on disk: Parquet, one row a frame, with units, parameters and versions in every file.

| column                        | unit     | what                                                        |
| ----------------------------- | -------- | ----------------------------------------------------------- |
| episode, robot, room, seed    | -        | which walk: of a batch, of which robot, in which room       |
| time                          | s        | since the start of the walk                                 |
| x, y, z, qw, qx, qy, qz       | m, 1     | pose of the trunk, from which the pictures were drawn       |
| joint_0 .. joint_17           | rad      | coxa, femur, tibia of legs 0..5                             |
| u_*, feed_forward_*           | 1, grey  | what the LGMD of the left and the right eye says            |
| excitation_*                  | grey     | what u would be told by, were there no gate                 |
| distance_*                    | m        | nearest thing in the left and the right hemifield           |
| label_*, velocity_*           | nominal  | what the teacher says, and what the robot was told          |
| clearance, contact            | m, -     | least clearance within the frame, and whether it was none   |
| fresh, setbacks, ok           | -        | just put down, how often so far, sound                      |

Pictures are not stored: `lgmdjax.simulation.rerender` draws them again from the poses. A walk is written in chunks,
each a file that is complete before it gets its name, so that a kill at any moment loses the running chunk at most.
Numbers keep the precision in which they came.

Source: Cizek & Faigl, sec. 4.2 and 5.1: the training data are stretches of collision-free walking.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Int

from lgmdjax.errors import InputError
from lgmdjax.runtime import versions
from lgmdjax.simulation.closed_loop import Record

FORMAT, VERSION = "lgmdjax episodes", 1
SIDES = ("left", "right")


@dataclass(frozen=True)
class Field:
    """How one field of a frame becomes columns."""

    columns: tuple[str, ...]
    unit: str = ""


FIELDS: Mapping[str, Field] = {
    "time": Field(("time",), "s"),
    "position": Field(("x", "y", "z"), "m"),
    "quaternion": Field(("qw", "qx", "qy", "qz"), "1"),
    "joints": Field(tuple(f"joint_{j}" for j in range(18)), "rad"),
    "u": Field(tuple(f"u_{side}" for side in SIDES), "1"),
    "feed_forward": Field(tuple(f"feed_forward_{side}" for side in SIDES), "grey"),
    "excitation": Field(tuple(f"excitation_{side}" for side in SIDES), "grey"),
    "distances": Field(tuple(f"distance_{side}" for side in SIDES), "m"),
    "label": Field(tuple(f"label_{side}" for side in SIDES), "0.05 m/s"),
    "velocity": Field(tuple(f"velocity_{side}" for side in SIDES), "0.05 m/s"),
    "clearance": Field(("clearance",), "m"),
    "contact": Field(("contact",)),
    "fresh": Field(("fresh",)),
    "setbacks": Field(("setbacks",)),
    "ok": Field(("ok",)),
}
WALK = ("episode", "robot", "room", "seed")
COLUMNS = (*WALK, *(column for field in FIELDS.values() for column in field.columns))


@dataclass(frozen=True, kw_only=True)
class Walk:
    """Frames of one robot in one room, in order, each array with the frames first."""

    episode: int
    robot: int
    room: int
    seed: int
    time: Float[np.ndarray, "frames"]
    position: Float[np.ndarray, "frames 3"]
    quaternion: Float[np.ndarray, "frames 4"]
    joints: Float[np.ndarray, "frames 6 3"]
    u: Float[np.ndarray, "frames 2"]
    feed_forward: Float[np.ndarray, "frames 2"]
    excitation: Float[np.ndarray, "frames 2"]
    distances: Float[np.ndarray, "frames 2"]
    label: Float[np.ndarray, "frames 2"]
    velocity: Float[np.ndarray, "frames 2"]
    clearance: Float[np.ndarray, "frames"]
    contact: Bool[np.ndarray, "frames"]
    fresh: Bool[np.ndarray, "frames"]
    setbacks: Int[np.ndarray, "frames"]
    ok: Bool[np.ndarray, "frames"]

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, frames: slice) -> "Walk":
        """Cut out some frames."""
        cut = {name: getattr(self, name)[frames] for name in FIELDS}
        return Walk(episode=self.episode, robot=self.robot, room=self.room, seed=self.seed, **cut)


class Writer:
    """Writes walks into a folder, a file a chunk; carries on after the chunks that are already there.

    Args:
        folder: made if it is not there.
        parameters: JSON values that the walks were made with; chunks of other parameters are refused.
    """

    def __init__(self, folder: Path | str, parameters: Mapping[str, Any]):
        self.folder = Path(folder)
        self.parameters = json.loads(json.dumps(dict(parameters)))
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for abandoned in self.folder.glob("*.part"):
                abandoned.unlink()
        except OSError as error:
            raise InputError(f"{folder}: expected a folder to write to, got {error}; choose another") from error
        self.chunks = len(_files(self.folder)) and len(_tables(self.folder, self.parameters))

    def write(self, record: Any, *, episode: int, rooms: Sequence[int], seed: int) -> Path:
        """Write one chunk of a batch of walks: fields of `FIELDS` as arrays with axes (robot, frame, ...).

        `record` is a mapping or an object with those names (`simulation.Record`); `rooms` has a room a robot.
        """
        table = _table(record, episode, rooms, seed)
        path = self.folder / f"chunk-{self.chunks:05d}.parquet"
        partial = path.with_suffix(".part")
        try:
            table = table.replace_schema_metadata(self._metadata())
            pq.write_table(table, partial, compression="zstd", write_page_checksum=True)
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError as error:
            raise InputError(f"{path}: expected to write a chunk, got {error}; free some disk") from error
        self.chunks += 1
        return path

    def _metadata(self) -> dict[str, str]:
        units = {column: field.unit for field in FIELDS.values() for column in field.columns if field.unit}
        header = {
            "format": FORMAT,
            "version": VERSION,
            "units": units,
            "parameters": self.parameters,
            "versions": versions.installed(),
        }
        return {"lgmdjax": json.dumps(header)}


def read(folder: Path | str, parameters: Mapping[str, Any] | None = None) -> list[Walk]:
    """Read all walks of a folder, by episode and robot; raise `InputError` for damaged or mixed files.

    Args:
        folder: where a `Writer` wrote.
        parameters: what the walks must have been made with, if that matters.
    """
    tables = _tables(Path(folder), parameters)
    if not tables:
        raise InputError(f"{folder}: expected recorded walks, got no chunk-*.parquet; `lgmdjax collect` makes some")
    try:
        table = pa.concat_tables(tables)
    except pa.ArrowException as error:
        raise InputError(f"{folder}: expected chunks of one precision, got mixed ones; collect again") from error
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    # Stable, so that the frames of a walk stay in the order of the chunks.
    order = np.lexsort((columns["robot"], columns["episode"]))
    columns = {name: values[order] for name, values in columns.items()}
    changes = (np.diff(columns["episode"]) != 0) | (np.diff(columns["robot"]) != 0)
    return [_walk(columns, slice(*span)) for span in _spans(changes)]


def parameters(folder: Path | str) -> dict[str, Any]:
    """Read what the walks of a folder were made with; nothing if there are none."""
    files = _files(Path(folder))
    return _header(files[0])["parameters"] if files else {}


def batched(walks: Sequence[Walk]) -> Record:
    """Put walks of equal length together again as one record with axes (robot, frame)."""
    return Record(**{name: np.stack([getattr(walk, name) for walk in walks]) for name in FIELDS})


def stretches(walks: Sequence[Walk], minimum: int = 90, settle: int = 2) -> list[Walk]:
    """Cut walks into stretches of sound, collision-free, uninterrupted walking.

    Args:
        walks: whole walks.
        minimum: frames that a stretch must have.
        settle: frames dropped after the robot was put down: the eyes first need two pictures to compare.
    """
    return [stretch for walk in walks for stretch in _stretches(walk, settle) if len(stretch) >= max(minimum, 1)]


def _stretches(walk: Walk, settle: int) -> Iterator[Walk]:
    good = walk.ok & ~walk.contact
    period = np.median(np.diff(walk.time)) if len(walk) > 1 else 0.0
    gap = np.diff(walk.time) > 1.5 * period
    changes = (np.diff(good) != 0) | (np.diff(walk.setbacks) != 0) | gap
    for first, last in _spans(changes):
        if good[first]:
            put_down = first == 0 or walk.fresh[first]
            yield walk[first + settle * put_down : last]


def _spans(changes: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield (first, end) of the runs between changes; `changes[k]` says that k + 1 differs from k."""
    bounds = [0, *(np.flatnonzero(changes) + 1).tolist(), len(changes) + 1]
    yield from pairwise(bounds)


def _table(record: Any, episode: int, rooms: Sequence[int], seed: int) -> pa.Table:
    fields = record if isinstance(record, Mapping) else vars(record)
    robots, frames = np.shape(fields["time"])
    if len(rooms) != robots:
        raise InputError(f"episodes: expected a room for each of {robots} robots, got {len(rooms)}")
    columns = {
        "episode": np.full(robots * frames, episode, np.int32),
        "robot": np.repeat(np.arange(robots, dtype=np.int32), frames),
        "room": np.repeat(np.asarray(rooms, np.int32), frames),
        "seed": np.full(robots * frames, seed, np.int64),
    }
    for name, field in FIELDS.items():
        values = np.asarray(fields[name])
        if values.size != robots * frames * len(field.columns):
            raise InputError(
                f"episodes {name}: expected {len(field.columns)} numbers a frame for {robots} robots and "
                f"{frames} frames, got shape {values.shape}"
            )
        values = values.reshape(robots * frames, len(field.columns))
        columns |= {column: values[:, k] for k, column in enumerate(field.columns)}
    return pa.table(columns)


def _walk(columns: Mapping[str, np.ndarray], frames: slice) -> Walk:
    walk: dict[str, Any] = {name: int(columns[name][frames][0]) for name in WALK}
    fields = {name: [columns[column][frames] for column in field.columns] for name, field in FIELDS.items()}
    arrays: dict[str, Any] = {
        name: np.stack(cols, axis=1) if len(cols) > 1 else cols[0] for name, cols in fields.items()
    }
    arrays["joints"] = arrays["joints"].reshape(-1, 6, 3)
    return Walk(**walk, **arrays)


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob("chunk-*.parquet"))


def _tables(folder: Path, parameters: Mapping[str, Any] | None) -> list[pa.Table]:
    """Read and check every chunk, in order."""
    tables = []
    expected = None if parameters is None else json.loads(json.dumps(dict(parameters)))
    for number, path in enumerate(_files(folder)):
        if path.name != f"chunk-{number:05d}.parquet":
            raise InputError(f"{folder}: expected chunk-{number:05d}.parquet, got {path.name}; a chunk is missing")
        found = _header(path)["parameters"]
        expected = found if expected is None else expected
        if found != expected:
            raise InputError(
                f"{path}: expected walks of the same settings, got {_differences(expected, found)}; use another folder"
            )
        tables.append(_read(path))
    return tables


def _header(path: Path) -> dict[str, Any]:
    """Read and check what a chunk says about itself."""
    try:
        text = (pq.read_schema(path).metadata or {}).get(b"lgmdjax")
    except (OSError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    header = json.loads(text) if text else {}
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: expected recorded walks, got Parquet of another kind; move it elsewhere")
    if header.get("version") != VERSION:
        raise InputError(
            f"{path}: expected walks of version {VERSION}, got {header.get('version')}; collect them again"
        )
    return header


def _read(path: Path) -> pa.Table:
    try:
        table = pq.read_table(path, page_checksum_verification=True)
    except (OSError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    if missing := set(COLUMNS) - set(table.column_names):
        raise InputError(f"{path}: expected all columns, got none called {min(missing)}; collect it again")
    return table.select(COLUMNS)


def _damaged(path: Path, error: Exception) -> InputError:
    line = str(error).split("\n")[0]
    return InputError(f"{path}: expected a whole Parquet file, got: {line}; remove it, or collect it again")


def _differences(expected: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Name what differs between two sets of parameters, in one line."""
    names = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
    return ", ".join(f"{name} {found.get(name)} for {expected.get(name)}" for name in names)
