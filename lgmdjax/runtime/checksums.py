"""SHA-256 checksums of files: a file that has changed since it was written is refused.

| what                         | its checksum is                                                                   |
| ---------------------------- | --------------------------------------------------------------------------------- |
| a file of a finished stage   | in the `files` of the stage's done.json                                           |
| a file of lgmdjax/data       | in lgmdjax/data/done.json, which the experiments that train the weights write     |
| done.json, run.json          | in themselves (`add_checksum`)                                                    |
| safetensors, Parquet         | in their own headers too, so that a copy elsewhere is checked                     |
| a checkpoint                 | stored with the identity of its fit (`lgmdjax.learning.checkpoints`)              |
| a cached program             | at the end of its file (`program_cache`), on its first line (`export_cache`)      |

Files of versions before 0.3.0 have none, and are read without this check: their done.json lists sizes.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

STAMP = "done.json"
CHECKSUM_KEY = "sha256"  # name of a document's own checksum
PARTIAL = ".partial"  # in the names of unfinished files and folders
UNFINISHED = (PARTIAL, ".part")  # suffixes of unfinished files; version 0.1.0 wrote .part
MAX_DEPTH = 3  # folders from a file up to the one whose done.json lists it


class ChecksumError(ValueError):
    """A file has changed since it was written."""


def digest(*parts: bytes) -> str:
    """Return the SHA-256 of some bytes, in hexadecimal digits.

    >>> digest(b"lgmd")[:8]
    'd5f4d3c6'
    """
    total = hashlib.sha256()
    for part in parts:
        total.update(part)
    return total.hexdigest()


def add_checksum(content: Mapping[str, object]) -> dict[str, Any]:
    """Return a JSON object with its own checksum.

    >>> content = add_checksum({"seed": 1})
    >>> has_valid_checksum(content), has_valid_checksum(content | {"seed": 2}), has_valid_checksum({"seed": 1})
    (True, False, False)
    """
    return {**content, CHECKSUM_KEY: _digest_json(content)}


def has_valid_checksum(content: object) -> bool:
    """Tell whether a JSON value is an object with its own checksum, and has not changed since."""
    return isinstance(content, Mapping) and CHECKSUM_KEY in content and content[CHECKSUM_KEY] == _digest_json(content)


def require_checksum(content: object) -> None:
    """Raise `ChecksumError` for a JSON object whose checksum is not that of its contents."""
    if isinstance(content, Mapping) and CHECKSUM_KEY in content and not has_valid_checksum(content):
        raise ChecksumError("its checksum is not that of its contents")


def list_files(folder: Path) -> dict[str, str]:
    """Return the checksums of all files in a folder and below, by name, except unfinished files and done.json."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix not in UNFINISHED)
    return {path.relative_to(folder).as_posix(): digest(path.read_bytes()) for path in files if path.name != STAMP}


def read_bytes(path: Path) -> bytes:
    """Read a file; raise `ChecksumError` if the done.json in its folder or above does not have its checksum."""
    content = path.read_bytes()
    folder = next((folder for folder in list(path.parents)[:MAX_DEPTH] if (folder / STAMP).is_file()), None)
    if folder is None or path == folder / STAMP:
        return content
    files = read_stamp(folder).files
    name = path.relative_to(folder).as_posix()
    if files is not None and files.get(name) != digest(content):
        reason = "has another checksum than in" if name in files else "is not in"
        raise ChecksumError(f"it {reason} {folder / STAMP}")
    return content


class Stamp(NamedTuple):
    """The done.json of a finished stage, and the checksums of its files; None if an older version wrote it."""

    facts: dict[str, Any]
    files: dict[str, str] | None


def read_stamp(folder: Path) -> Stamp:
    """Read the done.json of a folder; raise `ChecksumError` for a damaged one."""
    try:
        facts = json.loads((folder / STAMP).read_bytes())
    except (ValueError, RecursionError) as error:
        raise ChecksumError(f"{folder / STAMP} is not JSON") from error
    files = facts.get("files", {}) if isinstance(facts, dict) else None
    if not isinstance(files, dict):
        raise ChecksumError(f"{folder / STAMP} lists no files")
    is_older = CHECKSUM_KEY not in facts and not any(isinstance(value, str) for value in files.values())
    if not (is_older or has_valid_checksum(facts)):
        raise ChecksumError(f"the checksum of {folder / STAMP} is not that of its contents")
    return Stamp(facts, None if is_older else files)


def _digest_json(content: Mapping[str, object]) -> str:
    """Return the checksum of a JSON object except its own checksum; the order of its keys has no effect."""
    rest = {key: value for key, value in content.items() if key != CHECKSUM_KEY}
    return digest(json.dumps(rest, sort_keys=True).encode())
