"""Find the recorded walks of a path, without JAX, so that a wrong path is refused at once."""

from pathlib import Path

from lgmdjax.errors import InputError

FOLDERS = (".", "trial", "evaluate/testing/learned", "collect/episodes")
"""Subfolders that may hold walks; the first that does is read."""
CHUNKS = ("chunk-*.parquet", "chunk-*.json")
"""Files of walks, and pointers to those in an object store."""


def find_walks(path: Path) -> tuple[Path, set[int] | None]:
    """Return the folder with the walks of a path, and which of its episodes are meant; None for all."""
    if path.is_file():
        if path.suffix != ".parquet":
            raise InputError(f"expected a run, a trial or a chunk-*.parquet, got {path}; `lgmdjax trial` makes one")
        if path.name.startswith("chunk-") and path.stem[6:].isdecimal():
            return path.parent, {int(path.stem[6:])}
        raise InputError(f"{path}: expected the name chunk-00000.parquet that it was recorded with; rename it")
    if not path.exists():
        raise InputError(f"expected a run, a trial or a chunk-*.parquet, found no {path}; check the path")
    for name in FOLDERS:
        if any(any((path / name).glob(chunks)) for chunks in CHUNKS):
            return path / name, None
    raise InputError(f"expected recorded walks in {path}, found none; `lgmdjax trial indoor` makes some")
