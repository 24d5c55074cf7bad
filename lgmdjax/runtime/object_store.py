"""Recorded walks in an object store: the chunks go there, and a small file in the run folder says where each one is.

Any store that fsspec knows will do: `s3://bucket/prefix` (extra `s3`), `gs://`, `memory://`. Inside `keep_chunks` a
chunk that belongs at `<run>/collect/episodes/chunk-00003.parquet` becomes two things:

| what    | where                                                          | content                               |
| ------- | -------------------------------------------------------------- | ------------------------------------- |
| object  | <url>/<run>/collect-<fingerprint>/episodes/chunk-00003.parquet | the chunk                             |
| pointer | <run>/collect/episodes/chunk-00003.json                        | URL, bytes and SHA-256 of the object  |

The pointer is written when the store has confirmed the object, so there is no half chunk, and the store need not list
or rename anything. The pointer is a file of the run folder like any other: done.json has its checksum.
"""

import contextlib
import importlib.util
import secrets
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import fsspec
from fsspec.core import url_to_fs
from fsspec.utils import get_protocol

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import checksums, schema, storage

POINTER_SUFFIX = ".json"
POINTER = schema.Object(
    {"url": schema.Text(), "bytes": schema.Integer(1, 2**40), "object": schema.Text()},
    {checksums.CHECKSUM_KEY: schema.Text()},
)
EXTRAS = {"s3": ("s3fs", "lgmdjax[s3]"), "s3a": ("s3fs", "lgmdjax[s3]"), "gs": ("gcsfs", "gcsfs")}
"""What to install for a protocol: module, and name for pip."""


class _Place(NamedTuple):
    """Where chunks of the files below a folder go."""

    url: str
    folder: Path


_place: ContextVar[_Place | None] = ContextVar("place", default=None)


@contextlib.contextmanager
def keep_chunks(url: str, run: Path) -> Iterator[None]:
    """Inside the block, chunks that are written below a run folder go to a store; with an empty URL they stay there.

    Raises `InputError` at once if the store takes no objects.
    """
    if not url:
        yield
        return
    _require_protocol(url)
    place = _Place(f"{url.rstrip('/')}/{run.name}", run.absolute())
    _check(place.url)
    token = _place.set(place)
    try:
        yield
    finally:
        _place.reset(token)


def url_of(path: Path) -> str | None:
    """Return the URL of a chunk that belongs at a path of the run folder; None if it stays there."""
    place, absolute = _place.get(), path.absolute()
    if place is None or not absolute.is_relative_to(place.folder):
        return None
    relative = absolute.relative_to(place.folder).as_posix()
    return f"{place.url}/{relative.replace(checksums.PARTIAL, '', 1)}"


def write(url: str, content: bytes, pointer: Path) -> None:
    """Put an object, whole or not at all, and then write its pointer."""
    put(url, content)
    facts = {"url": url, "bytes": len(content), "object": checksums.digest(content)}
    storage.write_json(pointer, checksums.add_checksum(facts))


def read(pointer: Path) -> bytes:
    """Return the object of a pointer; raise `InputError` if the store does not give it, or gives another one."""
    facts = storage.read_json(pointer)
    schema.check(POINTER, facts, str(pointer), "collect it again")
    content = get(facts["url"])
    if checksums.digest(content) != facts["object"]:
        raise InputError(
            f"{facts['url']}: expected the object that {pointer} names, got {len(content)} bytes with another "
            "checksum; restore it, or delete the stage and collect again"
        )
    return content


def put(url: str, content: bytes) -> None:
    """Put one object; raise `InputError` if the store refuses it."""
    try:
        store, path = _open(url)
        store.pipe_file(path, content)
    except Exception as error:  # whatever a store's client raises
        _refuse(url, "take an object", error)


def get(url: str) -> bytes:
    """Return one object; raise `InputError` if the store does not give it."""
    try:
        store, path = _open(url)
        return store.cat_file(path)
    except Exception as error:  # whatever a store's client raises
        _refuse(url, "give an object", error)


def _open(url: str) -> tuple[Any, str]:
    return url_to_fs(url, **({"auto_mkdir": True} if get_protocol(url) in ("file", "local") else {}))


def _check(url: str) -> None:
    """Put, get and remove a small object; raise `InputError` if the store refuses one of these."""
    trial, content = f"{url}/.trial-{secrets.token_hex(8)}", b"lgmdjax"
    put(trial, content)
    if get(trial) != content:
        raise InputError(f"{url}: expected a store that keeps objects, got other bytes back; choose another --chunks")
    try:
        store, path = _open(trial)
        store.rm_file(path)
    except Exception as error:  # whatever a store's client raises
        _refuse(url, "remove an object", error)


def _require_protocol(url: str) -> None:
    """Raise `InputError` for a URL of no store, or of one whose package is missing."""
    protocol, separator, _ = url.partition("://")
    protocol = protocol if separator else ""
    if protocol not in fsspec.available_protocols():
        got = repr(url) if not protocol else f"the unknown protocol {protocol}"
        raise InputError(f"expected --chunks PROTOCOL://..., such as s3://bucket/prefix, got {got}; see fsspec's list")
    module, package = EXTRAS.get(protocol, ("", ""))
    if module and importlib.util.find_spec(module) is None:
        raise InputError(
            f"expected {module} for --chunks {protocol}://, got an environment without it; pip install '{package}'"
        )


def _refuse(url: str, purpose: str, error: Exception) -> NoReturn:
    reason = one_line(f"{type(error).__name__}: {error}")[:200]
    raise InputError(
        f"expected {url} to {purpose}, got {reason}; check that the bucket exists, that the credentials may read and "
        "write it, and that its endpoint is right"
    ) from error
