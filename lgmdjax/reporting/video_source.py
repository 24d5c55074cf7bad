"""Open video files so that FFmpeg sees only their bytes.

FFmpeg interprets a name such as `12:30:05.mp4` or `concat:a.mp4` as the URL of a protocol. Some formats (playlists,
numbered pictures) only name other files, which it would open in turn. FFmpeg therefore gets no name, a list of formats
that hold their own pictures, and no protocol.
"""

import contextlib
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import IO

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.stream import VideoStream

from lgmdjax.errors import InputError

VIDEO_FORMATS = (
    *("mov", "matroska", "avi", "mpegts", "mpeg", "mpegvideo", "flv", "asf", "ogg", "rm", "mxf", "dv", "nut"),
    *("gif", "apng", "webp", "yuv4mpegpipe", "ivf", "obu", "av1", "vvc", "hevc", "h264", "h263", "m4v", "mjpeg"),
)
SOUND_FORMATS = ("wav", "mp3", "flac", "aac", "aiff", "caf", "amr")  # for a clear error: they have no pictures
ERROR_DETECTION = "crccheck+bitstream+buffer+explode"  # FFmpeg otherwise invents what is missing
OPTIONS = {
    "format_whitelist": ",".join((*VIDEO_FORMATS, *SOUND_FORMATS)),
    "protocol_whitelist": "none",
    "err_detect": ERROR_DETECTION,
}
BUFFER_SIZE = 1 << 18  # bytes


class Pipe:
    """A file without seek; an interruption while waiting for it reaches the caller.

    FFmpeg calls `read`, and would drop an exception that is not an `Exception`.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.interruption: BaseException | None = None

    def read(self, size: int) -> bytes:
        """Return the next bytes; none at the end or after an interruption."""
        try:
            return self._file.read(size)
        except BaseException as error:
            self.interruption = error
            return b""


class Seekable:
    """A file with seek, without its name."""

    def __init__(self, file: FileIO) -> None:
        self.read, self.seek, self.tell = file.read, file.seek, file.tell
        self.interruption = None


@contextlib.contextmanager
def open_container(path: Path) -> Iterator[InputContainer]:
    """Open a video file or a pipe for FFmpeg.

    Raises InputError if there is no file or no video.
    """
    if not (path.is_file() or path.is_fifo()):
        raise InputError(f"expected a video file, found no file at {path}; check the path")
    try:
        opened = path.open("rb", buffering=0)
    except OSError as error:
        raise InputError(f"expected a video file that can be read, got {path} ({error.strerror}); check it") from error
    with opened as file:
        source = Seekable(file) if file.seekable() else Pipe(file)
        try:
            container = av.open(source, "r", options=OPTIONS, metadata_errors="replace", buffer_size=BUFFER_SIZE)
        except (FFmpegError, ValueError) as error:
            if source.interruption:
                raise source.interruption from error
            hint = "try to play it" if file.seekable() else "save it to a file, since some cannot be read from a pipe"
            raise InputError(
                f"expected a video, got {path}, which is not a video, is truncated, or names other files "
                f"({reason(error)}); {hint}"
            ) from error
        with container:
            yield container
        if source.interruption:
            raise source.interruption


def choose_stream(path: Path, container: InputContainer) -> VideoStream:
    """Return the stream of pictures, with the decoder's error detection on.

    Raises InputError if there is none, or none that can be decoded. The cover picture of a sound file does not count.
    """
    still = Disposition.attached_pic | Disposition.timed_thumbnails
    streams = [stream for stream in container.streams.video if not stream.disposition & still]
    if not streams:
        raise InputError(f"expected a video, got {path}, which has no pictures that move; choose another file")
    best = container.streams.best("video")
    stream = best if isinstance(best, VideoStream) and best in streams else streams[0]
    if stream.codec_context is None:
        raise InputError(f"expected a video, got {path}, whose codec is unknown; convert it to H.264")
    stream.thread_type = "AUTO"
    stream.codec_context.options = {"err_detect": ERROR_DETECTION}
    return stream


def reason(error: Exception) -> str:
    """Return FFmpeg's description of an error, as a part of a sentence."""
    return (getattr(error, "strerror", None) or str(error)).lower()
