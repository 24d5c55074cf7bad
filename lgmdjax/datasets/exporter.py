"""Export recorded walks as a data set: one new folder, whole or not at all, with a card that describes it.

| format  | files                                         | module                          | pictures       |
| ------- | --------------------------------------------- | ------------------------------- | -------------- |
| lerobot | LeRobotDataset v3.0: Parquet, MP4, JSON       | `lgmdjax.datasets.lerobot`      | H.264          |
| csv     | walks.csv, walks.csv-metadata.json            | `lgmdjax.datasets.tables`       | -              |
| parquet | walks.parquet                                 | `lgmdjax.datasets.tables`       | -              |
| zarr    | a Zarr group, version 3                       | `lgmdjax.datasets.zarr_arrays`  | without loss   |
"""

import re
from pathlib import Path

import jax

from lgmdjax.datasets import card, lerobot, pictures, recorded, tables, zarr_arrays
from lgmdjax.datasets.formats import DATASET_FORMATS, WITH_PICTURES, DatasetFormat
from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import partial_files

LICENCE = re.compile(r"[A-Za-z0-9.+-]+( (AND|OR|WITH) [A-Za-z0-9.+-]+)*")
"""Identifiers of the SPDX list, and simple expressions of them."""


def export(
    run: Path, out: Path, format: DatasetFormat, *, video: bool = False, licence: str = card.LICENCE
) -> list[Path]:
    """Write the recorded walks of a folder as a data set into a new folder; return its files.

    Args:
        run: a run folder, whose teacher's walks are exported; or the folder of a trial; or any with chunk-*.parquet.
        out: the folder to write; it must be empty or missing.
        format: of the data set.
        video: render the eyes' pictures from the recorded poses, and write them too.
        licence: licence of the data, by its name in the SPDX list.

    Raises InputError for an unknown format, a folder without walks, pictures in a format that holds none, walks whose
    rooms cannot be made again, and an `out` that has files.

    ```python
    lj.datasets.exporter.export(Path("runs/quick-0"), Path("walks"), "lerobot", video=True)
    ```
    """
    if format not in DATASET_FORMATS:
        raise InputError(f"expected a format of {', '.join(DATASET_FORMATS)}, got {format!r}; choose one of these")
    if video and format not in WITH_PICTURES:
        raise InputError(f"expected --video with format {' or '.join(WITH_PICTURES)}, got {format}; leave --video out")
    if not LICENCE.fullmatch(licence):
        raise InputError(f"expected a licence such as {card.LICENCE}, got {licence!r}; see spdx.org/licenses")
    partial_files.require_empty(out)
    partial_files.require_utf8(out)
    recording = recorded.read(run)
    with jax.enable_x64(False), partial_files.new_folder(out) as folder:  # pictures in single precision, as the robot's
        eyes = pictures.find_camera(recording) if video else None
        if format == "lerobot":
            lerobot.write(folder, recording, eyes)
        elif format == "zarr":
            zarr_arrays.write(folder, recording, eyes)
        elif format == "csv":
            tables.write_csv(folder, recording)
        else:
            tables.write_parquet(folder, recording)
        text = card.describe(recording, one_line(run.resolve().name), format, eyes, licence)
        (folder / card.FILE).write_text(text, encoding="utf-8")
    return sorted(path for path in out.rglob("*") if path.is_file())
