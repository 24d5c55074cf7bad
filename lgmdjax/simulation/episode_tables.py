"""Tables of recorded walks: their columns, and the values that are allowed (`lgmdjax.simulation.episodes`)."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from lgmdjax.errors import InputError
from lgmdjax.runtime import checksums, schema
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield
from lgmdjax.simulation import finite
from lgmdjax.simulation.closed_loop import Record

MAX_ROWS = 10_000_000  # of a chunk: four hours of 23 robots
MAX_NUMBER = 1e6  # in any unit: far beyond what a robot measures


@dataclass(frozen=True)
class Field:
    """Names of the columns that hold one field of `Record`, their unit and meaning, and the kind of their numbers."""

    columns: tuple[str, ...]
    unit: str = ""
    kind: str = "f"  # of NumPy's dtype: float, integer, boolean
    meaning: str = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the field in one frame."""
        return (6, 3) if len(self.columns) == 18 else (len(self.columns),) if len(self.columns) > 1 else ()


def _both(name: str) -> tuple[str, ...]:
    """Return the names of the columns of both sides."""
    return tuple(f"{name}_{side}" for side in hemifield.SIDES)


FIELDS: Mapping[str, Field] = {
    "time": Field(("time",), "s", meaning="since the start of the walk"),
    "position": Field(("x", "y", "z"), "m", meaning="of the trunk, from which the pictures were rendered"),
    "quaternion": Field(("qw", "qx", "qy", "qz"), "1", meaning="attitude of the trunk, w x y z"),
    "joints": Field(tuple(f"joint_{j}" for j in range(18)), "rad", meaning="coxa, femur, tibia of legs 0 to 5"),
    "u": Field(_both("u"), "1", meaning="output of each eye's LGMD, 0.5 to 1"),
    "feed_forward": Field(_both("feed_forward"), "grey", meaning="output of the FF cell"),
    "excitation": Field(
        _both("excitation"),
        "grey",
        meaning="mean excitation, before feed-forward inhibition",
    ),
    "distances": Field(_both("distance"), "m", meaning="nearest obstacle in each hemifield"),
    "corridor": Field(
        _both("corridor"),
        "m",
        meaning="nearest obstacle in the way, on either side",
    ),
    "label": Field(_both("label"), "0.05 m/s", meaning="velocity that the teacher commands"),
    "velocity": Field(_both("velocity"), "0.05 m/s", meaning="velocity that the policy commands"),
    "clearance": Field(("clearance",), "m", meaning="smallest distance to anything within the frame"),
    "contact": Field(("contact",), kind="b", meaning="whether the clearance was 0 or less"),
    "is_first": Field(("is_first",), kind="b", meaning="first frame after a start or reset"),
    "resets": Field(("resets",), kind="i", meaning="resets so far"),
    "ok": Field(("ok",), kind="b", meaning="upright and finite"),
}
"""The columns of each field of `Record`, in its order."""

ORIGIN = {"episode": np.int32, "robot": np.int32, "room": np.int32, "seed": np.int64}
"""The columns that tell which walk a row belongs to."""
COLUMNS = (*ORIGIN, *(column for field in FIELDS.values() for column in field.columns))
ORIGIN_MEANINGS = {
    "episode": "number of the batch of walks",
    "robot": "number of the robot in its batch",
    "room": "number of the room",
    "seed": "seed of the rooms",
}
UNITS = {column: field.unit for field in FIELDS.values() for column in field.columns if field.unit}
MEANINGS = ORIGIN_MEANINGS | {column: field.meaning for field in FIELDS.values() for column in field.columns}
KINDS = dict.fromkeys(ORIGIN, "i") | {column: field.kind for field in FIELDS.values() for column in field.columns}
IS_KIND = {
    "f": lambda dtype: pa.types.is_float32(dtype) or pa.types.is_float64(dtype),
    "i": pa.types.is_integer,
    "b": pa.types.is_boolean,
}
KIND_NAMES = {"f": "floats", "i": "integers", "b": "booleans"}
INDEX, SEED = schema.Integer(0, 2**31 - 1), schema.Integer(0, 2**63 - 1)


def from_record(record: Record, episode: int, rooms: Sequence[int], seed: int) -> pa.Table:
    """Return the columns of a record; raise `InputError` if its shapes, types or numbers do not fit."""
    arrays = _checked_arrays(record)
    robots, frames = arrays["time"].shape
    schema.check(INDEX, episode, "episodes: episode", "number them from 0")
    schema.check(SEED, seed, "episodes: seed", "choose another")
    if len(rooms) != robots:
        raise InputError(f"episodes: expected a room for each of {robots} robots, got {len(rooms)}")
    for room in rooms:
        schema.check(INDEX, room, "episodes: room", "number them from 0")
    robot, room = np.arange(robots), np.asarray(rooms)
    origin = {"episode": episode, "robot": np.repeat(robot, frames), "room": np.repeat(room, frames), "seed": seed}
    columns = {name: np.broadcast_to(origin[name], robots * frames).astype(ORIGIN[name]) for name in ORIGIN}
    arrays = finite.require_finite(Record(**arrays), "episodes")
    for name, field in FIELDS.items():
        values = np.reshape(getattr(arrays, name), (robots * frames, len(field.columns)))
        columns |= {column: values[:, k] for k, column in enumerate(field.columns)}
    return pa.table(columns)


def pandas_attributes() -> dict[str, str]:
    """Return the entry of a Parquet file's metadata that pandas reads into `DataFrame.attrs`: units and meanings."""
    return {"PANDAS_ATTRS": json.dumps({"units": UNITS, "meanings": MEANINGS})}


def check(table: pa.Table, path: Path) -> pa.Table:
    """Return the columns of a walk's table; raise `InputError` for missing columns, other types, and wrong numbers."""
    names = table.column_names
    if missing := set(COLUMNS) - set(names):
        raise InputError(f"{path}: expected all columns, got none called {min(missing)}; collect it again")
    if len(set(names)) < len(names) or not 0 < table.num_rows <= MAX_ROWS:
        raise InputError(
            f"{path}: expected 1 to {MAX_ROWS} rows and every column once, got {table.num_rows} rows of {names}"[:300]
            + "; collect it again"
        )
    for name in COLUMNS:
        column, kind = table[name], KINDS[name]
        if not IS_KIND[kind](column.type) or column.null_count:
            found = f"{column.type}{f' with {column.null_count} nulls' if column.null_count else ''}"
            raise InputError(f"{path}: expected {KIND_NAMES[kind]} in column {name}, got {found}; collect it again")
    return _with_finite_numbers(table.select(COLUMNS), path)


def digest(table: pa.Table, header: JsonObject) -> str:
    """Return the checksum of a table and of its header, except the header's own checksum."""
    rest = {name: value for name, value in header.items() if name != checksums.CHECKSUM_KEY}
    columns = [(name, str(table[name].type), table[name].to_numpy().tobytes()) for name in table.column_names]
    return checksums.digest(repr((json.dumps(rest, sort_keys=True), columns)).encode())


def _checked_arrays(record: Record) -> dict[str, np.ndarray]:
    """Return the fields of a record as arrays of axes (robot, frame, ...)."""
    arrays: dict[str, np.ndarray] = {}
    for name, field in FIELDS.items():
        try:
            values = np.asarray(getattr(record, name))
        except (AttributeError, ValueError) as error:
            raise InputError(f"episodes {name}: expected an array, got {error}; see Record") from error
        axes = arrays["time"].shape if arrays else values.shape
        if len(axes) != 2 or not all(axes) or values.shape != (*axes, *field.shape):
            numbers = len(field.columns)
            raise InputError(
                f"episodes {name}: expected {numbers} numbers a frame for {' robots and '.join(map(str, axes[:2]))} "
                f"frames, got shape {values.shape}; see Record"
            )
        kinds = "iu" if field.kind == "i" else field.kind
        if values.dtype.kind not in kinds or (field.kind == "f" and values.dtype.itemsize not in (4, 8)):
            raise InputError(f"episodes {name}: expected {KIND_NAMES[field.kind]}, got {values.dtype}; see Record")
        arrays[name] = values
    return arrays


def _with_finite_numbers(table: pa.Table, path: Path) -> pa.Table:
    """Return a table without nan; raise `InputError` for nan in a frame that is ok. Older files have it in others."""
    ok = table["ok"].to_numpy()
    for name, kind in KINDS.items():
        values = table[name].to_numpy()
        sane = np.abs(values) <= MAX_NUMBER if kind == "f" else values >= 0
        if kind == "b" or sane.all():
            continue
        if np.any(~sane & (ok | (kind == "i"))):
            row = int(np.argmax(~sane & (ok | (kind == "i"))))
            raise InputError(
                f"{path}: expected numbers up to {MAX_NUMBER:g} in frames that are ok, got {name} {values[row]} "
                f"of robot {table['robot'][row]} in row {row}; collect it again"
            )
        table = table.set_column(table.column_names.index(name), name, pa.array(np.where(sane, values, 0)))
    return table
