"""Videos are read as they were written; a damaged file gives an error instead of a shorter video."""

import io
import struct
import wave
from pathlib import Path

import av
import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.reporting import video_io

WIDTH, HEIGHT, FRAMES = 96, 64, 30


def pictures(frames: int = FRAMES) -> np.ndarray:
    """Return grey pictures of a bright bar that moves over coarse noise, which changes in each frame."""
    coarse = np.random.default_rng(0).integers(0, 60, (frames, HEIGHT // 8, WIDTH // 8), np.uint8)
    grey = coarse.repeat(8, axis=1).repeat(8, axis=2)
    for i in range(frames):
        grey[i, :, 2 * i : 2 * i + 8] = 220
    return grey


def encode(path: Path, frames: np.ndarray, codec: str = "h264", **options: str) -> Path:
    """Write a video with PyAV alone, in the container given by the name's suffix."""
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=30)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        for grey in frames:
            picture = np.repeat(grey[..., None], 3, axis=-1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path


def read(path: Path, width: int = WIDTH, height: int = HEIGHT) -> list[video_io.Frame]:
    with video_io.open_reader(path) as video:
        return list(video.frames(width, height))


def truncate(path: Path, fraction: float) -> Path:
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    return path


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "h264"), ("a.mkv", "h264"), ("a.avi", "mpeg4"), ("a.webm", "vp9")]
)
def test_every_frame_is_read_with_its_time(tmp_path: Path, name: str, codec: str) -> None:
    written = pictures()
    path = encode(tmp_path / name, written, codec)
    with video_io.open_reader(path) as video:
        frames = list(video.frames(WIDTH, HEIGHT))
        assert (video.width, video.height, float(video.rate)) == (WIDTH, HEIGHT, 30)
    assert len(frames) == FRAMES
    times = np.array([frame.time for frame in frames])
    assert np.allclose(times - times[0], np.arange(FRAMES) / 30, atol=2e-3)
    error = np.abs(np.stack([frame.picture for frame in frames]).astype(float) - written)
    assert error.mean(axis=(1, 2)).max() < 8  # grey levels lost by the codec; an offset by one frame would give 27


def test_videos_are_written_as_h264_and_keep_their_grey_levels() -> None:
    file = io.BytesIO()
    with video_io.open_writer(file, 32, 16, 30) as write:
        for shade in (0, 100, 255):
            write(np.full((16, 32, 3), shade, np.uint8))
    file.seek(0)
    with av.open(file, "r") as container:
        assert container.streams.video[0].codec_context.name in ("h264", "libx264")
        shades = [frame.to_ndarray(format="gray").mean() for frame in container.decode(video=0)]
    assert np.allclose(shades, (0, 100, 255), atol=1.5)


def test_smaller_pictures_are_area_averaged(tmp_path: Path) -> None:
    stripes = np.zeros((3, HEIGHT, WIDTH), np.uint8)
    stripes[:, :, ::2] = 200
    for frame in read(encode(tmp_path / "a.mp4", stripes, preset="veryslow"), WIDTH // 4, HEIGHT // 4):
        assert np.allclose(frame.picture, 100, atol=5)


@pytest.mark.parametrize(("turn", "corner"), [((0, 1, -1, 0), "top right"), ((-1, 0, 0, -1), "bottom right")])
def test_rotated_pictures_are_turned_upright(tmp_path: Path, turn: tuple[int, int, int, int], corner: str) -> None:
    """The matrix in the track's header, which players apply, moves a bright top left corner elsewhere."""
    bright = np.zeros((4, HEIGHT, WIDTH), np.uint8)
    bright[:, : HEIGHT // 2, : WIDTH // 2] = 220
    path = encode(tmp_path / "a.mp4", bright)

    def matrix(a: int, b: int, c: int, d: int) -> bytes:
        return struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)

    content = path.read_bytes()
    at = content.index(matrix(1, 0, 0, 1), content.index(b"tkhd"))
    path.write_bytes(content[:at] + matrix(*turn) + content[at + 36 :])
    with video_io.open_reader(path) as video:
        frames = list(video.frames(video.width, video.height))
    rows, columns = frames[0].picture.shape
    assert (columns, rows) == ((HEIGHT, WIDTH) if turn[0] == 0 else (WIDTH, HEIGHT))
    halves = {"top": slice(0, rows // 2), "bottom": slice(rows // 2, rows)}
    sides = {"left": slice(0, columns // 2), "right": slice(columns // 2, columns)}
    means = {f"{v} {h}": frames[0].picture[halves[v], sides[h]].mean() for v in halves for h in sides}
    assert max(means, key=means.__getitem__) == corner
    assert means[corner] > 200


@pytest.mark.parametrize(
    ("name", "options"), [("a.mp4", {}), ("a.mp4", {"movflags": "faststart"}), ("a.mkv", {}), ("a.avi", {})]
)
def test_a_truncated_video_is_refused(tmp_path: Path, name: str, options: dict[str, str]) -> None:
    path = truncate(encode(tmp_path / name, pictures(), **options), 0.6)
    with pytest.raises(InputError, match=r"^expected .*video.* got .*; (get the whole file|try to play it)$"):
        read(path)


def test_sound_longer_than_the_pictures_is_no_damage(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream, sound = container.add_stream("h264", rate=30), container.add_stream("aac", rate=8000)
        assert isinstance(stream, av.VideoStream) and isinstance(sound, av.AudioStream)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for grey in pictures(10):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="gray")))
        for start in range(0, 24_000, 1024):
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            silence.rate, silence.pts = 8000, start
            container.mux(sound.encode(silence))
        container.mux(stream.encode())
        container.mux(sound.encode())
    assert len(read(tmp_path / "a.mkv")) == 10


def test_files_without_video_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("hello " * 1000)
    (tmp_path / "empty.mp4").touch()
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(16000))
    for name, words in [
        ("text.mp4", "expected a video"),
        ("empty.mp4", "expected a video"),
        ("sound.wav", "no pictures"),
        ("nowhere.mp4", "found no file"),
        (".", "found no file"),
    ]:
        with pytest.raises(InputError, match=words) as caught:
            read(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_odd_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="even width"), video_io.open_writer(tmp_path / "a.mp4", 33, 16, 30):
        pass
    assert not (tmp_path / "a.mp4").exists()
