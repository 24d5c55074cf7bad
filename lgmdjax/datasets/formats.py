"""Names of the formats of data sets; free of JAX, for a fast command line."""

from typing import Literal, get_args

DatasetFormat = Literal["lerobot", "csv", "parquet", "zarr"]
DATASET_FORMATS: tuple[DatasetFormat, ...] = get_args(DatasetFormat)
WITH_PICTURES: tuple[DatasetFormat, ...] = ("lerobot", "zarr")
"""Formats that can hold the eyes' pictures."""
