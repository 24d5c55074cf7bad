"""Read and write video files one frame at a time, with PyAV, which includes FFmpeg.

Pictures are arrays 0..255 with row 0 at the top: grey (height, width) when read, RGB or RGBA (height, width,
channels) when written. Memory holds one frame that is read, the compressed data of `PROBED_PACKETS` packets, and
`MAX_QUEUED_PICTURES` pictures to be written.
"""

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from av.container import InputContainer, OutputContainer
from av.error import FFmpegError, InvalidDataError
from av.video.reformatter import Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream
from jaxtyping import UInt8

from lgmdjax.errors import InputError
from lgmdjax.reporting import video_geometry, video_source, video_timing

MAX_MISSING_FRAMES = 2  # at the end of an undamaged file: containers round their duration
PROBED_PACKETS = 240  # whose timestamps give the rate
MAX_QUEUED_PICTURES = 4  # waiting to be encoded


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
    pixel_aspect: Fraction  # width / height of a pixel of the upright picture
    rate: Fraction  # frames per second, of the median spacing
    count: int  # number of frames; 0 if unknown
    left_out: int  # damaged parts before the first whole frame: a recording may begin between two key frames
    frames: Callable[[int, int], Iterator[Frame]]  # reads the frames, area-averaged to (width, height) px


@contextlib.contextmanager
def open_reader(path: Path) -> Iterator[Video]:
    """Open a video file or a pipe to read it once, from the first frame to the last.

    Raises InputError if the file is missing or not a video; while frames are read, if it is damaged or shorter than it
    declares.
    """
    with video_source.open_container(path) as container:
        stream = video_source.choose_stream(path, container)
        packets = container.demux(stream)
        try:
            probed = list(islice(packets, PROBED_PACKETS))
        except FFmpegError as error:
            raise _damage(path, "at its beginning", error) from error
        rate = video_timing.frame_rate(stream, probed)
        packets = chain(probed, packets)
        frames, left_out = _begin(packets)
        if not frames:
            raise InputError(f"expected a video, got {path}, in which no frame is whole; get the whole file")
        orientation = video_geometry.of_frame(frames[0])  # only a frame contains it
        width, height = video_geometry.swap_axes((frames[0].width, frames[0].height), orientation)
        aspect = stream.sample_aspect_ratio or Fraction(1)
        decoded = _to_declared_end(path, container, stream, _decode(path, frames, packets), rate)
        yield Video(
            width=width,
            height=height,
            pixel_aspect=1 / aspect if orientation.transpose else aspect,
            rate=rate,
            count=stream.frames,
            left_out=left_out,
            frames=lambda width, height: read_grey(decoded, rate, width, height),
        )


@contextlib.contextmanager
def open_writer(
    target: Path | BinaryIO,
    width: int,
    height: int,
    rate: Fraction | int,
    *,
    fast: bool = False,
    key_frame_every: int | None = None,
) -> Iterator[Callable[[UInt8[np.ndarray, "height width channels"]], None]]:
    """Open an MP4 file for H.264 pictures of even width and height, and yield a function that writes one picture.

    Pictures are encoded in a separate thread; the function does not wait for it.

    Args:
        target: path of the file, or a binary stream.
        width: of the pictures [px].
        height: of the pictures [px].
        rate: frames per second.
        fast: encode in a third of the time, into a file larger by a third.
        key_frame_every: largest number of pictures between key frames, for readers that seek; FFmpeg's choice if None.
    """
    if width % 2 or height % 2:
        raise InputError(f"expected an even width and height for H.264, got {width} x {height}; pad by one")
    with contextlib.ExitStack() as stack:
        # FFmpeg would interpret some names as the URL of a protocol.
        file = stack.enter_context(target.open("wb")) if isinstance(target, Path) else target
        container = stack.enter_context(av.open(file, "w", format="mp4"))
        stream = _add_stream(container, width, height, rate, fast=fast, key_frame_every=key_frame_every)
        encoder = stack.enter_context(ThreadPoolExecutor(1))
        queue: deque[Future[None]] = deque()

        def write(picture: UInt8[np.ndarray, "height width channels"]) -> None:
            queue.append(encoder.submit(_encode, container, stream, picture))
            if len(queue) > MAX_QUEUED_PICTURES:
                queue.popleft().result()  # raises what the thread raised

        yield write
        queue.append(encoder.submit(_encode, container, stream, None))
        for encoded in queue:
            encoded.result()


def _add_stream(
    container: OutputContainer,
    width: int,
    height: int,
    rate: Fraction | int,
    *,
    fast: bool,
    key_frame_every: int | None,
) -> VideoStream:
    """Add an H.264 stream to a file, and return it."""
    stream = container.add_stream("h264", rate=Fraction(rate).limit_denominator(90_000))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.options = {"crf": "20", "preset": "ultrafast" if fast else "veryfast"}
    if key_frame_every is not None:
        stream.options |= {"g": str(key_frame_every)}
    if fast:
        stream.thread_count = 1  # more would wait for each other
    return stream


def _encode(
    container: OutputContainer, stream: VideoStream, picture: UInt8[np.ndarray, "height width channels"] | None
) -> None:
    """Write a picture to the stream; None flushes the encoder."""
    frame = None
    if picture is not None:
        frame = av.VideoFrame.from_ndarray(picture, format="rgba" if picture.shape[-1] == 4 else "rgb24")
    container.mux(stream.encode(frame))


def _begin(packets: Iterator[av.Packet]) -> tuple[list[av.VideoFrame], int]:
    """Decode up to the first whole frames; return them, and the number of damaged packets before them."""
    left_out = 0
    with contextlib.suppress(FFmpegError):
        for packet in packets:
            try:
                frames = _decode_packet(packet)
            except FFmpegError:
                left_out += 1
                continue
            if frames:
                return frames, left_out
    return [], left_out


def _decode_packet(packet: av.Packet) -> list[av.VideoFrame]:
    """Decode a packet; raise FFmpegError if it is damaged.

    A decoder replaces lost data by an older picture, which would look like motion.
    """
    frames = [frame for frame in packet.decode() if isinstance(frame, av.VideoFrame)]
    if packet.is_corrupt or any(frame.is_corrupt for frame in frames):
        raise InvalidDataError(0, "a packet is lost or damaged")
    return frames


def _decode(path: Path, frames: list[av.VideoFrame], packets: Iterator[av.Packet]) -> Iterator[av.VideoFrame]:
    """Yield the decoded frames, then those of the packets; raise InputError if they are damaged."""
    count, time = 0, None
    try:
        for frame in chain(frames, chain.from_iterable(map(_decode_packet, packets))):
            yield frame
            count, time = count + 1, frame.time
    except FFmpegError as error:
        raise _damage(path, f"after {count} frames" + (f", {time:.2f} s" if time is not None else ""), error) from error


def _damage(path: Path, where: str, error: FFmpegError) -> InputError:
    """Return the error to raise for a damaged video."""
    remedy = "save it to a file first" if path.is_fifo() else "get the whole file, or cut out a part without damage"
    reason = video_source.reason(error)
    return InputError(f"expected an undamaged video, got {path}, damaged or truncated {where} ({reason}); {remedy}")


def _to_declared_end(
    path: Path, container: InputContainer, stream: VideoStream, frames: Iterator[av.VideoFrame], rate: Fraction
) -> Iterator[av.VideoFrame]:
    """Yield the frames; raise InputError if they end earlier than the file declares."""
    end = 0.0
    for index, frame in enumerate(frames):
        yield frame
        end = max(end, video_timing.end_of(frame, index, rate))
    declared = video_timing.declared_duration(container, stream)
    if declared - end > MAX_MISSING_FRAMES / rate:
        raise InputError(f"expected {declared:.2f} s of video, as {path} declares, got {end:.2f} s; get the whole file")


def read_grey(frames: Iterator[av.VideoFrame], rate: Fraction, width: int, height: int) -> Iterator[Frame]:
    """Convert frames to grey, upright and of the given size.

    Brightness does not depend on the colour matrix (BT.601, 709, 2020), but FFmpeg's conversion is exact only for
    BT.601: with the others a scaled picture is a level too dark.
    """
    reformatter = VideoReformatter()  # shared, since a frame would make its own
    for index, frame in enumerate(frames):
        orientation = video_geometry.of_frame(frame)
        stored = video_geometry.swap_axes((width, height), orientation)
        small = reformatter.reformat(
            frame,
            *stored,
            format="gray",
            src_colorspace=Colorspace.ITU601,
            dst_colorspace=Colorspace.ITU601,
            interpolation=Interpolation.AREA,
        )
        picture = video_geometry.to_upright(small.to_ndarray(), orientation)
        yield Frame(time=frame.time if frame.time is not None else index / float(rate), picture=picture)
