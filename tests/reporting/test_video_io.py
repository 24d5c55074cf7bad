"""Videos are read as they were written; a damaged file gives an error instead of a shorter video."""

import io
import os
import struct
import threading
import wave
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from lgmdjax.errors import InputError
from lgmdjax.reporting import video_geometry, video_io

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
        stream.options = dict(options)
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


CORNERS = ((220, 150), (100, 61))  # grey of a picture's corners as it is stored


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        ((1, 0, 0, 1), ((220, 150), (100, 61))),
        ((-1, 0, 0, 1), ((150, 220), (61, 100))),  # a mirror, as in selfies
        ((1, 0, 0, -1), ((100, 61), (220, 150))),
        ((-1, 0, 0, -1), ((61, 100), (150, 220))),
        ((0, 1, -1, 0), ((100, 220), (61, 150))),
        ((0, -1, 1, 0), ((150, 61), (220, 100))),
        ((0, 1, 1, 0), ((220, 100), (150, 61))),
        ((0, -1, -1, 0), ((61, 150), (100, 220))),
    ],
)
def test_pictures_are_brought_upright(
    tmp_path: Path, matrix: tuple[int, int, int, int], expected: tuple[tuple[int, int], ...]
) -> None:
    """The matrix in the track's header, which players apply; corners are those that `ffmpeg` shows."""
    stored = np.array(CORNERS, np.uint8).repeat(HEIGHT // 2, 0).repeat(WIDTH // 2, 1)
    path = encode(tmp_path / "a.mp4", np.stack([stored] * 4))

    def header(a: int, b: int, c: int, d: int) -> bytes:
        return struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)

    content = path.read_bytes()
    at = content.index(header(1, 0, 0, 1), content.index(b"tkhd"))
    path.write_bytes(content[:at] + header(*matrix) + content[at + 36 :])
    with video_io.open_reader(path) as video:
        picture = next(video.frames(video.width, video.height)).picture
    rows, columns = picture.shape
    assert (columns, rows) == ((HEIGHT, WIDTH) if matrix[0] == 0 else (WIDTH, HEIGHT))
    corners = picture[rows // 4 :: rows // 2, columns // 4 :: columns // 2]
    assert np.allclose(corners, expected, atol=2)


@pytest.mark.parametrize("pixels", ["yuv420p", "yuv420p10le", "yuv444p"])
@pytest.mark.parametrize("matrix", [1, 5, 9])  # BT.709, BT.601, BT.2020 in ISO/IEC 23001-8
def test_grey_levels_are_those_of_the_standard(tmp_path: Path, pixels: str, matrix: int) -> None:
    """Y = 16 + 219 grey / 255 for 8 bits, whatever the matrix of the colours; also when the picture is averaged."""
    grey = np.arange(0, 256, 5)
    bits = 2 if "10" in pixels else 0
    luma = np.round((16 + 219 * grey / 255) * 2**bits).repeat(4)[None].repeat(16, 0)
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = luma.shape[1], 16, pixels
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, 1
        frame = av.VideoFrame(luma.shape[1], 16, pixels)
        frame.colorspace, frame.color_range = matrix, 1
        for index, plane in enumerate(frame.planes):
            columns = plane.line_size // (2 if bits else 1)
            stored = np.full((plane.height, columns), 128 << bits, "<u2" if bits else "u1")
            if index == 0:
                stored[:, : luma.shape[1]] = luma
            plane.update(stored.tobytes())
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    for width in (luma.shape[1], luma.shape[1] // 2):
        picture = read(path, width, 16 * width // luma.shape[1])[0].picture
        assert np.abs(picture[2].reshape(len(grey), -1) - grey[:, None].astype(int)).max() <= 1
        assert abs((picture[2].reshape(len(grey), -1)[:, 0] - grey.astype(int)).mean()) < 0.3


def write_last(path: Path, shown: float) -> Path:
    """Write 30 frames a second, the last of which is shown for some seconds."""
    codec, rate = ("gif", 25) if path.suffix == ".gif" else ("h264", 30)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray" if codec == "gif" else "yuv420p"
        stream.codec_context.max_b_frames = 0
        frames = [av.VideoFrame.from_ndarray(grey, format="gray") for grey in pictures()]
        packets = [packet for frame in [*frames, None] for packet in stream.encode(frame)]
        for packet in packets:
            packet.duration = round((shown if packet is packets[-1] else 1 / rate) / packet.time_base)
            container.mux(packet)
    return path


@pytest.mark.parametrize(("name", "rate"), [("a.mp4", 30), ("a.mov", 30), ("a.mkv", 30), ("a.gif", 25)])
def test_a_last_frame_that_is_shown_for_long_is_no_damage(tmp_path: Path, name: str, rate: int) -> None:
    path = write_last(tmp_path / name, 3.0)
    with video_io.open_reader(path) as video:
        assert video.rate == rate
        assert len(list(video.frames(WIDTH, HEIGHT))) == FRAMES
    if name != "a.gif":  # which declares no duration
        with pytest.raises(InputError, match=r"whole file|is truncated"):
            read(truncate(path, 0.8))


def test_the_shape_of_pixels_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=30)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        container.mux(stream.encode(av.VideoFrame(WIDTH, HEIGHT, "yuv420p")))
        container.mux(stream.encode())
    with video_io.open_reader(path) as video:
        assert video.pixel_aspect == Fraction(4, 3)
    assert video_geometry.square_size(WIDTH, HEIGHT, Fraction(4, 3)) == (96, 48)


def test_lost_packets_are_refused(tmp_path: Path) -> None:
    """What is read is what was written: only packets without pictures may be lost."""
    path = encode(tmp_path / "a.ts", pictures())
    written = [frame.picture for frame in read(path)]
    content = path.read_bytes()
    packets = [content[at : at + 188] for at in range(0, len(content), 188)]
    refused = 0
    for lost in range(len(packets) // 4, len(packets) - 12, 3):
        path.write_bytes(b"".join(packets[:lost] + packets[lost + 1 :]))
        try:
            np.testing.assert_array_equal([frame.picture for frame in read(path)], written)
        except InputError as error:
            assert "lost or damaged" in str(error)
            refused += 1
    assert refused > 10


@pytest.mark.parametrize(("name", "codec", "least"), [("a.mp4", "h264", 6), ("a.avi", "mpeg4", 6)])
def test_flipped_bits_are_told(tmp_path: Path, name: str, codec: str, least: int) -> None:
    """These codecs have no checksums, but their decoders see some of the damage."""
    noise = np.random.default_rng(0).integers(0, 256, (5, HEIGHT, WIDTH), np.uint8)
    path = encode(tmp_path / name, noise, codec)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    told = 0
    for at in rng.integers(len(content) // 4, len(content) - 1500, 20):
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            read(path)
        except InputError:
            told += 1
    assert told >= least, told


def test_a_recording_may_begin_between_key_frames(tmp_path: Path) -> None:
    path = encode(tmp_path / "a.ts", pictures(), "mpeg2video", g="12")
    content = path.read_bytes()
    path.write_bytes(content[188 * (len(content) // 188 // 5) :])
    with video_io.open_reader(path) as video:
        assert 0 < len(list(video.frames(WIDTH, HEIGHT))) < FRAMES


@pytest.mark.parametrize("name", ["12:30:05.mp4", "concat:a.mp4", "-x.mp4", b"caf\xe9.mp4"])
def test_names_are_no_protocols(tmp_path: Path, name: str | bytes) -> None:
    written = encode(tmp_path / "a.mp4", pictures(4))
    path = written.rename(tmp_path / os.fsdecode(name))
    assert len(read(path)) == 4
    with video_io.open_writer(path, WIDTH, HEIGHT, 30) as write:
        write(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert len(read(path)) == 1


@pytest.mark.parametrize(
    "playlist",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\na.ts\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile a.ts\n",
    ],
)
def test_a_playlist_opens_no_other_file(tmp_path: Path, playlist: str, monkeypatch: pytest.MonkeyPatch) -> None:
    encode(tmp_path / "a.ts", pictures(4))
    (tmp_path / "list.mp4").write_text(playlist)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="names other files"):
        read(tmp_path / "list.mp4")


def test_a_pipe_is_read(tmp_path: Path) -> None:
    content = encode(tmp_path / "a.ts", pictures()).read_bytes()
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=(content,))
    writer.start()
    assert len(read(tmp_path / "pipe")) == FRAMES
    writer.join()


def test_the_cover_of_a_sound_file_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "a.m4a"
    with av.open(str(path), "w", format="mp4") as container:
        sound, cover = container.add_stream("aac", rate=8000), container.add_stream("mjpeg", rate=1)
        assert isinstance(sound, av.AudioStream) and isinstance(cover, av.VideoStream)
        cover.width, cover.height, cover.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        container.mux(cover.encode(av.VideoFrame(WIDTH, HEIGHT, "yuvj420p")))
        container.mux(cover.encode())
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        silence.rate = 8000
        container.mux(sound.encode(silence))
        container.mux(sound.encode())
    with pytest.raises(InputError, match="no pictures"):
        read(path)


@pytest.mark.parametrize(
    ("name", "options"), [("a.mp4", {}), ("a.mp4", {"movflags": "faststart"}), ("a.mkv", {}), ("a.avi", {})]
)
def test_a_truncated_video_is_refused(tmp_path: Path, name: str, options: dict[str, str]) -> None:
    path = truncate(encode(tmp_path / name, pictures(), **options), 0.6)
    with pytest.raises(InputError, match=r"^expected .*video.* got .*; (get the whole file.*|try to play it)$"):
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
