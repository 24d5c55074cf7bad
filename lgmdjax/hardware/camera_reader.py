"""The newest pictures of both eyes, from one camera or two that are read on background threads."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from av.error import FFmpegError
from jaxtyping import UInt8

from lgmdjax.errors import InputError, one_line
from lgmdjax.hardware import live_source, resampling
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.lens import Lens
from lgmdjax.hardware.resampling import Resampler
from lgmdjax.reporting import video_geometry, video_io
from lgmdjax.sensors import camera

FIRST_TIMEOUT = 20.0  # s for the first picture
SILENCE = 10.0  # s without a picture after which a live source is reopened
CLOSING = 0.5  # s of wall-clock time to wait for a thread to end
RETRY_INTERVAL = 0.5  # s of wall-clock time between two attempts
PAIR_TOLERANCE = 0.5  # largest time between the pictures of two cameras, in periods
PERIOD = 1 / 30  # s

Picture = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class Frame:
    """Pictures of both eyes, their number, and the time of their arrival [s]."""

    number: int
    time: float
    pictures: UInt8[np.ndarray, "2 rows columns"]


class Source(threading.Thread):
    """A thread that reads one source and passes each picture on, until the source ends or the thread is stopped.

    Args:
        name: device, address, pipe or file.
        clock: the robot's clock.
        receive: called on this thread with each picture and the time of its arrival [s].
    """

    def __init__(self, name: str, clock: Clock, receive: Callable[[Picture, float], None]):
        super().__init__(daemon=True, name=f"camera {name}")
        self.source, self.clock, self.receive = name, clock, receive
        self.started, self.stopped = threading.Event(), threading.Event()
        self.size = (0, 0)
        self.error: Exception | None = None

    def run(self) -> None:
        """Read until the source ends; reopen a live source that breaks after its first picture."""
        while not self.stopped.is_set():
            try:
                self._read()
            except (InputError, FFmpegError, OSError, ValueError) as error:
                self.error = error
            live = live_source.is_live(self.source)
            if not live or self.size == (0, 0) or self.stopped.wait(RETRY_INTERVAL):
                break
        self.started.set()

    def _read(self) -> None:
        for picture in self._pictures():
            self.size = picture.shape[1], picture.shape[0]
            self.started.set()
            if self.stopped.is_set():
                return
            self.receive(picture, self.clock.now())

    def wait(self) -> None:
        """Wait for the first picture; raise `InputError` if none comes."""
        if not self.started.wait(self.clock.to_wall(FIRST_TIMEOUT)) or self.size == (0, 0):
            if isinstance(self.error, InputError):
                raise self.error
            reason = one_line(self.error) if self.error else "it ended, or nothing came"
            name = live_source.without_login(self.source)
            raise InputError(f"expected pictures from {name}, got none ({reason}); check the camera")

    def _pictures(self) -> Iterator[Picture]:
        if live_source.is_live(self.source) or Path(self.source).is_fifo():
            patience = self.clock.to_wall(SILENCE)
            with live_source.open_live(self.source, rate=round(1 / PERIOD), patience=patience) as container:
                yield from live_source.decode_grey(self.source, container)
            return
        with video_io.open_reader(Path(self.source)) as video:
            size = video_geometry.square_size(video.width, video.height, video.pixel_aspect)
            start = None
            for frame in video.frames(*size):  # at the rate at which they were recorded
                start = self.clock.now() - frame.time if start is None else start
                self.stopped.wait(self.clock.to_wall(start + frame.time - self.clock.now()))
                yield np.ascontiguousarray(frame.picture)


class StereoReader:
    """The newest pictures of both eyes, from one source or two; use it in a `with` block.

    Args:
        sources: one source, or those of the left and of the right eye.
        lenses: calibrated lenses, one for all sources or one for each; empty for cameras with the eye's own lens.
        eye: camera with which the nervous system was trained.
        clock: the robot's clock.
        mono: give the picture of a single source to both eyes; otherwise it holds two pictures side by side.

    Raises InputError for sources without pictures, and for pictures of a wrong size.
    """

    def __init__(
        self,
        sources: tuple[str, ...],
        lenses: tuple[Lens, ...],
        eye: camera.Params,
        clock: Clock,
        *,
        mono: bool = False,
    ):
        self._split = len(sources) == 1 and not mono
        self._lenses, self._eye = lenses, eye
        self._condition = threading.Condition()
        self._newest: list[tuple[Picture, float] | None] = [None] * len(sources)
        self._resamplers: list[Resampler] = []
        self._taken = -1.0
        self._clock = clock
        self._count = 0  # frames taken so far
        self._sources = [
            Source(name, clock, lambda picture, time, index=index: self._receive(index, picture, time))
            for index, name in enumerate(sources)
        ]

    def __enter__(self) -> "StereoReader":
        for source in self._sources:
            source.start()
        try:
            for source in self._sources:
                source.wait()
            self._resamplers = self._make_resamplers()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for source in self._sources:
            source.stopped.set()
        for source in self._sources:
            source.join(CLOSING)  # a thread that still waits for its camera ends with the process

    def seen(self) -> float:
        """Return the fraction of the eyes' pictures that the cameras see."""
        return float(np.mean([resampler.seen for resampler in self._resamplers]))

    def take(self, timeout: float) -> Frame | None:
        """Return the newest pictures that were not taken yet; None if none arrive within `timeout` [s]."""
        with self._condition:
            if not self._condition.wait_for(self._has_new, self._clock.to_wall(timeout)):
                return None
            newest = [each for each in self._newest if each is not None]
        self._taken = max(time for _, time in newest)
        self._count += 1
        return Frame(self._count, self._taken, self._to_eyes([picture for picture, _ in newest]))

    def _receive(self, index: int, picture: Picture, time: float) -> None:
        with self._condition:
            self._newest[index] = picture, time
            self._condition.notify()

    def _has_new(self) -> bool:
        """Return whether every source has a new picture and all arrived at about the same time."""
        times = [each[1] for each in self._newest if each is not None]
        close = bool(times) and max(times) - min(times) < PAIR_TOLERANCE * PERIOD
        return len(times) == len(self._newest) and min(times) > self._taken and close

    def _to_eyes(self, pictures: list[Picture]) -> UInt8[np.ndarray, "2 rows columns"]:
        if self._split:
            pictures = np.split(pictures[0], 2, axis=1)
        if len(pictures) == 1:
            return np.repeat(self._resamplers[0](pictures[0])[None], 2, axis=0)
        return np.stack([resample(each) for resample, each in zip(self._resamplers, pictures, strict=True)])

    def _make_resamplers(self) -> list[Resampler]:
        sizes = [source.size for source in self._sources]
        if self._split:
            width, height = sizes[0]
            if width % 2:
                raise InputError(
                    f"expected an even width for two pictures side by side, got {width} px; give --mono, or two sources"
                )
            sizes = [(width // 2, height)] * 2
        if not self._lenses:
            return [resampling.from_same_lens(size, self._eye) for size in sizes]
        lenses = self._lenses * len(sizes) if len(self._lenses) == 1 else self._lenses
        for size, lens in zip(sizes, lenses, strict=True):
            if size != lens.size:
                raise InputError(
                    f"expected pictures of {lens.size[0]} x {lens.size[1]} px, the size of the calibration, got "
                    f"{size[0]} x {size[1]}; set the camera to the calibrated size"
                )
        return [resampling.from_lens(lens, self._eye) for lens in lenses]
