"""Walks as a LeRobotDataset v3.0, which LeRobot and its visualisers read; an episode lasts from a start to the next.

| file                                                    | contents                                                  |
| ------------------------------------------------------- | --------------------------------------------------------- |
| meta/info.json                                          | features with their names and units, counts, paths        |
| meta/stats.json                                         | statistics of every feature, for normalisation            |
| meta/tasks.parquet                                      | the task, in words                                        |
| meta/episodes/chunk-000/file-000.parquet                | frames, files and statistics of each episode              |
| data/chunk-000/file-000.parquet                         | one row for each frame                                    |
| videos/observation.images.left/chunk-000/file-000.mp4   | pictures of the left eye; the right likewise: H.264       |

Frames in which the robot had fallen are left out. Numbers are in single precision. Videos are slightly lossy; their
pictures are grey, in three equal channels. Files hold at most `FRAMES_PER_FILE` frames, in whole episodes.

Source: the format of huggingface/lerobot 0.4 and newer ("codebase_version": "v3.0").
"""

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8

from lgmdjax.datasets import pictures, statistics
from lgmdjax.datasets.lerobot_features import CAMERAS, FEATURES, FILES_PER_CHUNK, INDICES, TASK, info, unit_of
from lgmdjax.datasets.recorded import Recording, cut_episodes
from lgmdjax.errors import InputError
from lgmdjax.reporting import video_io
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episode_tables import ORIGIN
from lgmdjax.simulation.episodes import Walk

FRAMES_PER_FILE = 50_000  # 28 minutes
KEY_FRAME_EVERY = 8  # pictures; a reader decodes from the last key frame on
DATA, VIDEO = "data/chunk-{:03d}/file-{:03d}.parquet", "videos/{}/chunk-{:03d}/file-{:03d}.mp4"
EPISODES, TASKS = "meta/episodes/chunk-000/file-000.parquet", "meta/tasks.parquet"


@dataclass(frozen=True, kw_only=True)
class _Episode:
    """Frames of a walk, and where they are in the data set."""

    number: int
    walk: int  # number of the walk that it is a part of
    frames: slice  # of that walk
    first: int  # number of its first frame in the data set
    file: int
    first_in_file: int  # number of its first frame in its file

    def __len__(self) -> int:
        return self.frames.stop - self.frames.start

    @property
    def place(self) -> tuple[int, int]:
        """Numbers of chunk and file."""
        return divmod(self.file, FILES_PER_CHUNK)


@dataclass
class _Histograms:
    """Grey levels of both cameras' pictures, by episode."""

    by_episode: dict[int, np.ndarray] = field(default_factory=dict)

    def add(self, episode: int, both: pictures.Pictures) -> None:
        counts = np.stack([statistics.histogram(both[:, side]) for side in range(len(CAMERAS))])
        self.by_episode[episode] = self.by_episode.get(episode, 0) + counts


def write(folder: Path, recording: Recording, eyes: pictures.RecordedCamera | None) -> None:
    """Write the data set into a folder; with `eyes`, also their pictures.

    Raises InputError for walks without any frame that is ok, another frame rate, and pictures of an odd size.
    """
    episodes = _lay_out(recording.walks)
    width, height = (0, 0) if eyes is None else (eyes.settings.width, eyes.settings.height)
    if width % 2 or height % 2:
        raise InputError(
            f"expected pictures of even width and height for H.264, got {width} x {height}; "
            "use --format zarr, or leave --video out"
        )
    values = {name: _values(recording.walks, episodes, fields) for name, fields in FEATURES.items()}
    values |= _indices(episodes)
    _write_data(folder, episodes, values)
    histograms = None if eyes is None else _write_videos(folder, recording, episodes, eyes)
    _write_episodes(folder, recording, episodes, values, histograms)
    _write_tasks(folder)
    frames = sum(map(len, episodes))
    storage.write_json(folder / "meta" / "info.json", info(len(episodes), frames, eyes))
    storage.write_json(folder / "meta" / "stats.json", _to_json(_statistics(values, histograms, episodes)))


def _lay_out(walks: list[Walk]) -> list[_Episode]:
    """Return the episodes, with as many in each file as fit."""
    found: list[_Episode] = []
    first = first_in_file = file = 0
    for number, (walk, frames) in enumerate(cut_episodes(walks)):
        length = frames.stop - frames.start
        if first_in_file and first_in_file + length > FRAMES_PER_FILE:
            file, first_in_file = file + 1, 0
        found.append(
            _Episode(
                number=number, walk=walk, frames=frames, first=first, file=file, first_in_file=first_in_file
            )
        )  # fmt: skip
        first, first_in_file = first + length, first_in_file + length
    if not found:
        raise InputError("expected walks with frames that are ok, got none; collect others")
    periods = np.concatenate([np.diff(walks[one.walk].time[one.frames].astype(float)) for one in found])
    if len(periods) and np.abs(periods - 1 / FRAME_RATE).max() > 1e-3:
        raise InputError(f"expected {FRAME_RATE:g} frames a second without gaps, got other times; collect again")
    return found


def _values(walks: list[Walk], episodes: list[_Episode], fields: tuple[str, ...]) -> np.ndarray:
    """Return a feature of all frames, axes (frame, component)."""
    parts = []
    for one in episodes:
        some = [np.asarray(getattr(walks[one.walk], name)[one.frames]) for name in fields]
        parts.append(np.concatenate([value.reshape(len(one), -1) for value in some], axis=1))
    values = np.concatenate(parts)
    return values if values.dtype == bool else values.astype(np.float32)


def _indices(episodes: list[_Episode]) -> dict[str, np.ndarray]:
    lengths = [len(one) for one in episodes]
    frame = np.concatenate([np.arange(length) for length in lengths])
    last = np.concatenate([np.arange(length) == length - 1 for length in lengths])
    columns = {
        "timestamp": frame / FRAME_RATE,
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(episodes)), lengths),
        "index": np.arange(len(frame)),
        "task_index": np.zeros(len(frame)),
        "next.done": last,
    }
    return {name: column.astype(INDICES[name])[:, None] for name, column in columns.items()}


def _write_data(folder: Path, episodes: list[_Episode], values: Mapping[str, np.ndarray]) -> None:
    """Write the rows, a row group for each episode."""
    arrays = {name: _to_arrow(value) for name, value in values.items()}
    fields = [pa.field(name, array.type, metadata={"unit": unit_of(name)}) for name, array in arrays.items()]
    schema = pa.schema(fields)
    table = pa.table(list(arrays.values()), schema=schema)
    with contextlib.ExitStack() as stack:
        writers: dict[int, pq.ParquetWriter] = {}
        for one in episodes:
            if one.file not in writers:
                path = folder / DATA.format(*one.place)
                path.parent.mkdir(parents=True, exist_ok=True)
                writers[one.file] = stack.enter_context(pq.ParquetWriter(path, schema))
            writers[one.file].write_table(table.slice(one.first, len(one)))


def _to_arrow(values: np.ndarray) -> pa.Array:
    if values.shape[1] == 1:
        return pa.array(values[:, 0])
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _write_videos(
    folder: Path, recording: Recording, episodes: list[_Episode], eyes: pictures.RecordedCamera
) -> _Histograms:
    """Write the videos of both eyes; return the grey levels of their pictures."""
    histograms = _Histograms()
    of_file: dict[int, list[_Episode]] = {}
    for one in episodes:
        of_file.setdefault(one.file, []).append(one)
    rooms = pictures.find_rooms(recording)
    for some in of_file.values():
        with contextlib.ExitStack() as stack:
            writers = [stack.enter_context(_open_video(folder, camera, some[0].place, eyes)) for camera in CAMERAS]
            for one in some:
                walk = recording.walks[one.walk][one.frames]
                for both in pictures.render(eyes, rooms[one.walk], walk):
                    histograms.add(one.number, both)
                    for pair in both:
                        for write, picture in zip(writers, pair, strict=True):
                            write(np.repeat(picture[..., None], 3, axis=-1))
    return histograms


@contextlib.contextmanager
def _open_video(
    folder: Path, camera: str, place: tuple[int, int], eyes: pictures.RecordedCamera
) -> Iterator[Callable[[UInt8[np.ndarray, "height width channels"]], None]]:
    path = folder / VIDEO.format(camera, *place)
    path.parent.mkdir(parents=True, exist_ok=True)
    size = eyes.settings.width, eyes.settings.height
    with video_io.open_writer(path, *size, round(FRAME_RATE), key_frame_every=KEY_FRAME_EVERY) as write:
        yield write


def _write_episodes(
    folder: Path,
    recording: Recording,
    episodes: list[_Episode],
    values: Mapping[str, np.ndarray],
    histograms: _Histograms | None,
) -> None:
    """Write the table of the episodes, with the origin of each (`walk/...`)."""
    rows = []
    for one in episodes:
        span = slice(one.first, one.first + len(one))
        found = _statistics({name: value[span] for name, value in values.items()}, histograms, [one])
        walk = recording.walks[one.walk]
        rows.append(
            _place(one, with_videos=histograms is not None)
            | {f"walk/{name}": int(getattr(walk, name)) for name in ORIGIN}
            | {f"stats/{name}/{key}": value for name, some in _to_json(found).items() for key, value in some.items()}
        )
    path = folder / EPISODES
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)


def _place(one: _Episode, *, with_videos: bool) -> JsonObject:
    chunk, file = one.place
    start, end = one.first_in_file / FRAME_RATE, (one.first_in_file + len(one)) / FRAME_RATE
    facts = {
        "episode_index": one.number,
        "tasks": [TASK],
        "length": len(one),
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": one.first,
        "dataset_to_index": one.first + len(one),
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for camera in CAMERAS if with_videos else ():
        place = {"chunk_index": chunk, "file_index": file, "from_timestamp": start, "to_timestamp": end}
        facts |= {f"videos/{camera}/{name}": value for name, value in place.items()}
    return facts


def _statistics(
    values: Mapping[str, np.ndarray], histograms: _Histograms | None, episodes: list[_Episode]
) -> dict[str, statistics.Statistics]:
    found = {name: statistics.of_values(value) for name, value in values.items()}
    if histograms is not None:
        both = np.sum([histograms.by_episode[one.number] for one in episodes], axis=0)
        for camera, counts in zip(CAMERAS, both, strict=True):
            found[camera] = statistics.of_pictures(counts, sum(map(len, episodes)))
    return found


def _to_json(found: Mapping[str, statistics.Statistics]) -> dict[str, dict[str, list]]:
    return {name: {key: value.tolist() for key, value in some.items()} for name, some in found.items()}


def _write_tasks(folder: Path) -> None:
    """Write the table of the tasks, whose index is the task, as pandas writes it."""
    index = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    column = {**index, "name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    described = {"index_columns": ["task"], "column_indexes": [], "columns": [column, index]}
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [TASK]})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(described)}), folder / TASKS)
