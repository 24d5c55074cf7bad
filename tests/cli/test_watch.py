"""`lgmdjax watch`: a disc that looms on the right excites the right eye; a bad video leaves no files."""

import io
import json
import math
import os
import signal
import time
from fractions import Fraction
from pathlib import Path

import av
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from lgmdjax.cli import main
from lgmdjax.cli.watch import StereoLayout, detect_looming
from lgmdjax.cli.watch_files import Detectors
from lgmdjax.detectors import alarm, lgmd
from lgmdjax.errors import InputError
from lgmdjax.reporting import lgmd_overlay, video_io

WIDTH, HEIGHT, FRAMES = 96, 64, 40


def background() -> np.ndarray:
    """Return a picture of coarse noise, always the same."""
    coarse = np.random.default_rng(0).integers(100, 180, (HEIGHT // 8, WIDTH // 8), np.uint8)
    return coarse.repeat(8, axis=0).repeat(8, axis=1)


def looming(x: float, frames: int = FRAMES) -> np.ndarray:
    """Return frames of a dark disc that approaches column x at constant speed (-1: no disc); (frame, row, column)."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    grey = []
    for distance in np.linspace(3, 0.3, FRAMES)[:frames]:
        coverage = np.clip(6 / distance - np.hypot(columns - x, rows - HEIGHT / 2) + 0.5, 0, 1) * (x >= 0)
        grey.append(background() * (1 - coverage) + 30 * coverage)
    return np.asarray(grey).astype(np.uint8)


def save(path: Path, frames: np.ndarray, rate: int = 30) -> Path:
    with video_io.open_writer(path, frames.shape[2], frames.shape[1], rate) as write:
        for grey in frames:
            write(grey[..., None].repeat(3, axis=-1))
    return path


def run(path: Path, *flags: str) -> pa.Table:
    """Run `lgmdjax watch` on a video, and return the table of responses."""
    assert main.main(["watch", str(path), "--out", str(path.parent / "out"), *flags]) == 0
    folder = path.parent / "out" / path.name
    assert sorted(file.suffix for file in folder.iterdir()) == sorted([".json", ".mp4", ".png", _suffix(flags)])
    found = folder / f"response{_suffix(flags)}"
    return pyarrow.csv.read_csv(found) if found.suffix == ".csv" else pyarrow.parquet.read_table(found)


def _suffix(flags: tuple[str, ...]) -> str:
    return ".parquet" if "parquet" in flags else ".csv"


def stderr_lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return the lines on stderr, without those of progress bars."""
    return [line for line in capsys.readouterr().err.splitlines() if line and not line.startswith("watch:")]


def column(table: pa.Table, name: str) -> np.ndarray:
    return table[name].to_numpy()


def test_a_disc_on_the_right_excites_the_right_eye(tmp_path: Path) -> None:
    table = run(save(tmp_path / "disc.mp4", looming(72)), "--mono")
    assert column(table, "frame").tolist() == list(range(FRAMES))
    assert np.allclose(column(table, "time"), np.arange(FRAMES) / 30)
    u_left, u_right = column(table, "u_left"), column(table, "u_right")
    assert u_left[0] == u_right[0] == 0.5
    assert u_right[-5:].min() > 0.8
    assert u_left.max() < 0.55
    assert u_right[-1] > u_right[20] > u_right[1]
    assert column(table, "feed_forward_right")[-1] > 1


def test_responses_equal_those_of_the_detector(tmp_path: Path) -> None:
    """`lgmd.step` gives the same u for the frames that are decoded from the video."""
    path = save(tmp_path / "disc.mp4", looming(40))
    table = run(path, "--mono", "--overlap", "0.75", "--threshold", "3", "--table", "parquet")
    params = lgmd.Params(threshold=3.0)
    with video_io.open_reader(path) as video:
        frames = [frame.picture.astype(float) for frame in video.frames(WIDTH, HEIGHT)]
    for name, columns in (("left", slice(0, 72)), ("right", slice(24, 96))):
        state, u = lgmd.init(params, jnp.asarray(frames[0][:, columns])), []
        for frame in frames:
            state, response = lgmd.step(params, state, jnp.asarray(frame[:, columns]))
            u.append(float(response.u))
        assert np.allclose(column(table, f"u_{name}"), u, atol=1e-6)
    metadata = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert json.loads(metadata["lgmd"])["threshold"] == 3
    assert json.loads(metadata["units"])["time"] == "s"
    assert json.loads(metadata["eyes"]) == {
        **{"stereo": False, "overlap": 0.75, "ground": 0.0, "width": 320},
        **{"pooling": 1, "falloff": 0.0},
    }


def test_the_field_of_the_detectors_can_be_set(tmp_path: Path) -> None:
    """u is that of `lgmd.step` for the upper rows, those of the right eye mirrored, with weights by bearing."""
    path = save(tmp_path / "disc.mp4", looming(72))
    flags = ("--ground", "0.25", "--falloff", "2", "--fov", "120", "--pooling", "3", "--threshold", "1")
    table = run(path, *flags)
    params = lgmd.Params(threshold=1.0, pooling=3, falloff=2.0, edges=(math.radians(60.0), 0.0))
    with video_io.open_reader(path) as video:
        frames = [jnp.asarray(frame.picture.astype(float)) for frame in video.frames(WIDTH, HEIGHT)]
    rows, half = HEIGHT * 3 // 4, WIDTH // 2
    for name, columns in (("left", slice(0, half)), ("right", slice(WIDTH, half - 1, -1))):
        state, u = lgmd.init(params, frames[0][:rows, columns]), []
        for frame in frames:
            state, response = lgmd.step(params, state, frame[:rows, columns])
            u.append(float(response.u))
        assert np.allclose(column(table, f"u_{name}"), u, atol=1e-6)


def test_stereo_gives_each_eye_its_own_picture(tmp_path: Path) -> None:
    """The disc is in the right picture only, on its right side."""
    pair = np.concatenate([looming(-1), looming(72)], axis=2)
    table = run(save(tmp_path / "pair.mp4", pair), "--stereo", "side-by-side")
    assert column(table, "u_right")[-1] > 0.9
    assert column(table, "u_left").max() < 0.55
    mirrored = run(save(tmp_path / "mirrored.mp4", pair[:, :, ::-1]), "--stereo", "side-by-side")
    assert column(mirrored, "u_left")[-1] > 0.9
    assert column(mirrored, "u_right").max() < 0.55


def test_large_videos_are_averaged_down(tmp_path: Path) -> None:
    large = looming(72).repeat(4, axis=1).repeat(4, axis=2)
    small = run(save(tmp_path / "small.mp4", looming(72)))
    large = run(save(tmp_path / "large.mp4", large), "--width", str(WIDTH))
    assert np.allclose(column(large, "u_right"), column(small, "u_right"), atol=0.1)


def test_the_overlay_shows_every_frame_and_marks_the_cells_above_threshold(tmp_path: Path) -> None:
    run(save(tmp_path / "disc.mp4", looming(72)), "--mono")
    with av.open(str(tmp_path / "out" / "disc.mp4" / "overlay.mp4")) as container:
        assert container.streams.video[0].codec_context.name in ("h264", "libx264")
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(frames) == FRAMES
    overlay = lgmd_overlay.make_layout(HEIGHT, WIDTH // 2)
    height, width = HEIGHT * overlay.scale, WIDTH // 2 * overlay.scale
    for name, orange_expected in zip(lgmd_overlay.PANEL_TITLES, (True, False, False, True), strict=True):
        top, left = overlay.panel_corners[lgmd_overlay.PANEL_TITLES.index(name)]
        for side, is_excited in ((0, False), (1, True)):
            x = left + side * (width + lgmd_overlay.GAP)
            panel = frames[-1][top : top + height, x : x + width]
            orange = np.mean(panel[..., 0] - panel[..., 2] > 60)
            assert (orange > 0.005) == (orange_expected and is_excited), (name, side, orange)


def test_an_approach_raises_an_alarm_and_a_script_hears_of_it(tmp_path: Path) -> None:
    """The disc comes on the right; the alarm begins while it grows, and is the same in table, JSON and exit code."""
    path = save(tmp_path / "disc.mp4", looming(72))
    flags = ["--out", str(tmp_path / "out"), "--no-overlay", "--alarm.exit-code", "--table", "parquet"]
    assert main.main(["watch", str(path), *flags]) == main.ALARM_CODE == 3
    table = pyarrow.parquet.read_table(tmp_path / "out" / "disc.mp4" / "response.parquet")
    (raised,) = json.loads((tmp_path / "out" / "disc.mp4" / "alarms.json").read_text())["alarms"]
    is_alarm = column(table, "alarm") > 0
    adapted = np.maximum(column(table, "adapted_left"), column(table, "adapted_right"))
    lasting = np.convolve(adapted >= 0.6, np.ones(3))[:FRAMES] == 3  # 0.1 s at 30 frames a second
    np.testing.assert_array_equal(is_alarm, lasting)
    assert raised["start"] == pytest.approx(column(table, "time")[is_alarm][0]) and raised["start"] > 0.3
    assert raised["end"] == pytest.approx(column(table, "time")[is_alarm][-1] + 1 / 30)
    assert main.main(["watch", str(path), *flags, "--alarm.threshold", "0.99"]) == 0


@pytest.mark.parametrize(
    ("kind", "flags", "words"),
    [
        ("missing", (), "found no file"),
        ("text", (), "expected a video"),
        ("truncated", (), "get the whole file"),
        ("short", (), "3 frames or more, got 2"),
        ("odd", ("--stereo", "side-by-side"), "even width"),
        ("good", ("--stereo", "side-by-side", "--mono"), "got both"),
        ("good", ("--threshold", "-1"), "lgmd threshold"),
        ("good", ("--suppression", "nan"), "lgmd suppression"),
        ("good", ("--overlap", "0.2"), "overlap"),
        ("good", ("--alarm.threshold", "0.3"), "alarm threshold"),
        ("good", ("--width", "8"), "16 px or more"),
        ("good", ("--width", "-8"), "16 px or more"),
        ("good", ("--out", ""), "a value for --out, got an empty one"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_files(
    tmp_path: Path, kind: str, flags: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "video.mp4"
    if kind == "text":
        path.write_text("no video")
    elif kind == "odd":
        with av.open(str(path), "w") as container:
            stream = container.add_stream("mpeg4", rate=30)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height, stream.pix_fmt = WIDTH + 1, HEIGHT, "yuv420p"
            container.mux(stream.encode(av.VideoFrame(WIDTH + 1, HEIGHT, "yuv420p")))
            container.mux(stream.encode())
    elif kind == "truncated":
        path = tmp_path / "video.mkv"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("mpeg4", rate=30)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            for grey in looming(72):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="gray")))
            container.mux(stream.encode())
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif kind != "missing":
        save(path, looming(72, 2 if kind == "short" else FRAMES))
    code = main.main(["watch", str(path), "--out", str(tmp_path / "out"), *flags])
    lines = stderr_lines(capsys)
    assert code == 2
    assert len(lines) == 1 and lines[0].startswith("lgmdjax: ") and words in lines[0], lines
    assert not any(file.is_file() for file in (tmp_path / "out").rglob("*"))


def test_a_failure_keeps_the_files_of_an_earlier_call(tmp_path: Path) -> None:
    path = save(tmp_path / "disc.mp4", looming(72))
    run(path)
    before = {file.name: file.read_bytes() for file in (tmp_path / "out" / "disc.mp4").iterdir()}
    save(path, looming(72, 2))
    assert main.main(["watch", str(path), "--out", str(tmp_path / "out")]) == 2
    assert {file.name: file.read_bytes() for file in (tmp_path / "out" / "disc.mp4").iterdir()} == before


def test_each_video_has_a_folder_with_one_table(tmp_path: Path) -> None:
    """`run` checks the files of a folder: the table has the format of the last call."""
    first = save(tmp_path / "disc.mp4", looming(72))
    second = tmp_path / "disc.mkv"
    second.write_bytes(first.read_bytes())
    still = column(run(first), "u_right")
    run(second, "--table", "parquet")
    run(second, "--table", "csv")
    assert sorted(folder.name for folder in (tmp_path / "out").iterdir()) == ["disc.mkv", "disc.mp4"]
    np.testing.assert_array_equal(column(run(first, "--table", "parquet"), "u_right"), still)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path / "disc.mp4", looming(72))
    assert main.main(["watch", str(path), "--out", str(path)]) == 2
    assert len(lines := stderr_lines(capsys)) == 1 and "can be written" in lines[0]


def test_an_unusual_frame_rate_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path / "fast.mp4", looming(72), rate=120)
    detect_looming(path, tmp_path / "out", layout=StereoLayout(), params=Detectors(lgmd.Params(), alarm.Params()))
    captured = capsys.readouterr()
    assert not captured.out
    assert "120 frames a second" in captured.err and "--threshold 1.5 --suppression 5" in captured.err


def test_without_an_overlay_the_responses_are_the_same(tmp_path: Path) -> None:
    path = save(tmp_path / "disc.mp4", looming(72))
    assert main.main(["watch", str(path), "--out", str(tmp_path / "out")]) == 0
    folder = tmp_path / "out" / "disc.mp4"
    with_overlay = (folder / "response.csv").read_bytes()
    assert main.main(["watch", str(path), "--out", str(tmp_path / "out"), "--no-overlay"]) == 0
    assert (folder / "response.csv").read_bytes() == with_overlay
    assert sorted(file.name for file in folder.iterdir()) == ["alarms.json", "response.csv", "response.png"]


@pytest.mark.parametrize("name", ["12:30:05.mp4", "-x.mp4", b"caf\xe9.mp4"])
def test_any_name_of_a_video_will_do(tmp_path: Path, name: str | bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names that look like protocols or flags, that are not UTF-8, and ~."""
    path = save(tmp_path / "a.mp4", looming(72, 4)).rename(tmp_path / os.fsdecode(name))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), "utf-8"))  # pytest cannot read such names
    assert main.main(["watch", "--out", "~/out", "--table", "parquet", "--", path.name]) == 0
    written = sorted(file.name for file in (tmp_path / "out" / path.name).iterdir())
    assert written == ["alarms.json", "overlay.mp4", "response.parquet", "response.png"]


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])  # of the locales C.UTF-8 and POSIX
def test_the_names_of_files_are_printed_as_they_are(
    tmp_path: Path, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save(tmp_path / "a.mp4", looming(72, 4)).rename(tmp_path / os.fsdecode(b"caf\xe9.mp4"))
    printed = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(printed, encoding, write_through=True))
    assert main.main(["watch", str(path), "--out", str(tmp_path / "out"), "--no-overlay"]) == 0
    assert printed.getvalue().split(b"\n")[0].endswith(b"out/caf\xe9.mp4/response.csv")


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_signal_leaves_no_files(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The signal comes when the overlay is written in part."""
    path, number = save(tmp_path / "disc.mp4", looming(72, 4)), signal.Signals[name]
    handler = signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL
    before = signal.signal(number, handler)  # a shell's background job ignores some signals
    monkeypatch.setattr(
        "lgmdjax.reporting.lgmd_overlay.render_overlay", lambda *_: os.kill(os.getpid(), number) or time.sleep(1)
    )
    assert main.main(["watch", str(path), "--out", str(tmp_path / "out")]) == 128 + number
    (line,) = stderr_lines(capsys)
    assert line == "lgmdjax: interrupted; the same command starts again"
    assert not [file for file in (tmp_path / "out").rglob("*") if file.is_file()]
    assert signal.signal(number, before) == handler


def test_oblong_pixels_are_made_square(tmp_path: Path) -> None:
    """The picture of a video of 96 x 64 pixels, each 3/2 as wide as high, has 64 : 43 as its sides."""
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=30)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(3, 2)
        for grey in looming(72, 4):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="gray")))
        container.mux(stream.encode())
    run(path)
    layout = lgmd_overlay.make_layout(43, WIDTH // 2)
    with av.open(str(tmp_path / "out" / "a.mp4" / "overlay.mp4")) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == layout.size


def test_an_overlay_too_large_for_a_video_is_refused() -> None:
    with pytest.raises(InputError, match="no-overlay"):
        lgmd_overlay.make_layout(2000, 4000)
