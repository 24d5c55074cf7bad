"""Frame rate and duration of a video, which few files declare correctly.

The average rate is wrong if a frame is shown for a long time, as the last frame of a slide show is. The rate is
therefore that of the median spacing of the frames, and a video ends where its last frame ends, not where it begins.
"""

from collections.abc import Sequence
from fractions import Fraction

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

DEFAULT_RATE = Fraction(30)  # frames per second, of streams without timestamps
SPACING_TOLERANCE = 0.1  # of the median; timestamps are rounded, to 1 ms in Matroska
RATE_TOLERANCE = 0.01  # a declared rate (30000/1001) is more exact than the one that is measured


def frame_rate(stream: VideoStream, packets: Sequence[av.Packet]) -> Fraction:
    """Return frames per second from the timestamps of some packets of a stream."""
    declared = [rate for rate in (stream.average_rate, stream.guessed_rate, stream.base_rate) if rate]
    times = np.unique([packet.pts for packet in packets if packet.pts is not None and packet.size])
    if len(times) < 2 or not stream.time_base:
        return declared[0] if declared else DEFAULT_RATE
    measured = 1 / (_typical_spacing(times) * float(stream.time_base))
    nearest = min(declared, key=lambda rate: abs(rate - measured), default=DEFAULT_RATE)
    return nearest if abs(nearest / measured - 1) < RATE_TOLERANCE else Fraction(measured).limit_denominator(1001)


def _typical_spacing(times: np.ndarray) -> float:
    """Return the mean of the spacings that are close to their median, which averages the rounding of timestamps."""
    spacings = np.diff(times)
    median = np.median(spacings)
    return float(spacings[np.abs(spacings - median) <= SPACING_TOLERANCE * median + 1].mean())


def end_of(frame: av.VideoFrame, index: int, rate: Fraction) -> float:
    """Return the time at which a frame ends [s]."""
    if frame.time is None or frame.time_base is None:
        return float((index + 1) / rate)
    return frame.time + (float(frame.duration * frame.time_base) or float(1 / rate))


def declared_duration(container: InputContainer, stream: VideoStream) -> float:
    """Return the duration of the pictures [s] that the file declares; 0 if it declares none."""
    if stream.duration is not None and stream.time_base is not None and "mp4" in container.format.name:
        # The number of frames would be wrong: an edit list may hide some of them.
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    if stream.frames and stream.average_rate:
        return float(stream.frames / stream.average_rate)
    is_only_stream = len(container.streams) == 1  # otherwise the sound may be longer
    return (container.duration or 0) / av.time_base if is_only_stream else 0.0
