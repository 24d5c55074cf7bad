"""Walks as a Zarr group (version 3 of the format): an array for each field, a row for each frame.

| array                         | shape                | contents                                        |
| ----------------------------- | -------------------- | ----------------------------------------------- |
| episode, robot, room, seed    | (row,)               | which walk                                      |
| the fields of `Record`        | (row, ...)           | as recorded; attributes `units` and `long_name` |
| pictures_left, pictures_right | (row, height, width) | grey, 8 bits, without loss; with --video        |

Written by TensorStore, which comes with orbax-checkpoint; zarr, xarray and TensorStore read it.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tensorstore

from lgmdjax.datasets import pictures
from lgmdjax.datasets.recorded import Recording
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield
from lgmdjax.simulation.episode_tables import FIELDS, ORIGIN, ORIGIN_MEANINGS

ROWS_PER_CHUNK = 2**16
PICTURES_PER_CHUNK = 256
COMPRESSION = {"name": "gzip", "configuration": {"level": 5}}
AXES = {"joints": ("leg", "joint"), "position": ("axis",), "quaternion": ("component",)}  # of all others ("side",)


def write(folder: Path, recording: Recording, eyes: pictures.RecordedCamera | None) -> None:
    """Write the arrays into a folder; with `eyes`, also their pictures."""
    walks = recording.walks
    attributes: JsonObject = {"recorded_with": recording.parameters, "versions": recording.header.get("versions", {})}
    storage.write_json(folder / "zarr.json", {"zarr_format": 3, "node_type": "group", "attributes": attributes})
    for name, dtype in ORIGIN.items():
        values = np.concatenate([np.full(len(walk), getattr(walk, name), dtype) for walk in walks])
        _write_array(folder / name, values, (), {"long_name": ORIGIN_MEANINGS[name]})
    for name, field in FIELDS.items():
        values = np.concatenate([getattr(walk, name) for walk in walks])
        axes = AXES.get(name, ("side",)) if field.shape else ()
        units = {"units": field.unit} if field.unit else {}
        _write_array(folder / name, values, axes, {"long_name": field.meaning, **units})
    if eyes is not None:
        _write_pictures(folder, recording, eyes)


def _write_array(path: Path, values: np.ndarray, axes: tuple[str, ...], attributes: JsonObject) -> None:
    described = {"dimension_names": ["row", *axes], "attributes": attributes}
    store = _create(path, values.shape, values.dtype, ROWS_PER_CHUNK, described)
    store.write(values).result()


def _write_pictures(folder: Path, recording: Recording, eyes: pictures.RecordedCamera) -> None:
    """Write the pictures in whole chunks, since each write compresses its chunk again."""
    height, width = eyes.settings.height, eyes.settings.width
    rows = sum(map(len, recording.walks))
    stores = []
    for side in hemifield.SIDES:
        attributes = {"units": "grey", "long_name": f"picture of the {side} eye, row 0 at the top"}
        described = {"dimension_names": ["row", "height", "width"], "attributes": attributes}
        path, shape = folder / f"pictures_{side}", (rows, height, width)
        stores.append(_create(path, shape, np.dtype(np.uint8), PICTURES_PER_CHUNK, described))
    first = 0
    for block in _blocks(recording, eyes):
        for side, store in enumerate(stores):
            store[first : first + len(block)].write(block[:, side]).result()
        first += len(block)


def _blocks(recording: Recording, eyes: pictures.RecordedCamera) -> Iterator[pictures.Pictures]:
    """Yield the pictures of all walks in blocks of `PICTURES_PER_CHUNK`; the last one may be shorter."""
    waiting: list[np.ndarray] = []
    for room, walk in zip(pictures.find_rooms(recording), recording.walks, strict=True):
        for some in pictures.render(eyes, room, walk):
            waiting.append(some)
            if sum(map(len, waiting)) >= PICTURES_PER_CHUNK:
                both = np.concatenate(waiting)
                yield both[:PICTURES_PER_CHUNK]
                waiting = [both[PICTURES_PER_CHUNK:]]
    rest = np.concatenate(waiting)
    if len(rest):
        yield rest


def _create(
    path: Path, shape: tuple[int, ...], dtype: np.dtype, rows_per_chunk: int, described: JsonObject
) -> tensorstore.TensorStore:
    """Create an array with the names of its axes and its attributes (`described`)."""
    chunk = [min(rows_per_chunk, shape[0]), *shape[1:]]
    metadata = {
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, COMPRESSION],
        **described,
    }
    store = {"driver": "file", "path": f"{path.resolve()}/"}
    return tensorstore.open({"driver": "zarr3", "kvstore": store, "metadata": metadata}, create=True).result()
