"""Open live cameras: a kernel device, a network stream, or a pipe.

| source                                  | read by                                     |
| --------------------------------------- | ------------------------------------------- |
| `/dev/video0`                           | FFmpeg's v4l2                               |
| `rtsp://`, `http://`, `tcp://`, `udp://`, ... | FFmpeg, only with the protocols in `PROTOCOLS` |
| a pipe, `/dev/stdin`                    | FFmpeg, which gets only the bytes           |

Anything else is a file (`reporting.video_source`). Only one picture is buffered, since old pictures are
useless to a robot. Formats that only name other files (playlists) are refused, as they are for files.
"""

import contextlib
import io
import os
import re
import stat
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.reformatter import Colorspace, VideoReformatter
from jaxtyping import UInt8

from lgmdjax.errors import InputError
from lgmdjax.reporting import video_geometry, video_io, video_source

PROTOCOLS = ("tcp", "udp", "rtp", "rtsp", "rtsps", "http", "https", "srt", "rtmp")
WHITELIST = ",".join((*PROTOCOLS, "tls", "crypto", "httpproxy"))
FORMATS = ",".join((*video_source.VIDEO_FORMATS, "rtsp", "rtp", "sdp", "mpjpeg", "live_flv"))
PATIENCE = 10.0  # s, to wait for a source to open, and for each of its pictures
PROMPT = {"fflags": "nobuffer", "flags": "low_delay", "probesize": "5000000", "analyzeduration": "500000"}


def is_live(source: str) -> bool:
    """Return whether a source is a device or a network stream; a pipe does not count, since it may carry a file."""
    return is_stream(source) or is_device(source)


def is_stream(source: str) -> bool:
    """Return whether a source is the address of a stream."""
    protocol, separator, _ = source.partition("://")
    return bool(separator) and protocol.lower() in PROTOCOLS


def is_device(source: str) -> bool:
    """Return whether a source is a camera device of the kernel."""
    try:
        return stat.S_ISCHR(os.stat(source).st_mode) and Path(source).resolve().name.startswith("video")
    except (OSError, ValueError):
        return False


def without_login(source: str) -> str:
    """Return a source without the user name and the password that its address may contain.

    >>> without_login("rtsp://me:secret@camera/left")
    'rtsp://camera/left'
    """
    return re.sub(r"^(\w+://)[^/@]*@", r"\1", source)


def file_name(source: str) -> str:
    """Return a name for files about a live source.

    >>> file_name("rtsp://camera:8554/left")
    'rtsp-camera-8554-left'
    """
    return re.sub(r"\W+", "-", without_login(source)).strip("-")


@contextlib.contextmanager
def open_live(source: str, *, rate: int | None = None, patience: float = PATIENCE) -> Iterator[InputContainer]:
    """Open a live source for FFmpeg.

    Args:
        source: device, address or pipe.
        rate: frame rate to request from a device [frames/s]; its own if None.
        patience: longest wait for it to open, and for each picture [s of wall-clock time].

    Raises InputError if it does not open or sends no pictures.
    """
    with contextlib.ExitStack() as stack:
        try:
            container = _open(source, rate, patience, stack)
        except (FFmpegError, OSError, ValueError) as error:
            name, reason = without_login(source), video_source.reason(error)
            raise InputError(
                f"expected a camera, got {name}, which does not open ({reason}); check name, cable and permissions, or "
                "try to play it with ffplay"
            ) from error
        yield stack.enter_context(container)


def _open(source: str, rate: int | None, patience: float, stack: contextlib.ExitStack) -> InputContainer:
    if is_stream(source):
        options = PROMPT | {"protocol_whitelist": WHITELIST, "format_whitelist": FORMATS, "rtsp_transport": "tcp"}
        return av.open(source, "r", options=options, timeout=patience)
    if is_device(source):
        wanted = {} if rate is None else {"framerate": str(rate)}
        return av.open(source, "r", format="v4l2", options=wanted, timeout=patience)
    file = stack.enter_context(io.FileIO(source))
    options = PROMPT | {"protocol_whitelist": "none", "format_whitelist": FORMATS}
    return av.open(video_source.Pipe(file), "r", options=options, buffer_size=1 << 12)


def decode_grey(source: str, container: InputContainer) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """Yield the pictures of a live source as they arrive, in grey and in their own size; damaged ones are left out."""
    stream = video_source.choose_stream(Path(source), container)
    stream.thread_type = "NONE"  # threads would hold back one picture each
    reformatter = VideoReformatter()
    for packet in container.demux(stream):
        with contextlib.suppress(FFmpegError):
            for frame in packet.decode():
                if isinstance(frame, av.VideoFrame) and not frame.is_corrupt:
                    yield _to_grey(reformatter, frame)


def _to_grey(reformatter: VideoReformatter, frame: av.VideoFrame) -> UInt8[np.ndarray, "height width"]:
    grey = reformatter.reformat(
        frame, format="gray", src_colorspace=Colorspace.ITU601, dst_colorspace=Colorspace.ITU601
    )
    upright = video_geometry.to_upright(grey.to_ndarray(), video_geometry.of_frame(frame))
    return np.ascontiguousarray(upright)


@contextlib.contextmanager
def open_reader(source: str, seconds: float) -> Iterator[video_io.Video]:
    """Open a live source as `video_io.open_reader` opens a file, for some seconds by the times of its pictures.

    Raises InputError if it does not open or is no video.
    """
    with open_live(source) as container:
        stream = video_source.choose_stream(Path(source), container)
        rate = stream.average_rate or stream.guessed_rate or Fraction(30)

        def read(width: int, height: int) -> Iterator[video_io.Frame]:
            first = None
            frames = (frame for packet in container.demux(stream) for frame in _decode_whole(packet))
            for frame in video_io.read_grey(frames, rate, width, height):
                first = frame.time if first is None else first
                if frame.time - first >= seconds:
                    return
                yield video_io.Frame(time=frame.time - first, picture=frame.picture)

        yield video_io.Video(
            width=stream.width,
            height=stream.height,
            pixel_aspect=stream.sample_aspect_ratio or Fraction(1),
            rate=rate,
            count=round(seconds * rate),
            left_out=0,
            frames=read,
        )


def _decode_whole(packet: av.Packet) -> list[av.VideoFrame]:
    """Return the undamaged frames of a packet."""
    try:
        return [frame for frame in packet.decode() if isinstance(frame, av.VideoFrame) and not frame.is_corrupt]
    except FFmpegError as error:
        print(f"note: a damaged picture is left out ({video_source.reason(error)})", file=sys.stderr)
        return []
