"""Read and write video files one frame at a time, with PyAV, which includes FFmpeg.

Pictures are arrays 0..255 with row 0 at the top: grey (height, width) when read, RGB (height, width, 3) when written.
At most one frame is held in memory.
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.reformatter import Interpolation
from av.video.stream import VideoStream
from jaxtyping import UInt8

from lgmdjax.errors import InputError

MAX_MISSING_FRAMES = 2  # at the end of an undamaged file: containers round their duration


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One picture and its time."""

    time: float  # s
    picture: UInt8[np.ndarray, "height width"]  # grey


@dataclass(frozen=True, kw_only=True)
class Video:
    """An open video file."""

    width: int  # px, of the upright picture
    height: int
    rate: Fraction  # frames per second
    count: int  # number of frames; 0 if unknown
    frames: Callable[[int, int], Iterator[Frame]]  # reads the frames, area-averaged to (width, height) px


@contextlib.contextmanager
def open_reader(path: Path) -> Iterator[Video]:
    """Open a video file to read it once, from the first frame to the last.

    Raises InputError if the file is missing or no video; while frames are read, if it is damaged or shorter than it
    declares.
    """
    if not path.is_file():
        raise InputError(f"expected a video file, found no file at {path}; check the path")
    try:
        container = av.open(str(path))
    except (FFmpegError, ValueError) as error:
        raise InputError(
            f"expected a video, got {path}, which is no video or is truncated ({_reason(error)}); try to play it"
        ) from error
    with container:
        if not container.streams.video:
            raise InputError(f"expected a video, got {path}, which has no pictures; choose another file")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        decoded = _decode(path, container, stream)
        first = next(decoded, None)  # only a frame contains the rotation
        if first is None:
            raise InputError(f"expected a video, got {path}, which has no frame; choose another file")
        width, height = _stored_size(first, first.width, first.height)
        yield Video(
            width=width,
            height=height,
            rate=_rate(stream),
            count=stream.frames,
            frames=lambda width, height: _read_grey(chain([first], decoded), _rate(stream), width, height),
        )


@contextlib.contextmanager
def open_writer(
    target: Path | BinaryIO, width: int, height: int, rate: Fraction | int
) -> Iterator[Callable[[UInt8[np.ndarray, "height width 3"]], None]]:
    """Open an MP4 file for H.264 pictures of even width and height, and yield a function that writes one picture."""
    if width % 2 or height % 2:
        raise InputError(f"expected an even width and height for H.264, got {width} x {height}; pad by one")
    with av.open(target if hasattr(target, "write") else str(target), "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=Fraction(rate).limit_denominator(90_000))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "20", "preset": "veryfast"}

        def write(picture: UInt8[np.ndarray, "height width 3"]) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

        yield write
        container.mux(stream.encode())


def _decode(path: Path, container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """Decode all frames; raise InputError if the video ends earlier than the file declares."""
    end = 0.0
    count = 0
    try:
        for count, frame in enumerate(container.decode(stream), 1):
            yield frame
            end = frame.time if frame.time is not None else count / _rate(stream)
    except FFmpegError as error:
        raise InputError(
            f"expected an undamaged video, got {path}, damaged or truncated after {count} frames "
            f"({_reason(error)}); get the whole file"
        ) from error
    declared = _declared_duration(container, stream)
    if declared - end > (1 + MAX_MISSING_FRAMES) / _rate(stream):
        raise InputError(f"expected {declared:.2f} s of video, as {path} declares, got {end:.2f} s; get the whole file")


def _declared_duration(container: InputContainer, stream: VideoStream) -> float:
    """Return the duration of the pictures [s] that the file declares; 0 if it declares none."""
    if stream.duration is not None and stream.time_base is not None and "mp4" in container.format.name:
        # The number of frames would be wrong: an edit list may hide some of them.
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    if stream.frames:
        return float(stream.frames / _rate(stream))
    is_only_stream = len(container.streams) == 1  # otherwise the sound may be longer
    return (container.duration or 0) / av.time_base if is_only_stream else 0.0


def _read_grey(frames: Iterator[av.VideoFrame], rate: Fraction, width: int, height: int) -> Iterator[Frame]:
    """Convert frames to grey, upright and of the given size."""
    for index, frame in enumerate(frames):
        stored = _stored_size(frame, width, height)
        small = frame.reformat(*stored, format="gray", interpolation=Interpolation.AREA)
        upright = np.rot90(small.to_ndarray(), _quarter_turns(frame))
        yield Frame(time=frame.time if frame.time is not None else index / float(rate), picture=upright)


def _stored_size(frame: av.VideoFrame, width: int, height: int) -> tuple[int, int]:
    """Swap width and height if the picture is stored rotated by a quarter turn."""
    return (height, width) if _quarter_turns(frame) % 2 else (width, height)


def _quarter_turns(frame: av.VideoFrame) -> int:
    """Return the number of counterclockwise quarter turns that make the stored picture upright."""
    return round(frame.rotation / 90)


def _rate(stream: VideoStream) -> Fraction:
    return stream.average_rate or stream.guessed_rate or Fraction(30)


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()
