"""Live sources: a stream over loopback, a pipe and a file give the eyes their pictures, and `watch` takes them too."""

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.csv
import pytest

from lgmdjax.cli import main
from lgmdjax.errors import InputError
from lgmdjax.hardware import live_source
from lgmdjax.hardware.camera_reader import StereoReader
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.simulated_robot import PictureServer
from lgmdjax.reporting import video_io
from lgmdjax.sensors import camera

EYE = camera.Params(width=40, height=30)


def pair(number: int) -> np.ndarray:
    """The left picture tells the number, the right one is different."""
    left, right = np.full((30, 40), number % 200, np.uint8), np.full((30, 40), 255 - number % 200, np.uint8)
    return np.concatenate([left, right], axis=1)


class Stream:
    """A server that sends pictures until it is stopped."""

    def __init__(self) -> None:
        self.server, self.sent, self.paused = PictureServer(0), 0, threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self) -> None:
        while not self._ended.wait(0.02):
            if not self.paused.is_set():
                self.sent += 1
                self.server.send(pair(self.sent))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self.server.close()


@pytest.fixture
def stream() -> Iterator[Stream]:
    made = Stream()
    yield made
    made.close()


def take(eyes: StereoReader) -> np.ndarray:
    end = time.monotonic() + 60
    while (frame := eyes.take(0.5)) is None:
        assert time.monotonic() < end
    return frame.pictures


def test_side_by_side_pictures_of_a_stream_are_the_two_eyes_and_the_newest_wins(stream: Stream) -> None:
    with StereoReader((stream.server.address,), (), EYE, Clock()) as eyes:
        left, right = take(eyes)
        assert np.ptp(left) == 0 and left[0, 0] == 255 - right[0, 0]
        before = int(left[0, 0])
        time.sleep(0.5)
        assert (int(take(eyes)[0, 0, 0]) - before) % 200 >= 5  # the ones between are skipped
        stream.paused.set()
        while eyes.take(0.3) is not None:
            pass
        assert eyes.take(0.1) is None


def test_two_sources_are_taken_together_and_a_single_one_serves_both(stream: Stream) -> None:
    address = stream.server.address
    with StereoReader((address, address), (), camera.Params(width=80, height=30), Clock()) as eyes:
        both = take(eyes)
        assert both.shape == (2, 30, 80) and abs(int(both[0, 0, 0]) - int(both[1, 0, 0])) <= 3
    with StereoReader((address,), (), camera.Params(width=80, height=30), Clock(), mono=True) as eyes:
        left, right = take(eyes)
        np.testing.assert_array_equal(left, right)


def test_a_pipe_and_a_file_are_sources(tmp_path: Path) -> None:
    path = tmp_path / "eyes.mp4"
    with video_io.open_writer(path, 80, 30, 30) as write:
        for number in range(12):
            write(pair(10 * number)[..., None].repeat(3, axis=-1))
    with StereoReader((str(path),), (), EYE, Clock()) as eyes:
        assert take(eyes).shape == (2, 30, 40)
    fifo = tmp_path / "pipe"
    os.mkfifo(fifo)
    content = b"YUV4MPEG2 W80 H30 F30:1 Ip A1:1 Cmono\n" + 200 * (b"FRAME\n" + pair(7).tobytes())

    def fill() -> None:
        with contextlib.suppress(BrokenPipeError):  # nobody reads it to its end
            fifo.write_bytes(content)

    writer = threading.Thread(target=fill, daemon=True)
    writer.start()
    with StereoReader((str(fifo),), (), EYE, Clock()) as eyes:
        assert take(eyes)[:, 0, 0].tolist() == [7, 248]
    writer.join(10)


def test_sources_that_do_not_fit_are_one_line(stream: Stream, tmp_path: Path) -> None:
    address, clock = stream.server.address, Clock()
    for sources, eye, words in (
        ((address,), camera.Params(width=64, height=48), "calibrate-camera"),
        ((str(tmp_path / "none.mp4"),), EYE, "found no file"),
        (("tcp://127.0.0.1:9",), EYE, "does not open"),
    ):
        with pytest.raises(InputError) as error, StereoReader(sources, (), eye, clock):
            pass
        assert words in str(error.value) and "\n" not in str(error.value)


def test_what_is_live_and_what_is_a_file() -> None:
    assert live_source.is_live("rtsp://camera/left") and live_source.is_live("tcp://127.0.0.1:5600")
    assert not live_source.is_live("concat:a.mp4") and not live_source.is_live("file:///etc/passwd")
    assert not live_source.is_live("/dev/null") and not live_source.is_live("a://b.mp4")


def test_watch_takes_a_live_stream(stream: Stream, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    address = stream.server.address
    flags = ["--stereo", "side-by-side", "--seconds", "0.5", "--out", str(tmp_path), "--no-overlay"]
    assert main.main(["watch", address, *flags]) == 0
    (folder,) = tmp_path.iterdir()
    assert folder.name == address.replace("://", "-").replace(".", "-").replace(":", "-")
    table = pyarrow.csv.read_csv(folder / "response.csv")
    assert table.num_rows == 15 and table["time"].to_pylist()[0] == 0
    assert main.main(["watch", address, "--seconds", "0"]) == 2
    assert "--seconds above 0" in capsys.readouterr().err.splitlines()[-1]
