"""Walks as one table, a row for each frame: Parquet with units in its metadata, CSV with a description beside it.

| file                    | contents                                                                        |
| ----------------------- | ------------------------------------------------------------------------------- |
| walks.parquet           | all frames; units in the metadata of fields, and in `DataFrame.attrs` of pandas |
| walks.csv               | all frames; a number has the digits that its precision needs                    |
| walks.csv-metadata.json | name, type, unit and meaning of each column, as "CSV on the Web" (W3C) has it   |
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from lgmdjax.datasets.recorded import Recording
from lgmdjax.runtime import storage
from lgmdjax.simulation import episode_tables
from lgmdjax.simulation.episode_tables import COLUMNS, FIELDS, KINDS, MEANINGS, ORIGIN, UNITS
from lgmdjax.simulation.episodes import Walk

TABLE = "walks"
CSV_TYPES = {"f": "number", "i": "integer", "b": "boolean"}


def to_table(recording: Recording) -> pa.Table:
    """Return all walks as one table with unit and meaning in the metadata of each field."""
    table = pa.concat_tables([_walk_table(walk) for walk in recording.walks])
    described = [
        field.with_metadata({"unit": UNITS.get(field.name, ""), "meaning": MEANINGS[field.name]})
        for field in table.schema
    ]
    return table.cast(pa.schema(described, metadata=episode_tables.pandas_attributes()))


def write_parquet(folder: Path, recording: Recording) -> None:
    """Write walks.parquet."""
    pq.write_table(to_table(recording), folder / f"{TABLE}.parquet", compression="zstd")


def write_csv(folder: Path, recording: Recording) -> None:
    """Write walks.csv and walks.csv-metadata.json."""
    pyarrow.csv.write_csv(to_table(recording), folder / f"{TABLE}.csv")
    columns = [
        {
            "name": name,
            "datatype": CSV_TYPES[KINDS[name]],
            "dc:description": MEANINGS[name],
            **({"schema:unitText": UNITS[name]} if name in UNITS else {}),
        }
        for name in COLUMNS
    ]
    description = {"@context": "http://www.w3.org/ns/csvw", "url": f"{TABLE}.csv", "tableSchema": {"columns": columns}}
    storage.write_json(folder / f"{TABLE}.csv-metadata.json", description)


def _walk_table(walk: Walk) -> pa.Table:
    columns = {name: np.full(len(walk), getattr(walk, name), dtype) for name, dtype in ORIGIN.items()}
    for name, field in FIELDS.items():
        values = np.reshape(getattr(walk, name), (len(walk), len(field.columns)))
        columns |= {column: values[:, k] for k, column in enumerate(field.columns)}
    return pa.table(columns)
