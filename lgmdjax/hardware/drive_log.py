"""The log of a drive: Parquet files with one row for each step of the servo loop, and units in every file.

| column                            | unit    | what                                                        |
| --------------------------------- | ------- | ----------------------------------------------------------- |
| time                              | s       | since the start, in the robot's time                        |
| mode, reason                      | -       | of the supervisor; reason is empty until the robot sits     |
| frame, frame_age                  | -, s    | number of the newest pictures, and how old they are         |
| u_*, velocity_*                   | 1, 0.05 m/s | of LGMDs and navigator, for the newest pictures         |
| target_0 .. target_17             | rad     | set points that were sent                                   |
| joint_0 .. joint_17               | rad     | positions that were read last                               |
| load_*, temperature_*             | 1, degC | likewise, by joint; loads are fractions of the stall torque |
| voltage                           | V       | median over the servos                                      |
| bus_failures, stops               | -       | answers missed so far, requests to stop                     |

Joints are in the order of `joint_map.JOINT_NAMES`. Rows are written in chunks of `CHUNK_ROWS`. The
file of a chunk gets its final name when it is complete, so a process that is killed loses only its last chunk.
"""

import json
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import partial_files, schema, versions
from lgmdjax.runtime.storage import JsonObject

FORMAT, VERSION = "lgmdjax drive", 1
CHUNK_ROWS = 2000
SIDES = ("left", "right")
JOINTS = 18
UNITS: Mapping[str, str] = {
    **{"time": "s", "mode": "", "reason": "", "frame": "", "frame_age": "s"},
    **{f"u_{side}": "1" for side in SIDES},
    **{f"velocity_{side}": "0.05 m/s" for side in SIDES},
    **{f"target_{joint}": "rad" for joint in range(JOINTS)},
    **{f"joint_{joint}": "rad" for joint in range(JOINTS)},
    **{f"load_{joint}": "1" for joint in range(JOINTS)},
    **{f"temperature_{joint}": "degC" for joint in range(JOINTS)},
    **{"voltage": "V", "bus_failures": "", "stops": ""},
}
"""Columns and their units."""
TEXTS = ("mode", "reason")
"""Columns of text; all others hold numbers. Both may be null."""
HEADER = schema.Object({"format": schema.Text((FORMAT,)), "version": schema.Integer(VERSION, VERSION)})

Row = dict[str, float | int | str | None]


class Writer:
    """Writes rows into a folder of its own; use it in a `with` block.

    Args:
        folder: created if it is missing; it must be empty.
        facts: JSON values for the header.
    """

    def __init__(self, folder: Path, facts: JsonObject):
        partial_files.require_empty(folder)
        partial_files.require_utf8(folder)
        try:
            partial_files.make_folder(folder)
        except OSError as error:
            raise partial_files.not_writable(folder, error) from error
        self.folder, self._rows, self._chunks = folder, list[Row](), 0
        header = {"format": FORMAT, "version": VERSION, "units": UNITS, "facts": facts}
        self._metadata = {"lgmdjax": json.dumps(header | {"versions": versions.installed()})}
        self._thread, self._written = ThreadPoolExecutor(1), list[Future[None]]()

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()
        self._thread.shutdown()
        for written in self._written:
            written.result()  # raises the exception of the thread, if any

    def add(self, row: Row) -> None:
        """Add a row; a full chunk is written on another thread, so that the robot does not wait for the disk."""
        self._rows.append(row)
        if len(self._rows) >= CHUNK_ROWS:
            self.flush()

    def flush(self) -> None:
        """Start to write the rows that are not written yet."""
        if self._rows:
            path = self.folder / f"drive-{self._chunks:05d}.parquet"
            self._written.append(self._thread.submit(_write, path, self._rows, self._metadata))
            self._rows, self._chunks = [], self._chunks + 1


def _write(path: Path, rows: list[Row], metadata: dict[str, str]) -> None:
    """Write a chunk, whole or not at all."""
    table = pa.table({name: [row.get(name) for row in rows] for name in UNITS}, metadata=metadata)
    with partial_files.replacing(path) as partial:
        pq.write_table(table, partial, compression="zstd", write_page_checksum=True)


def read(folder: Path) -> pa.Table:
    """Return the log of a drive as one table; raise `InputError` for a folder without one.

    ```python
    log = lj.hardware.drive_log.read(Path("runs/drive/first"))
    log["voltage"].to_numpy()
    ```
    """
    files = sorted(folder.glob("drive-*.parquet"))
    if not files:
        raise InputError(f"{folder}: expected the log of a drive, got no drive-*.parquet; `lgmdjax drive` writes one")
    tables = [_load(path) for path in files]
    try:
        return pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise InputError(f"{folder}: expected chunks of one log, got {one_line(error)[:200]}; separate them") from error


def _load(path: Path) -> pa.Table:
    """Return the checked table of a chunk."""
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            if file.metadata.num_rows > CHUNK_ROWS:  # before memory is allocated
                raise ValueError(f"{file.metadata.num_rows} rows")
            table = file.read()
        header = json.loads((table.schema.metadata or {}).get(b"lgmdjax", b"{}"))
    except Exception as error:  # whatever a damaged file makes Arrow and json raise
        raise InputError(f"{path}: expected a whole Parquet file, got {one_line(error)[:200]}; remove it") from error
    schema.check(HEADER, header, f"{path}: header of a drive's log", "move it")
    names = table.column_names
    if missing := [name for name in UNITS if names.count(name) != 1]:
        raise InputError(f"{path}: expected every column once, got {names.count(missing[0])} of {missing[0]}; move it")
    for name in UNITS:
        found = table[name].type
        is_expected = pa.types.is_string if name in TEXTS else _is_number
        if not (is_expected(found) or pa.types.is_null(found)):
            raise InputError(
                f"{path}: expected {'text' if name in TEXTS else 'numbers'} in {name}, got {found}; move it"
            )
    return table.select(list(UNITS))


def _is_number(found: pa.DataType) -> bool:
    return pa.types.is_integer(found) or pa.types.is_float32(found) or pa.types.is_float64(found)


def joints(table: pa.Table, name: str) -> np.ndarray:
    """Return a quantity of all joints, (rows, 18); NaN where it is unknown."""
    columns = [table[f"{name}_{joint}"].cast(pa.float64()).to_numpy() for joint in range(JOINTS)]
    return np.stack(columns, axis=1)
