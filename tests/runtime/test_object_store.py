"""Recorded walks in an object store, with fsspec's store in memory, and with S3 where moto is installed."""

import importlib.util
import json
import os
import subprocess
import sys

import fsspec
import numpy as np
import pytest
import synthetic

from lgmdjax.errors import InputError
from lgmdjax.runtime import checksums, object_store, storage
from lgmdjax.simulation import episodes

HAS_MOTO = all(importlib.util.find_spec(name) for name in ("moto", "flask", "s3fs"))


def write(folder, numbers=(0, 1)) -> episodes.Writer:
    writer = episodes.Writer(folder, {"robots": 2})
    for number in numbers:
        writer.write(synthetic.walk(2, 20), episode=number, rooms=[2 * number, 2 * number + 1], seed=0, number=number)
    return writer


@pytest.fixture
def place(tmp_path):
    """The folder of a stage that runs, whose chunks go to a store in memory."""
    folder = tmp_path / "quick-0" / "collect.partial-12ab"
    with object_store.keep_chunks("memory://bucket/walks/", folder.parent):
        yield folder
    fsspec.filesystem("memory").store.clear()


def test_chunks_are_objects_and_the_folder_has_pointers(place):
    write(place / "episodes")
    names = sorted(fsspec.filesystem("memory").store)
    assert names == [f"/bucket/walks/quick-0/collect-12ab/episodes/chunk-0000{k}.parquet" for k in (0, 1)]
    assert sorted(path.name for path in (place / "episodes").iterdir()) == ["chunk-00000.json", "chunk-00001.json"]
    pointer = json.loads((place / "episodes" / "chunk-00000.json").read_text())
    content = fsspec.filesystem("memory").cat_file(names[0])
    facts = {"url": f"memory:/{names[0]}", "bytes": len(content), "object": checksums.digest(content)}
    assert pointer == checksums.add_checksum(facts)


def test_walks_are_those_of_local_files(place, tmp_path):
    write(place / "episodes")
    write(tmp_path / "local")  # outside of the run folder
    assert sorted(path.suffix for path in (tmp_path / "local").iterdir()) == [".parquet"] * 2
    remote, local = episodes.read(place / "episodes"), episodes.read(tmp_path / "local")
    assert [walk.room for walk in remote] == [0, 1, 2, 3] == [walk.room for walk in local]
    for one, other in zip(remote, local, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
    assert episodes.read_parameters(place / "episodes") == {"robots": 2}


def test_a_finished_stage_is_read_without_the_flag_and_its_pointers_are_checked(place):
    write(place / "episodes")
    storage.write_stamp(place, {})
    final = place.with_name("collect")
    place.rename(final)
    assert len(episodes.read(final / "episodes")) == 4
    pointer = final / "episodes" / "chunk-00000.json"
    pointer.write_text(pointer.read_text().replace('"bytes": ', '"bytes": 1'))
    with pytest.raises(InputError, match=r"chunk-00000.json .* another checksum than in"):
        episodes.read(final / "episodes")


def test_missing_chunks_are_recorded_later(place):
    folder = place / "episodes"
    assert write(folder, (0, 2)).missing(4) == [1, 3]
    with pytest.raises(InputError, match="a chunk is missing"):
        episodes.read(folder)
    assert write(folder, (1,)).missing(3) == []
    assert [walk.episode for walk in episodes.read(folder)] == [0, 0, 1, 1, 2, 2]


def test_objects_that_are_gone_or_changed_are_refused(place):
    write(place / "episodes")
    memory = fsspec.filesystem("memory")
    name = next(iter(memory.store))
    memory.pipe_file(name, b"other")
    with pytest.raises(
        InputError, match=r"expected the object that .*chunk-00000.json names, got 5 bytes with another"
    ):
        episodes.read(place / "episodes")
    memory.rm_file(name)
    with pytest.raises(InputError, match=r"expected memory://bucket.* to give an object, got FileNotFoundError"):
        episodes.read(place / "episodes")


def test_a_chunk_that_is_not_stored_has_no_pointer(place, monkeypatch):
    def refuse(self, path, value, **_):
        raise PermissionError("Access Denied")

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "pipe_file", refuse)
    with pytest.raises(
        InputError, match="to take an object, got PermissionError: Access Denied; check that the bucket"
    ):
        write(place / "episodes")
    assert not list((place / "episodes").iterdir())


@pytest.mark.parametrize(
    ("url", "match"),
    [
        ("bucket/walks", "expected --chunks PROTOCOL://.*, got 'bucket/walks'"),
        ("s4://bucket", "got the unknown protocol s4"),
        ("file:///proc/nowhere", "expected file:///proc/nowhere/run/.trial-.* to take an object, got "),
    ],
)
def test_impossible_stores_are_refused_at_once(tmp_path, url, match):
    with pytest.raises(InputError, match=match), object_store.keep_chunks(url, tmp_path / "run"):
        pass


@pytest.mark.skipif(bool(importlib.util.find_spec("s3fs")), reason="s3fs is installed")
def test_the_extra_for_s3_is_named(tmp_path):
    with (
        pytest.raises(InputError, match=r"expected s3fs for --chunks s3://.* pip install 'lgmdjax\[s3\]'"),
        object_store.keep_chunks("s3://bucket", tmp_path / "run"),
    ):
        pass


@pytest.mark.extended
@pytest.mark.skipif(not HAS_MOTO, reason="needs moto[server] and s3fs")
def test_s3(tmp_path, monkeypatch):
    """In a process of its own that serves S3 on this machine; a bucket that does not exist is refused."""
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    code = (
        "from moto.server import ThreadedMotoServer; s = ThreadedMotoServer('127.0.0.1', 0); s.start();"
        "print('port', s.get_host_and_port()[1], flush=True); input()"
    )
    server = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=dict(os.environ)
    )
    assert server.stdout is not None
    port = next(line.split()[1] for line in server.stdout if line.startswith("port"))
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    try:
        run = tmp_path / "run"
        with (
            pytest.raises(InputError, match=r"s3://walks/run/.trial.* to take an object, got .*bucket does not exist"),
            object_store.keep_chunks("s3://walks", run),
        ):
            pass
        fsspec.filesystem("s3").mkdir("walks")
        with object_store.keep_chunks("s3://walks", run):
            write(run / "episodes")
        assert len(episodes.read(run / "episodes")) == 4
        assert len(fsspec.filesystem("s3").find("walks")) == 2
    finally:
        server.communicate("\n")
