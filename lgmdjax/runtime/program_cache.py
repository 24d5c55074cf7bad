"""Checksums for JAX's own cache of compiled programs.

JAX compresses what it caches, and accepts whatever it can decompress: damaged machine code crashes or gives wrong
results. `protect` appends to each entry a mark and the SHA-256 of what precedes it. A damaged entry is deleted, and the
program is compiled again. JAX without this module reads such entries as well: it stops at the end of the compressed
data. Entries without a mark were written without this module. They are read, or replaced if JAX cannot read them.

Source: the interface of `jax._src.compilation_cache` (JAX 0.9 to 0.12), which is private. Where it has changed, JAX's
cache is used as it is.
"""

import hashlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

try:
    from jax._src import compilation_cache
except ImportError:
    compilation_cache: Any = None

MARK = b"sha256:"
LENGTH = len(MARK) + hashlib.sha256().digest_size


class CheckedCache:
    """A cache of JAX, with a checksum at the end of each entry.

    Args:
        cache: JAX's cache of a folder.
    """

    def __init__(self, cache: Any):
        self.cache, self.path = cache, cache.path
        self._path = self.path  # its name in JAX's interface

    def get(self, key: str) -> bytes | None:
        """Return an entry without its checksum; None if there is none, or a damaged one, which is deleted."""
        entry = self.cache.get(key)
        if entry is None or entry[-LENGTH : len(MARK) - LENGTH] != MARK:
            return entry
        content, checksum = entry[:-LENGTH], entry[len(MARK) - LENGTH :]
        if hashlib.sha256(content).digest() == checksum:
            return content
        warnings.warn(f"{self._file(key)} is damaged; it is deleted and made again", stacklevel=2)
        self._file(key).unlink(missing_ok=True)
        return None

    def put(self, key: str, value: bytes) -> None:
        """Store an entry in place of one that could not be read."""
        self._file(key).unlink(missing_ok=True)
        self.cache.put(key, value + MARK + hashlib.sha256(value).digest())

    def clear(self) -> None:
        """Delete all entries."""
        self.cache.clear()

    def _file(self, key: str) -> Path:
        return Path(str(self.path), f"{key}-cache")


def protect() -> None:
    """Check the entries of JAX's cache from now on, in this process."""
    make = getattr(compilation_cache, "get_file_cache", None)
    if make is None or isinstance(make, _MakeChecked):
        return
    compilation_cache.get_file_cache = _MakeChecked(make)
    if getattr(compilation_cache, "_cache", None) is not None:  # JAX has compiled something already
        compilation_cache._cache = CheckedCache(compilation_cache._cache)


class _MakeChecked:
    """JAX's function that makes its cache, with checksums added."""

    def __init__(self, make: Callable[[str], tuple[Any, str] | None]):
        self.make = make

    def __call__(self, path: str) -> tuple[Any, str] | None:
        made = self.make(path)
        return made if made is None or "://" in path else (CheckedCache(made[0]), made[1])
