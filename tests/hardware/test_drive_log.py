"""The log of a drive: read as it was written; anything else is one line."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lgmdjax.errors import InputError
from lgmdjax.hardware import drive_log


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A log of two rows, the second without readings."""
    with drive_log.Writer(tmp_path / "log", {"robot": "mine"}) as log:
        log.add({"time": 0.0, "mode": "walk", **{f"joint_{joint}": 0.1 * joint for joint in range(18)}})
        log.flush()
        log.add({"time": 0.1, "mode": "sit", "reason": "stopped"})
    return tmp_path / "log"


def test_it_is_read_as_it_was_written(folder: Path) -> None:
    log = drive_log.read(folder)
    assert log["mode"].to_pylist() == ["walk", "sit"] and log["reason"].to_pylist() == [None, "stopped"]
    np.testing.assert_array_equal(drive_log.joints(log, "joint")[0], 0.1 * np.arange(18))
    assert np.isnan(drive_log.joints(log, "joint")[1]).all()


HEADERS = [b"{", b"[1]", b'"lgmdjax drive"', b'{"format": "lgmdjax drive", "version": "1"}', b'{"format": 1}']


@pytest.mark.parametrize("header", HEADERS, ids=range(len(HEADERS)))
def test_another_header_is_one_line(folder: Path, header: bytes) -> None:
    path = folder / "drive-00000.parquet"
    pq.write_table(pq.read_table(path).replace_schema_metadata({"lgmdjax": header}), path)
    with pytest.raises(InputError, match="expected"):
        drive_log.read(folder)


@pytest.mark.parametrize(
    ("column", "values", "words"),
    [
        ("voltage", None, "expected every column once, got 0 of voltage"),
        ("voltage", ["12"], "expected numbers in voltage, got string"),
        ("joint_3", [[0.1]], "expected numbers in joint_3, got list"),
        ("mode", [3], "expected text in mode, got int64"),
        ("time", [0.0] * (drive_log.CHUNK_ROWS + 1), "rows"),
    ],
)
def test_other_columns_are_one_line(folder: Path, column: str, values: list | None, words: str) -> None:
    path = folder / "drive-00000.parquet"
    table = pq.read_table(path)
    if values is not None and len(values) > 1:
        table = pa.concat_tables([table] * len(values))
    elif values is not None:
        table = table.set_column(table.column_names.index(column), column, pa.array(values))
    else:
        table = table.drop_columns(column)
    pq.write_table(table, path)
    with pytest.raises(InputError, match=words):
        drive_log.read(folder)


def test_a_damaged_page_is_noticed(folder: Path) -> None:
    path = folder / "drive-00000.parquet"
    content = bytearray(path.read_bytes())
    first = pq.ParquetFile(path).metadata.row_group(0).column(0)
    content[first.data_page_offset + first.total_compressed_size - 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="expected a whole Parquet file"):
        drive_log.read(folder)


def test_the_header_has_units(folder: Path) -> None:
    header = json.loads(pq.read_schema(folder / "drive-00000.parquet").metadata[b"lgmdjax"])
    assert header["units"]["voltage"] == "V" and header["facts"] == {"robot": "mine"}
