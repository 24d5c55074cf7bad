"""Data sets of recorded walks, read back by libraries and by code of the tests' own."""

import csv
import gzip
import json
import os
from dataclasses import replace
from pathlib import Path

import av
import jax
import numpy as np
import pandas as pd
import polars as pl
import pyarrow.parquet as pq
import pytest
import synthetic

from lgmdjax.cli import main
from lgmdjax.datasets import card, exporter, pictures, recorded, statistics
from lgmdjax.errors import InputError
from lgmdjax.sensors import hemifield
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, episodes, rerender, room_batches
from lgmdjax.simulation.closed_loop import Record

ROBOTS, FRAMES, SEED = 2, 40, 3
EYES = CameraSettings(width=32, height=24, overlap=0.5, ground=0.5, pooling=2)
DETECTOR = {"threshold": 0.25, "suppression": 255.0, "inhibition": 0.1}
PARAMETERS = {"robots": ROBOTS, "seconds": FRAMES / 30, "lgmd": DETECTOR}
PARAMETERS["eyes"] = {name: getattr(EYES, name) for name in ("width", "height", "overlap", "ground", "pooling")}


def walk_of(robots: int, frames: int) -> Record:
    """Robot 0 is reset in its middle, robot 1 falls near its end."""
    rng = np.random.default_rng(0)
    joints = rng.normal(size=(robots, frames, 6, 3))
    record = synthetic.walk(robots, frames, joints=joints, velocity=rng.normal(size=(robots, frames, 2)))
    record.resets[0, frames // 2 :] = 1
    record.contact[0, frames // 2 - 1] = True
    record.is_first[:, 0] = record.is_first[0, frames // 2] = True
    record.ok[1, -5:] = False
    return jax.tree.map(lambda leaf: leaf.astype(np.float32) if leaf.dtype == float else leaf, record)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder as collect leaves it, whose u is that of the pictures of its rooms."""
    folder = tmp_path_factory.mktemp("runs") / "mine"
    with jax.enable_x64(False):
        rooms = room_batches.training_rooms(SEED, 0, ROBOTS).arena
        record = walk_of(ROBOTS, FRAMES)
        record = replace(record, position=record.position + np.asarray([[0, 0, 0.1]], np.float32))
        seen = rerender.render_walks(assembly.camera_params(EYES), rooms, record)
        detector = assembly.fit_detector(assembly.lgmd_params(DETECTOR), EYES)
        u = [pictures.respond(detector, *pair) for pair in zip(seen, record.is_first, strict=True)]
    writer = episodes.Writer(folder / "collect" / "episodes", PARAMETERS)
    writer.write(replace(record, u=np.stack(u)), episode=0, rooms=[0, 1], seed=SEED)
    return folder


def test_the_recorded_files_are_read_with_their_units_by_pandas_and_polars(run: Path):
    (path,) = (run / "collect" / "episodes").glob("*.parquet")
    walks = episodes.read(path.parent)
    expected = np.concatenate([walk.joints[:, 2, 1] for walk in walks])
    frame = pd.read_parquet(path)
    np.testing.assert_array_equal(frame["joint_7"], expected)
    assert frame.attrs["units"]["joint_7"] == "rad" and frame.attrs["units"]["x"] == "m"
    assert frame.attrs["meanings"]["clearance"].startswith("smallest distance")
    np.testing.assert_array_equal(pl.read_parquet(path)["joint_7"].to_numpy(), expected)
    assert json.loads(pl.read_parquet_metadata(path)["lgmdjax"])["units"]["velocity_left"] == "0.05 m/s"


def test_parquet_and_csv_hold_every_frame_exactly(run: Path, tmp_path: Path):
    exporter.export(run, tmp_path / "parquet", "parquet")
    exporter.export(run, tmp_path / "csv", "csv")
    walks = episodes.read(run / "collect" / "episodes")
    columns = {"robot": [0] * FRAMES + [1] * FRAMES, "u_right": np.concatenate([walk.u[:, 1] for walk in walks])}
    columns |= {
        "ok": np.concatenate([walk.ok for walk in walks]),
        "y": [y for walk in walks for y in walk.position[:, 1]],
    }
    frame = pd.read_parquet(tmp_path / "parquet" / "walks.parquet")
    text = pd.read_csv(tmp_path / "csv" / "walks.csv", dtype={"u_right": np.float32, "y": np.float32})
    polars = pl.read_parquet(tmp_path / "parquet" / "walks.parquet")
    for name, values in columns.items():
        for found in (frame[name], text[name], polars[name].to_numpy()):
            np.testing.assert_array_equal(found, np.asarray(values))
    schema = pq.read_schema(tmp_path / "parquet" / "walks.parquet")
    assert schema.field("joint_0").metadata == {b"unit": b"rad", b"meaning": b"coxa, femur, tibia of legs 0 to 5"}
    described = json.loads((tmp_path / "csv" / "walks.csv-metadata.json").read_text())
    with (tmp_path / "csv" / "walks.csv").open() as file:
        assert next(csv.reader(file)) == [column["name"] for column in described["tableSchema"]["columns"]]
    units = {column["name"]: column.get("schema:unitText") for column in described["tableSchema"]["columns"]}
    assert (units["time"], units["distance_left"], units["ok"]) == ("s", "m", None)


def read_zarr(folder: Path) -> tuple[np.ndarray, dict]:
    """Read an array of one chunk from the specification of Zarr 3, compressed or not."""
    described = json.loads((folder / "zarr.json").read_text())
    assert described["zarr_format"] == 3 and described["node_type"] == "array"
    (chunk,) = (path for path in (folder / "c").rglob("*") if path.is_file())
    codecs = [codec["name"] for codec in described["codecs"]]
    assert codecs == ["bytes", "gzip"]
    values = np.frombuffer(gzip.decompress(chunk.read_bytes()), described["data_type"])
    return values.reshape(described["chunk_grid"]["configuration"]["chunk_shape"]), described


def test_zarr_holds_the_fields_and_the_pictures_without_loss(run: Path, tmp_path: Path):
    exporter.export(run, tmp_path / "zarr", "zarr", video=True)
    walks = episodes.read(run / "collect" / "episodes")
    joints, described = read_zarr(tmp_path / "zarr" / "joints")
    np.testing.assert_array_equal(joints, np.concatenate([walk.joints for walk in walks]))
    assert described["dimension_names"] == ["row", "leg", "joint"] and described["attributes"]["units"] == "rad"
    contact, _ = read_zarr(tmp_path / "zarr" / "contact")
    np.testing.assert_array_equal(contact, np.concatenate([walk.contact for walk in walks]))
    with jax.enable_x64(False):
        rooms = room_batches.training_rooms(SEED, 0, ROBOTS).arena
        seen = rerender.render_walks(assembly.camera_params(EYES), rooms, episodes.stack_walks(walks))
    for side, name in enumerate(("left", "right")):
        kept, _ = read_zarr(tmp_path / "zarr" / f"pictures_{name}")
        assert kept.shape == (ROBOTS * FRAMES, EYES.height, EYES.width)
        field = hemifield.crop(kept.reshape(ROBOTS, FRAMES, *kept.shape[1:]), side, overlap=0.5, ground=0.5)
        np.testing.assert_allclose(field, seen[:, :, side], atol=0.51)  # rounded to whole levels


@pytest.fixture(scope="module")
def lerobot(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "lerobot"
    exporter.export(run, folder, "lerobot", video=True)
    return folder


def test_lerobot_has_an_episode_from_each_start_to_the_next(run: Path, lerobot: Path):
    """Layout, indices and numbers as LeRobot's documentation of version 3.0 has them; no fallen robot."""
    info = json.loads((lerobot / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 30, 3, 75)
    table = pd.read_parquet(lerobot / info["data_path"].format(chunk_index=0, file_index=0))
    assert table["episode_index"].tolist() == [0] * 20 + [1] * 20 + [2] * 35
    assert table["index"].tolist() == list(range(75)) and table["frame_index"].tolist()[38:42] == [18, 19, 0, 1]
    assert np.flatnonzero(table["next.done"]).tolist() == [19, 39, 74]
    np.testing.assert_allclose(table["timestamp"], table["frame_index"] / 30, rtol=1e-6)
    walks = episodes.read(run / "collect" / "episodes")
    whole = [walks[0].velocity, walks[1].velocity[:-5]]
    np.testing.assert_array_equal(np.stack(table["action"].tolist()), np.concatenate(whole))
    assert set(info["features"]) - set(table.columns) == {"observation.images.left", "observation.images.right"}
    state = info["features"]["observation.state"]
    assert state["names"][:3] == ["left_front_coxa", "left_front_femur", "left_front_tibia"]
    assert state["info"]["unit"] == "rad" and state["shape"] == [18]
    tasks = pd.read_parquet(lerobot / "meta" / "tasks.parquet")
    assert tasks.index.name == "task" and tasks["task_index"].tolist() == [0]


def test_lerobot_statistics_are_those_of_the_data(lerobot: Path):
    info, stats = (json.loads((lerobot / "meta" / name).read_text()) for name in ("info.json", "stats.json"))
    table = pd.read_parquet(lerobot / "data" / "chunk-000" / "file-000.parquet")
    action = np.stack(table["action"].tolist()).astype(float)
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(stats["action"]["q90"], np.quantile(action, 0.9, axis=0), rtol=1e-6)
    assert set(stats) == set(info["features"]) and stats["action"]["count"] == [75]
    rows = pd.read_parquet(lerobot / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    assert rows["dataset_from_index"].tolist() == [0, 20, 40] and rows["length"].tolist() == [20, 20, 35]
    np.testing.assert_allclose(rows["stats/action/max"][2], action[40:].max(axis=0), rtol=1e-6)
    assert rows["walk/robot"].tolist() == [0, 0, 1] and rows["walk/seed"].tolist() == [SEED] * 3
    np.testing.assert_allclose(rows["videos/observation.images.left/from_timestamp"], [0, 20 / 30, 40 / 30])


def test_lerobot_videos_show_what_the_eyes_saw(run: Path, lerobot: Path):
    recording = recorded.read(run)
    with jax.enable_x64(False):
        eyes, rooms = pictures.find_camera(recording), pictures.find_rooms(recording)
        walk = recording.walks[1][: FRAMES - 5]
        expected = np.concatenate(list(pictures.render(eyes, rooms[1], walk)))
    stats = json.loads((lerobot / "meta" / "stats.json").read_text())
    for side, name in enumerate(("left", "right")):
        path = lerobot / "videos" / f"observation.images.{name}" / "chunk-000" / "file-000.mp4"
        with av.open(str(path)) as container:
            frames = [(frame.time, frame.to_ndarray(format="gray")) for frame in container.decode(video=0)]
        assert [round(time * 30) for time, _ in frames] == list(range(75))
        shown = np.stack([picture for _, picture in frames[40:]])
        assert np.abs(shown.astype(float) - expected[:, side]).mean() < 6  # of 255: H.264 loses a little
        mean = np.ravel(stats[f"observation.images.{name}"]["mean"])
        np.testing.assert_allclose(mean, np.mean([picture for _, picture in frames]) / 255, atol=0.02)


def test_statistics_of_pictures_are_those_of_their_pixels():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 6, 4)).astype(np.uint8)
    found, scaled = statistics.of_pictures(statistics.histogram(pixels), 5), pixels / 255
    for name, value in {"min": scaled.min(), "max": scaled.max(), "mean": scaled.mean(), "std": scaled.std()}.items():
        np.testing.assert_allclose(found[name], np.full((3, 1, 1), value))
    for name, q in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        np.testing.assert_allclose(found[name].ravel()[0], np.quantile(scaled, q, method="inverted_cdf"))


@pytest.mark.parametrize("format", ["lerobot", "csv"])
def test_the_card_says_what_how_units_and_licence(run: Path, format: str, lerobot: Path, tmp_path: Path):
    folder = lerobot if format == "lerobot" else tmp_path / format
    if format != "lerobot":
        exporter.export(run, folder, "csv", licence="CC-BY-4.0")
    text = (folder / card.FILE).read_text()
    front = text.split("---")[1]
    assert f"license: {'apache-2.0' if format == 'lerobot' else 'cc-by-4.0'}\n" in front
    assert "80 at 30 Hz" in text and '"threshold": 0.25' in text and "| seed of the rooms | 3 |" in text
    row = "| clearance | m | smallest distance to anything within the frame |"
    assert row in text.splitlines() and ("LeRobot" in front) == (format == "lerobot")


def test_pictures_of_other_rooms_are_refused(run: Path, tmp_path: Path):
    """The same walks said to be of another seed: the detector would not give the recorded u."""
    walks = episodes.read(run / "collect" / "episodes")
    episodes.Writer(tmp_path / "run", PARAMETERS).write(
        episodes.stack_walks(walks), episode=0, rooms=[0, 1], seed=SEED + 1
    )
    with pytest.raises(InputError, match="expected pictures that give the recorded u"):
        exporter.export(tmp_path / "run", tmp_path / "out", "zarr", video=True)
    assert not (tmp_path / "out").exists()


def test_wrong_requests_are_one_line(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    out = str(tmp_path / "out")
    unknown = tmp_path / "unknown"
    episodes.Writer(unknown, {"who": "me"}).write(walk_of(2, 12), episode=0, rooms=[0, 1], seed=0)
    for arguments, words in (
        ([str(tmp_path), out], "without; `lgmdjax collect` makes some"),
        ([str(run), out, "--format", "csv", "--video"], "--video with format lerobot or zarr, got csv"),
        ([str(run), str(tmp_path / "full")], "expected an empty or a new folder"),
        ([str(unknown), out, "--video"], "leave --video out"),
        ([str(run), out, "--licence", "MIT\ntags: [x]"], "expected a licence such as Apache-2.0"),
        ([str(run), os.fsdecode(b"caf\xe9")], "a folder with a name in UTF-8, got "),
    ):
        assert main.main(["export-dataset", *arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("lgmdjax: ") and "expected " in line and words in line
    assert not Path(out).exists()
    assert main.main(["export-dataset", str(run), out, "--format", "parquet"]) == 0
    assert capsys.readouterr().out.split() == [f"{out}/README.md", f"{out}/walks.parquet"]
