"""Fuzz every reader of files with atheris: a result, or `InputError`; anything else is a bug.

    pip install atheris        # into an environment of its own; Linux, Python 3.11 or newer
    python tests/fuzz/fuzz_readers.py TARGET -max_total_time=600 -timeout=5 -rss_limit_mb=2048

pytest does not collect this file. TARGET is one of `TARGETS`; `all` alternates between them, which needs fewer
arguments and finds less. Everything after it goes to libFuzzer. Seeds are made anew in each run, so there is no corpus
to keep. The first exception of each kind is printed, and what raised it is written to crash-*, which
`python tests/fuzz/fuzz_readers.py TARGET crash-...` repeats; libFuzzer itself stops at crashes of the process, at
timeouts and at too much memory.

Only this package is instrumented. Where a checksum would refuse every change, the harness puts a right one in its place
(`_stamped`), or builds a file with wrong contents from the fuzzer's bytes, so that the readers behind it are reached.
"""

import contextlib
import importlib
import io
import json
import os
import struct
import sys
import tempfile
import traceback
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

atheris: Any = importlib.import_module("atheris")  # not in requirements.lock
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
sys.path.insert(0, str(Path(__file__).parents[1]))  # synthetic

with atheris.instrument_imports(include=["lgmdjax"]):
    from lgmdjax import paths
    from lgmdjax.cli import watch
    from lgmdjax.control import navigator
    from lgmdjax.datasets import recorded_rooms
    from lgmdjax.detectors import alarm, lgmd
    from lgmdjax.errors import InputError
    from lgmdjax.evaluation import clip_labels
    from lgmdjax.hardware import ax_servo, chessboard, drive_log, inertial, joint_map, lens
    from lgmdjax.locomotion import shaping
    from lgmdjax.reporting import playback, video_io
    from lgmdjax.runtime import checksums, export_cache, pytree_json, run_folders, schema, storage
    from lgmdjax.simulation import assembly, episodes
    from lgmdjax.viewer import edits

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import synthetic

FOLDER = Path(tempfile.mkdtemp(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
MAX_FRAMES = 20  # read of a video
PACKAGE = str(paths.PACKAGE_DIR)

Target = Callable[[bytes], object]
"""Reads a file with these bytes."""


def _write(name: str, content: bytes) -> Path:
    path = FOLDER / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def _stamped(content: object) -> bytes:
    """Return JSON with the right checksum of its own, if it is an object."""
    return json.dumps(checksums.add_checksum(content) if isinstance(content, dict) else content).encode()


def _json_value(data: Any, depth: int = 3) -> Any:
    """Return a JSON value: mostly small numbers, and what readers may not expect."""
    odd = [None, True, False, 0, 1, -1, 2**31, 2**63, 10**400, 0.5, 1e308, float("inf"), float("nan"), "", "x", [], {}]
    kind = data.ConsumeIntInRange(0, 5 if depth else 3)
    if kind == 0:
        return odd[data.ConsumeIntInRange(0, len(odd) - 1)]
    if kind == 1:
        return data.ConsumeInt(4)
    if kind == 2:
        return data.ConsumeFloat()
    if kind == 3:
        return data.ConsumeUnicodeNoSurrogates(12)
    if kind == 4:
        return [_json_value(data, depth - 1) for _ in range(data.ConsumeIntInRange(0, 4))]
    return {
        data.ConsumeUnicodeNoSurrogates(8): _json_value(data, depth - 1) for _ in range(data.ConsumeIntInRange(0, 4))
    }


def _changed(data: Any, value: Any, chance: int = 8) -> Any:
    """Return a JSON value with some of its parts replaced or left out."""
    if data.ConsumeIntInRange(0, chance) == 0:
        return _json_value(data)
    if isinstance(value, dict):
        return {name: _changed(data, part) for name, part in value.items() if data.ConsumeIntInRange(0, 20)}
    if isinstance(value, list) and len(value) < 64:
        return [_changed(data, part, 40) for part in value]
    return value


def video(content: bytes) -> None:
    """A video file."""
    with video_io.open_reader(_write("video", content)) as opened:
        for _ in zip(range(MAX_FRAMES), opened.frames(16, 12), strict=False):
            pass


def watch_video(content: bytes) -> None:
    """A video file, by the command."""
    with contextlib.redirect_stderr(io.StringIO()):
        watch.detect_looming(
            _write("watched.mp4", content),
            FOLDER / "watch",
            layout=watch.StereoLayout(width=32),
            params=watch.Detectors(lgmd.Params(), alarm.Params()),
        )


def walks(content: bytes) -> None:
    """A Parquet file of recorded walks."""
    _write("walks/chunk-00000.parquet", content)
    episodes.read(FOLDER / "walks")


def _column(data: Any, rows: int, like: pa.ChunkedArray) -> pa.Array | pa.ChunkedArray:
    values = like.to_pylist()[:rows]
    kind = data.ConsumeIntInRange(0, 12)
    if kind == 0:
        return pa.array([None] * rows, like.type)
    if kind == 1:
        return pa.array([str(value) for value in values])
    if kind == 2:
        return pa.array([[1.0]] * rows)
    if kind == 3:
        return pa.array([data.ConsumeFloat() for _ in range(rows)], pa.float64())
    if kind == 4:
        return pa.array([data.ConsumeInt(8) for _ in range(rows)], pa.int64())
    if kind == 5:
        return pa.array([1] * rows, pa.uint64())
    if kind == 6:
        return pa.array([b"x"] * rows)
    if kind == 7:
        return pa.array(values).dictionary_encode()
    if kind == 8:
        return pa.array([{"a": 1}] * rows)
    return pa.array(values, like.type)


def _table(data: Any, whole: pa.Table) -> pa.Table:
    """Return a table with some columns changed, left out, repeated or renamed."""
    rows = data.ConsumeIntInRange(0, whole.num_rows)
    touched = {data.ConsumeIntInRange(0, whole.num_columns - 1) for _ in range(data.ConsumeIntInRange(0, 4))}
    names, columns = [], []
    for number, name in enumerate(whole.column_names):
        action = data.ConsumeIntInRange(0, 9) if number in touched else 9
        if action == 0:
            continue
        names += [data.ConsumeUnicodeNoSurrogates(6) if action == 1 else name] * (2 if action == 2 else 1)
        column = _column(data, rows, whole[name]) if number in touched else whole[name].slice(0, rows)
        columns += [column] * (2 if action == 2 else 1)
    return pa.table(columns, names=names)


def crafted_walks(content: bytes) -> None:
    """Parquet of recorded walks with wrong columns or a wrong header, and the right checksum."""
    data = atheris.FuzzedDataProvider(content)
    header = _changed(data, HEADER)
    table = _table(data, WALKS)
    if isinstance(header, dict) and data.ConsumeBool():
        with contextlib.suppress(Exception):  # of columns that have none
            rest = {name: value for name, value in header.items() if name != checksums.CHECKSUM_KEY}
            header[checksums.CHECKSUM_KEY] = episodes.episode_tables.digest(table, rest)
    (FOLDER / "crafted").mkdir(exist_ok=True)
    with (FOLDER / "crafted" / "chunk-00000.parquet").open("wb") as file:
        pq.write_table(table.replace_schema_metadata({"lgmdjax": json.dumps(header)}), file)
    episodes.read(FOLDER / "crafted")
    recorded_rooms.check_header(episodes.read_parameters(FOLDER / "crafted"), FOLDER)


def live_walk(content: bytes) -> None:
    """The header of a walk that the viewer recorded."""
    data = atheris.FuzzedDataProvider(content)
    edits.read_edits(_changed(data, LIVE), 10, FOLDER)


def _tensors(data: Any, path: Path, kind: storage.TensorFile) -> Path:
    """Write safetensors with other contents than those of a file, mostly with the right checksum."""
    tensors, metadata = storage.load_tensors(path, kind)
    found = {}
    for name, value in tensors.items():
        action = data.ConsumeIntInRange(0, 40)
        if action == 0:
            continue
        if action == 1:
            value = value.astype(data.PickValueInList([np.int32, np.float16, bool, np.uint8, np.float64]))
        if action == 2:
            value = value.reshape(-1)
        if action == 3:
            value = np.full_like(value, data.PickValueInList([np.nan, np.inf, 1e38, -1e6, 0, 1e-30]))
        if action == 4:
            value = value[:0]
        found[data.ConsumeUnicodeNoSurrogates(5) if action == 5 else name] = value
    header = {
        name: json.dumps(_changed(data, value)) for name, value in metadata.items() if data.ConsumeIntInRange(0, 15)
    }
    header |= {"format": kind.format, "version": kind.version}
    if data.ConsumeIntInRange(0, 15) == 0:
        header["versions"] = data.ConsumeUnicodeNoSurrogates(20)
    header[checksums.CHECKSUM_KEY] = json.dumps(storage._digest_tensors(found, header))
    return _write("crafted.safetensors", storage.serialise(found, header))


def controller(content: bytes) -> None:
    """A controller with changed bytes."""
    navigator.load(_write("controller.safetensors", content))


def crafted_controller(content: bytes) -> None:
    """A controller with other contents."""
    data = atheris.FuzzedDataProvider(content)
    folder = FOLDER / "robot"
    folder.mkdir(exist_ok=True)
    path = _tensors(data, paths.PRETRAINED_DIR / "controller.safetensors", navigator.FILE)
    path.rename(folder / "controller.safetensors")
    assembly.load_robot(paths.PRETRAINED_DIR, folder)


def networks(content: bytes) -> None:
    """Shaping networks with changed bytes, or with other contents."""
    if content[:1] == b"{" or len(content) > 1000:
        shaping.load(_write("shaping.safetensors", content))
    else:
        shaping.load(_tensors(atheris.FuzzedDataProvider(content), paths.SHAPING_FILE, shaping.FILE))


def baselines(content: bytes) -> None:
    """Arrays of the baselines."""
    schema.check(assembly.BASELINES, storage.read_arrays(_write("baselines.npz", content)), "baselines", "train again")


def crafted_npz(content: bytes) -> None:
    """An npz file whose arrays have a header from the fuzzer; as baselines and as a playback."""
    data = atheris.FuzzedDataProvider(content)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in data.PickValueInList(
            [("gain", "replayed"), (*playback.ROOM, *playback.SERIES, "pictures", "title")]
        ):
            described = str(
                _changed(data, NPY.get(name, {"descr": "<f8", "fortran_order": False, "shape": (1,)}))
            ).encode()
            body = data.ConsumeBytes(data.ConsumeIntInRange(0, 64))
            archive.writestr(f"{name}.npy", b"\x93NUMPY\1\0" + struct.pack("<H", len(described)) + described + body)
    path = _write("crafted.npz", file.getvalue())
    for read in (baselines, lambda _: playback.load(path)):
        with contextlib.suppress(InputError):
            read(file.getvalue())


def calibration(content: bytes) -> None:
    """The calibration of the detector."""
    _write("collect/calibration.json", content)
    assembly.load_detector(FOLDER / "collect")


def run_facts(content: bytes) -> None:
    """run.json, and done.json of a stage beside a file."""
    folder = FOLDER / "run"
    _write("run/run.json", content)
    with contextlib.suppress(InputError):
        run_folders.read_facts(folder)
        run_folders._check_same(
            run_folders.Run(folder=folder, seed=0, settings={}),
            {"format": run_folders.FORMAT, "scale": "smoke", "seed": 0, "settings": {"a": {"b": [1, 2]}}},
        )
    _write("run/fit-gait/a.json", b"{}")
    _write("run/fit-gait/done.json", content)
    with contextlib.suppress(InputError):
        storage.read_json(folder / "fit-gait" / "a.json")
    run_folders._find_fault(folder / "fit-gait", "0")


def crafted_facts(content: bytes) -> None:
    """The same with the right checksum."""
    data = atheris.FuzzedDataProvider(content)
    facts = {"format": run_folders.FORMAT, "scale": "smoke", "seed": 0, "settings": {"a": {"b": [1, 2]}}}
    facts |= {"versions": {}, "files": {"a.json": checksums.digest(b"{}")}, "fingerprint": "0"}
    run_facts(_stamped(_changed(data, facts)))


def labels(content: bytes) -> None:
    """labels.csv of `bench clips`."""
    clip_labels.read_labels(_write("labels.csv", content))


def lens_file(content: bytes) -> None:
    """A calibration of a lens, in JSON or YAML."""
    lens.read(_write("lens", content))


def crafted_lens(content: bytes) -> None:
    """A calibration of a lens with other values, in JSON or in OpenCV's YAML."""
    data = atheris.FuzzedDataProvider(content)
    names = {**LENS, "image_width": 640, "image_height": 480, "distortion_model": "plumb_bob"}
    value = _changed(data, {name: names[name] for name in names if data.ConsumeIntInRange(0, 3)})
    text = json.dumps(value)
    lens.read(_write("lens", text.encode() if data.ConsumeBool() else b"%YAML:1.0\n---\n" + text.encode()))


def map_file(content: bytes) -> None:
    """A joint map in TOML."""
    joint_map.read(_write("servos.toml", content))


def picture(content: bytes) -> None:
    """A picture of a chessboard."""
    chessboard.read_grey(_write("picture.png", content))


def log(content: bytes) -> None:
    """The log of a drive."""
    _write("drive/drive-00000.parquet", content)
    drive_log.joints(drive_log.read(FOLDER / "drive"), "target")


def crafted_log(content: bytes) -> None:
    """The log of a drive with other columns or another header, in two chunks."""
    data = atheris.FuzzedDataProvider(content)
    (FOLDER / "log").mkdir(exist_ok=True)
    for number in range(2):
        header = json.dumps(_changed(data, LOG_HEADER))
        with (FOLDER / "log" / f"drive-{number:05d}.parquet").open("wb") as file:
            pq.write_table(_table(data, LOG).replace_schema_metadata({"lgmdjax": header}), file)
    drive_log.joints(drive_log.read(FOLDER / "log"), "joint")


def samples(content: bytes) -> None:
    """Lines of an inertial sensor, and bytes of a servo bus."""
    for line in content.split(b"\n"):
        inertial.parse(line)
    for value in content:
        ax_servo.from_signed(value)


def structures(content: bytes) -> None:
    """The structure of a cached program's results, and a cached program; these raise ValueError for what is wrong."""
    with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
        pytree_json.decode(json.loads(content), frozenset({"lgmdjax"}))
    path = _write("program", content)
    path.chmod(0o600)
    export_cache._read(path, "key", frozenset({"lgmdjax"}))


TARGETS: dict[str, Target] = {
    target.__name__: target
    for target in (
        *(video, watch_video, walks, crafted_walks, live_walk, controller, crafted_controller, networks, baselines),
        *(crafted_npz, calibration, run_facts, crafted_facts, labels, lens_file, crafted_lens, map_file, picture, log),
        *(crafted_log, samples, structures),
    )
}

LENS = {"model": "fisheye", "size": [640, 480], "K": [[300, 0, 320], [0, 300, 240], [0, 0, 1]], "D": [0.1, 0, 0, 0]}
HEADER: dict[str, Any]
WALKS: pa.Table
LOG: pa.Table
LOG_HEADER: dict[str, Any]
LIVE: dict[str, Any]
NPY: dict[str, dict[str, Any]] = {
    "gain": {"descr": "<f8", "fortran_order": False, "shape": ()},
    "replayed": {"descr": "<f4", "fortran_order": False, "shape": (4096, 2)},
}
"""Contents of files that the crafted ones differ from; `make_seeds` sets those without a value."""


def make_seeds() -> dict[str, list[bytes]]:
    """Make small files of every kind; return the bytes that fuzzing begins with."""
    global HEADER, WALKS, LOG, LOG_HEADER, LIVE
    written = episodes.Writer(FOLDER / "seed-walks", {"robots": 1}).write(
        synthetic.walk(robots=1, frames=6), episode=0, rooms=[0], seed=0
    )
    WALKS, HEADER = pq.read_table(written), episodes.read_header(FOLDER / "seed-walks")
    with drive_log.Writer(FOLDER / "seed-log", {}) as writer:
        writer.add({"time": 0.0, "mode": "walk", **{f"target_{k}": 0.1 for k in range(18)}})
        writer.add({"time": 0.1, "mode": "walk", **{f"joint_{k}": 0.1 for k in range(18)}})
    log_file = FOLDER / "seed-log" / "drive-00000.parquet"
    LOG = pq.read_table(log_file)
    LOG_HEADER = json.loads(LOG.schema.metadata[b"lgmdjax"])
    room = edits.arena.empty_room()
    leaves = [np.asarray(leaf).ravel().tolist() for leaf in edits.jax.tree.leaves(room)]
    LIVE = {"arena": leaves, "moves": [[2, 0, 0.5, 0.5]], "room": "random", "seed": 0}
    movie = FOLDER / "seed.mp4"
    with video_io.open_writer(movie, 32, 24, 30, fast=True) as write:
        for frame in range(6):
            write(np.full((24, 32, 3), 30 * frame, np.uint8))
    joint_map.write(FOLDER / "seed.toml", joint_map.default())
    videos = [movie.read_bytes()]
    return {
        "video": videos,
        "watch_video": videos,
        "walks": [written.read_bytes()],
        "controller": [(paths.PRETRAINED_DIR / "controller.safetensors").read_bytes()],
        "networks": [paths.SHAPING_FILE.read_bytes()],
        "baselines": [(paths.PRETRAINED_DIR / "baselines.npz").read_bytes()],
        "calibration": [b'{"threshold": 0.25, "suppression": 4.5, "inhibition": 0.4}'],
        "run_facts": [b'{"format": 2, "scale": "smoke", "seed": 0, "settings": {}, "versions": {}}', b'{"files": {}}'],
        "labels": [b"clip,kind,contact_s,what\nc01.mp4,collision,2.1,night\nnc03.mp4,none,,a car\n"],
        "lens_file": [
            json.dumps(LENS).encode(),
            b"%YAML:1.0\n---\nmodel: fisheye\nimage_width: 640\nimage_height: 480\nK: !!opencv-matrix\n   rows: 3\n"
            b"   cols: 3\n   dt: d\n   data: [ 300., 0., 320., 0., 300., 240., 0., 0., 1. ]\nD: [0.1, 0, 0, 0]\n",
        ],
        "map_file": [(FOLDER / "seed.toml").read_bytes()],
        "picture": [_picture("png"), _picture("jpeg"), _picture("bmp")],
        "log": [log_file.read_bytes()],
        "samples": [b"0.1, -0.2 9.8\n", b"nan 1 1\n1e999 1 1\n"],
    }


def _print_new(known: set[tuple[str, str]], name: str, content: bytes, kind: tuple[str, str]) -> None:
    """Print a kind of bug that is not known yet, and write what caused it."""
    if kind in known:
        return
    known.add(kind)
    path = Path(f"crash-{name}-{checksums.digest(content)[:8]}")
    path.write_bytes(content)
    print(f"BUG {path}: {kind[0]} at {kind[1]}", flush=True)
    traceback.print_exc(limit=-4)


def _picture(kind: str) -> bytes:
    file = io.BytesIO()
    chessboard.Image.fromarray(np.arange(48, dtype=np.uint8).reshape(6, 8)).save(file, kind)
    return file.getvalue()


def main() -> None:
    """Fuzz one target."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] not in TARGETS:
        sys.exit(f"expected one of {', '.join(TARGETS)}; then flags of libFuzzer, or files to repeat")
    name, seeds = arguments[0], make_seeds()
    target = TARGETS[name]
    known: set[tuple[str, str]] = set()

    def once(content: bytes) -> None:
        try:
            target(content)
        except InputError as error:
            if not str(error).isprintable():
                _print_new(known, name, content, ("unprintable", error.args[0][:40]))
        except Exception as error:
            frames = [frame for frame in traceback.extract_tb(error.__traceback__) if PACKAGE in frame.filename]
            if frames:  # else the harness could not make such a file
                _print_new(known, name, content, (type(error).__name__, f"{frames[-1].filename}:{frames[-1].lineno}"))

    corpus = FOLDER / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(seeds.get(name, [bytes(range(256)) * 2, bytes(64)])):
        (corpus / str(number)).write_bytes(seed)
    repeated = [argument for argument in arguments[1:] if Path(argument).is_file()]
    atheris.Setup([sys.argv[0], *arguments[1:], *([] if repeated else [str(corpus)])], once)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
