"""A recorded walk as arrays that can be drawn at once, without JAX.

C MuJoCo's kinematics compute the pose of the limbs from the robot's coordinates (qpos). The pictures of the eyes and
the layers of the LGMDs are stored as bytes, since only the simulation can compute them.

A file holds one walk (`save`, `load`): numbers as they are, pictures as H.264, layers compressed without loss.
"""

import io
import math
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from lgmdjax.errors import InputError, one_line
from lgmdjax.reporting import video_io
from lgmdjax.runtime import schema, storage

FRAME_RATE = 30  # Hz
LAYER_WHITE = 6.0  # grey levels of a cell that are shown as white
JOINTS = 18
MAX_AXES, MAX_NUMBERS = 5, 10**8  # of an array in a file
LAYERS = ("E", "I", "S")


class RoomShape(NamedTuple):
    """Shape of a room, without the positions of its obstacles; boxes first, then cylinders."""

    bounds: Float[ndarray, "4"]  # x_min, x_max, y_min, y_max [m]
    wall_height: float  # m
    half_size: Float[ndarray, "n 2"]  # m; the radius twice for a cylinder
    yaw: Float[ndarray, " n"]  # rad
    bottom: Float[ndarray, " n"]  # m above the floor
    top: Float[ndarray, " n"]
    is_round: Bool[ndarray, " n"]


class Playback(NamedTuple):
    """One walk, a row for each frame of 1/30 s; the names are those of `Record`."""

    title: str
    room: RoomShape
    centres: Float[ndarray, "frames n 2"]  # m, of the obstacles; a single row if they stand still
    time: Float[ndarray, " frames"]  # s
    qpos: Float[ndarray, "frames 25"]
    u: Float[ndarray, "frames 2"]
    velocity: Float[ndarray, "frames 2"]
    contact: Bool[ndarray, " frames"]
    is_first: Bool[ndarray, " frames"]
    pictures: UInt8[ndarray, "frames 2 height width"] | None = None
    layers: UInt8[ndarray, "frames 2 3 rows columns"] | None = None  # `LAYERS`; white is `LAYER_WHITE`

    def centres_at(self, frame: int) -> Float[ndarray, "n 2"]:
        """Return the centres of the obstacles in a frame [m]."""
        return self.centres[min(frame, len(self.centres) - 1)]


ROOM = ("bounds", "wall_height", "half_size", "yaw", "bottom", "top", "is_round")
SERIES = ("time", "qpos", "u", "velocity", "contact", "is_first", "centres")
PACKED = {"layers": np.uint8, "centres": np.float32}  # compressed without loss


def save(path: Path, playback: Playback) -> None:
    """Write a walk as npz, whole or not at all; it must have pictures and layers."""
    if playback.pictures is None or playback.layers is None:
        raise InputError(f"{path}: expected a walk with pictures and layers, got one without; simulate it live")
    arrays = {name: np.asarray(getattr(playback.room, name)) for name in ROOM}
    arrays |= {name: np.asarray(getattr(playback, name)) for name in SERIES if name not in PACKED}
    arrays = {name: value.astype(np.float32) if value.dtype.kind == "f" else value for name, value in arrays.items()}
    for name, dtype in PACKED.items():
        whole = np.asarray(getattr(playback, name), dtype)
        arrays[name] = np.frombuffer(zlib.compress(whole.tobytes(), 9), np.uint8)
        arrays[f"{name}_shape"] = np.asarray(whole.shape)
    title = np.frombuffer(playback.title.encode(), np.uint8)
    storage.write_arrays(path, {**arrays, "pictures": _encode(playback.pictures), "title": title})


def load(path: Path) -> Playback:
    """Read a walk that `save` wrote; raise `InputError` for another or a damaged file."""
    arrays = storage.read_arrays(path)
    try:
        frames = len(arrays["time"])
        schema.check(_schema(frames, len(arrays["top"])), arrays, str(path), storage.REINSTALL)
        room = {name: arrays[name] for name in ROOM}
        return Playback(
            title=arrays["title"].tobytes().decode(),
            room=RoomShape(**{**room, "wall_height": float(arrays["wall_height"])}),
            **{name: arrays[name] for name in SERIES if name not in PACKED},
            **{name: _unpack(arrays, name) for name in PACKED},
            pictures=_decode(arrays["pictures"].tobytes(), frames),
        )
    except InputError:
        raise
    except Exception as error:  # whatever a damaged file makes zlib, FFmpeg and NumPy raise
        reason = one_line(error)[:200]
        raise InputError(f"{path}: expected a recorded walk, got {reason}; {storage.REINSTALL}") from error


def cut(playback: Playback, frames: int) -> Playback:
    """Return the first frames of a walk."""
    series = {name: getattr(playback, name) for name in (*SERIES, "pictures", "layers")}
    return playback._replace(**{name: rows if rows is None else rows[:frames] for name, rows in series.items()})


def with_senses(playback: Playback, first: int, pictures: ndarray, layers: ndarray) -> Playback:
    """Return a walk with pictures and layers of its frames from `first` on; its own arrays are changed in place."""
    series: dict[str, ndarray] = {}
    for name, part in (("pictures", pictures), ("layers", layers)):
        known = getattr(playback, name)
        series[name] = np.zeros((len(playback.time), *part.shape[1:]), np.uint8) if known is None else known
        series[name][first : first + len(part)] = part
    return playback._replace(**series)


def path_of(playback: Playback) -> list[Float[ndarray, "frames 3"]]:
    """Return the positions [m] between a start or reset and the next, one array for each."""
    starts = np.flatnonzero(playback.is_first)
    return [part for part in np.split(playback.qpos[:, :3], starts[starts > 0]) if len(part) > 1]


def contacts_of(playback: Playback) -> Sequence[int]:
    """Return the first frame of every contact."""
    touching = np.asarray(playback.contact, int)
    return np.flatnonzero(np.diff(touching, prepend=0) > 0).tolist()


def _unpack(arrays: Mapping[str, ndarray], name: str) -> ndarray:
    """Return an array that was compressed; no more memory is allocated than its declared shape needs."""
    shape, dtype = tuple(arrays[f"{name}_shape"].tolist()), np.dtype(PACKED[name])
    if len(shape) > MAX_AXES or not 0 < math.prod(shape) <= MAX_NUMBERS:
        raise ValueError(f"{name} of shape {shape}")
    content = zlib.decompressobj().decompress(arrays[name].tobytes(), math.prod(shape) * dtype.itemsize)
    return np.frombuffer(content, dtype).reshape(shape)


def _encode(pictures: UInt8[ndarray, "frames 2 height width"]) -> UInt8[ndarray, " bytes"]:
    """Return both eyes' pictures, side by side, as an MP4 file."""
    side_by_side = np.concatenate([pictures[:, 0], pictures[:, 1]], axis=-1)
    buffer = io.BytesIO()
    with video_io.open_writer(buffer, side_by_side.shape[2], side_by_side.shape[1], FRAME_RATE) as write:
        for picture in side_by_side:
            write(np.repeat(picture[..., None], 3, axis=-1))
    return np.frombuffer(buffer.getvalue(), np.uint8)


def _decode(content: bytes, frames: int) -> UInt8[ndarray, "frames 2 height width"]:
    with av.open(io.BytesIO(content), "r") as container:
        decoded = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    if len(decoded) != frames:
        raise ValueError(f"{len(decoded)} pictures of {frames} frames")
    whole = np.stack(decoded)
    return np.stack(np.split(whole, 2, axis=-1), axis=1)


def _schema(frames: int, prisms: int) -> schema.Object:
    """Return the schema of the arrays of a file."""

    def numbers(*shape: int) -> schema.Numbers:
        return schema.Numbers(shape, -1e4, 1e4)

    return schema.Object(
        {
            "bounds": numbers(4),
            "wall_height": numbers(),
            "half_size": numbers(prisms, 2),
            **{name: numbers(prisms) for name in ("yaw", "bottom", "top")},
            "time": numbers(frames),
            "qpos": numbers(frames, 7 + JOINTS),
            "u": numbers(frames, 2),
            "velocity": numbers(frames, 2),
        }
    )
