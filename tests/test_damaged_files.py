"""Every reader, on random damage to every kind of file: the same content, or one line; never another number.

200 cases run by default. LGMDJAX_TEST_DAMAGE=10000 runs as many.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
import synthetic
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from lgmdjax import paths
from lgmdjax.errors import InputError
from lgmdjax.evaluation import clip_labels
from lgmdjax.hardware import chessboard, drive_log, joint_map, lens
from lgmdjax.reporting import playback, video_io
from lgmdjax.runtime import checksums, run_folders, storage
from lgmdjax.simulation import assembly, episodes

CASES = int(os.environ.get("LGMDJAX_TEST_DAMAGE", "200"))

FACTS = ("format", "scale", "seed", "settings", "versions")  # of run.json; a damaged name of its checksum is no fact
READERS: dict[str, Callable[[Path], object]] = {
    "run.json": lambda run: {key: run_folders.read_facts(run)[key] for key in FACTS},
    "fit-gait/shaping.safetensors": lambda run: assembly.shaping.load(run / "fit-gait" / "shaping.safetensors"),
    "train/controller.safetensors": lambda run: assembly.navigator.load(run / "train" / "controller.safetensors"),
    "train/baselines.npz": lambda run: storage.read_arrays(run / "train" / "baselines.npz"),
    "collect/calibration.json": lambda run: assembly.load_detector(run / "collect"),
    "collect/episodes/chunk-00000.parquet": lambda run: episodes.read(run / "collect" / "episodes"),
    "collect/done.json": lambda run: assembly.load_detector(run / "collect"),
    "drive/drive-00000.parquet": lambda run: drive_log.joints(drive_log.read(run / "drive"), "target"),
    "walk.npz": lambda run: playback.load(run / "walk.npz"),
    "lens.json": lambda run: lens.to_json(lens.read(run / "lens.json")),
    "lens.yaml": lambda run: lens.to_json(lens.read(run / "lens.yaml")),
    "servos.toml": lambda run: vars(joint_map.read(run / "servos.toml")),
    "labels.csv": lambda run: clip_labels.read_labels(run / "labels.csv"),
    "clip.mp4": lambda run: read_video(run / "clip.mp4"),
    "board.png": lambda run: chessboard.read_grey(run / "board.png"),
}
"""A file, and what reads it."""
CHECKED = (*READERS,)[:6]
"""Files of a run folder, for which another number is never read in silence; the others come from elsewhere too."""


def read_video(path: Path) -> list[np.ndarray]:
    with video_io.open_reader(path) as video:
        return [frame.picture for frame in video.frames(16, 12)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with small files of every kind."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    for stage in ("fit-gait", "collect", "train"):
        (folder / stage).mkdir(parents=True)
    weights, _ = assembly.navigator.load(paths.PRETRAINED_DIR / "controller.safetensors")
    assembly.navigator.save(folder / "train" / "controller.safetensors", weights, {"seed": 3})
    assembly.shaping.save(folder / "fit-gait" / "shaping.safetensors", assembly.shaping.load_pretrained())
    shutil.copy(paths.PRETRAINED_DIR / "baselines.npz", folder / "train")
    storage.write_json(
        folder / "collect" / "calibration.json", {"threshold": 0.25, "suppression": 4.5, "inhibition": 0.4}
    )
    writer = episodes.Writer(folder / "collect" / "episodes", {"robots": 2})
    writer.write(synthetic.walk(robots=2, frames=20), episode=0, rooms=[0, 1], seed=0)
    write_others(folder)
    facts = {"format": run_folders.FORMAT, "scale": "smoke", "seed": 0, "settings": {}, "versions": {"jax": "0.9.2"}}
    storage.write_json(folder / "run.json", checksums.add_checksum(facts))
    return folder


def write_others(folder: Path) -> None:
    """Write files that are not those of a run."""
    with drive_log.Writer(folder / "drive", {}) as log:
        log.add({"time": 0.0, "mode": "walk", **{f"target_{joint}": 0.1 * joint for joint in range(18)}})
    small = playback.cut(playback.load(paths.DATA_DIR / "demo.npz"), 3)
    playback.save(folder / "walk.npz", small)
    K = np.array([[90.0, 0, 80], [0, 91, 60], [0, 0, 1]])
    calibrated = lens.Lens(model="fisheye", size=(160, 120), K=K, D=np.array([0.01, -0.002, 0.0, 0.0]))
    lens.write(folder / "lens.json", calibrated)
    lens.write(folder / "lens.yaml", calibrated)
    joint_map.write(folder / "servos.toml", joint_map.default())
    (folder / "labels.csv").write_text("clip,kind,contact_s,what\nc1.mp4,collision,2.1,night\nn.mp4,none,,a car\n")
    with video_io.open_writer(folder / "clip.mp4", 32, 24, 30, fast=True) as write:
        for frame in range(5):
            write(np.full((24, 32, 3), 40 * frame, np.uint8))
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(6, 8)).save(folder / "board.png")


def damage(content: bytes, kind: str, position: float, length: int, noise: bytes) -> bytes:
    """Flip bits, cut, replace, insert or repeat a part of some bytes."""
    first = int(position * len(content))
    part = content[first : first + length]
    return {
        "flip": lambda: (
            content[:first] + bytes(a ^ b for a, b in zip(part, noise, strict=False)) + content[first + len(part) :]
        ),
        "cut": lambda: content[:first] + content[first + length :],
        "end": lambda: content[:first],
        "zero": lambda: content[:first] + bytes(len(part)) + content[first + len(part) :],
        "insert": lambda: content[:first] + noise + content[first:],
        "repeat": lambda: content[:first] + part + content[first:],
    }[kind]()


@pytest.mark.parametrize("stamped", [True, False], ids=["finished", "running"])
@given(
    name=st.sampled_from(sorted(READERS)),
    kind=st.sampled_from(["flip", "cut", "end", "zero", "insert", "repeat"]),
    position=st.floats(0, 1, exclude_max=True),
    length=st.integers(1, 64),
    noise=st.binary(min_size=1, max_size=64),
)
@settings(
    max_examples=max(CASES // 2, 1), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize="LGMDJAX_TEST_DAMAGE" not in os.environ, database=None,
)  # fmt: skip
def test_damage_is_refused_in_one_line_or_changes_nothing(
    run: Path, stamped: bool, name: str, kind: str, position: float, length: int, noise: bytes
) -> None:
    """In a finished stage done.json has the checksums; while a stage runs, files have their own, or are small."""
    path, read = run / name, READERS[name]
    stage = run / name.partition("/")[0]
    stamp = stage / "done.json"
    if stage.is_dir():
        stamped |= name.endswith("done.json")
        storage.write_stamp(stage, {}) if stamped else stamp.unlink(missing_ok=True)
    whole, expected = path.read_bytes(), read(run)
    damaged = damage(whole, kind, position, length, noise)
    try:
        path.write_bytes(damaged)
        found = read(run)
    except InputError as error:
        assert str(error).isprintable() and "expected" in str(error)
    else:
        has_own_checksum = stamped or path.suffix in (".safetensors", ".parquet") or name == "run.json"
        if name in CHECKED and has_own_checksum:
            jax.tree.map(np.testing.assert_array_equal, found, expected)
    finally:
        path.write_bytes(whole)
