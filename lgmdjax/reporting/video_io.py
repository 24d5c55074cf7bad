"""Video files, read and written a frame at a time (PyAV, which carries FFmpeg with it).

Pictures are arrays with row 0 at the top, 0..255: grey (height, width) when read, RGB (height, width, 3) when
written. Nothing holds more than a frame.
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

LOST_FRAMES = 2  # as many may be missing at the end of an intact file: containers round their duration


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One picture and when it is shown [s]."""

    time: float
    picture: UInt8[np.ndarray, "height width"]


@dataclass(frozen=True, kw_only=True)
class Video:
    """An open file: the size of its pictures as shown [px], its rate [1/s], their number (0: not known)."""

    width: int
    height: int
    rate: Fraction
    count: int
    frames: Callable[[int, int], Iterator[Frame]]  # at (width, height) px, area-averaged


@contextlib.contextmanager
def reading(path: Path) -> Iterator[Video]:
    """Open a video file to read it once, from its first frame to its last.

    Raises InputError when the file is missing or no video, and, while its frames are read, when it is damaged
    or shorter than it says.
    """
    if not path.is_file():
        raise InputError(f"expected a video file, found no file at {path}; check the path")
    try:
        container = av.open(str(path))
    except (FFmpegError, ValueError) as error:
        raise InputError(
            f"expected a video, got {path}, which is none or is cut off ({_reason(error)}); try to play it"
        ) from error
    with container:
        if not container.streams.video:
            raise InputError(f"expected a video, got {path}, which has no pictures in it; give another file")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        decoded = _decode(path, container, stream)
        first = next(decoded, None)  # only a frame tells how a phone was held
        if first is None:
            raise InputError(f"expected a video, got {path}, which has no frame in it; give another file")
        width, height = _shown(first, first.width, first.height)
        yield Video(
            width=width,
            height=height,
            rate=_rate(stream),
            count=stream.frames,
            frames=lambda width, height: _grey(chain([first], decoded), _rate(stream), width, height),
        )


@contextlib.contextmanager
def writing(
    target: Path | BinaryIO, width: int, height: int, rate: Fraction | int
) -> Iterator[Callable[[UInt8[np.ndarray, "height width 3"]], None]]:
    """Open an MP4 file for H.264 pictures of even width and height; what this gives writes one."""
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
    """Decode to the end, and raise InputError if that comes earlier than the file says."""
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
    declared = _declared_seconds(container, stream)
    if declared - end > (1 + LOST_FRAMES) / _rate(stream):
        raise InputError(f"expected {declared:.2f} s of video, as {path} declares, got {end:.2f} s; get the whole file")


def _declared_seconds(container: InputContainer, stream: VideoStream) -> float:
    """How long the file says that its pictures last [s]; 0 if it does not say."""
    if stream.duration is not None and stream.time_base is not None and "mp4" in container.format.name:
        # Not the number of frames: an edit list may hide some of them.
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    if stream.frames:
        return float(stream.frames / _rate(stream))
    alone = len(container.streams) == 1  # if not, the sound may be what lasts so long
    return (container.duration or 0) / av.time_base if alone else 0.0


def _grey(frames: Iterator[av.VideoFrame], rate: Fraction, width: int, height: int) -> Iterator[Frame]:
    for index, frame in enumerate(frames):
        stored = _shown(frame, width, height)
        small = frame.reformat(*stored, format="gray", interpolation=Interpolation.AREA)
        upright = np.rot90(small.to_ndarray(), _quarter_turns(frame))
        yield Frame(time=frame.time if frame.time is not None else index / float(rate), picture=upright)


def _shown(frame: av.VideoFrame, width: int, height: int) -> tuple[int, int]:
    """Swap width and height if the picture is stored lying on its side."""
    return (height, width) if _quarter_turns(frame) % 2 else (width, height)


def _quarter_turns(frame: av.VideoFrame) -> int:
    """How often to turn the stored picture to the left (counterclockwise) to have it upright."""
    return round(frame.rotation / 90)


def _rate(stream: VideoStream) -> Fraction:
    return stream.average_rate or stream.guessed_rate or Fraction(30)


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()
