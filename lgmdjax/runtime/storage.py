"""Files that are written whole or not at all, and one-line errors for files that cannot be read.

| file                     | written by                       | read by                     |
| ------------------------ | -------------------------------- | --------------------------- |
| JSON                     | `write_json`, `write_stamp`      | `read_json`, `read_table`   |
| npz                      | `write_arrays`                   | `read_arrays`               |
| safetensors              | `save_tensors`                   | `load_tensors`              |
| any other                | `lgmdjax.runtime.partial_files`  | `read_file`                 |

A file that has a checksum is compared with it when it is read (`lgmdjax.runtime.checksums`). A file is written under a
temporary name first (`lgmdjax.runtime.partial_files`).
"""

import contextlib
import io
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save as serialise

from lgmdjax.errors import InputError, one_line
from lgmdjax.paths import PACKAGE_DIR
from lgmdjax.runtime import checksums, schema
from lgmdjax.runtime.partial_files import replacing, sync_all

JsonObject = dict[str, Any]
"""A JSON object: a row of a study, a file's header."""

Shapes = Mapping[str, tuple[int, ...]]
"""Shapes of arrays by name."""

STAGE_COMMANDS = ("fit-gait", "collect", "train", "evaluate", "report", "trial")
"""Commands that write a folder of their own name."""

REINSTALL = "install lgmdjax again"  # what to do about a damaged file of the package

MAX_WEIGHT = 1e6  # of a network: sums of products of such numbers are far from overflowing in single precision


def write_json(path: Path, content: object) -> None:
    """Write a JSON file, whole or not at all; numbers that are not finite, which JSON lacks, become null."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(_finite_or_null(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_stamp(folder: Path, facts: JsonObject) -> None:
    """Write the done.json of a folder: some facts, and the checksums of all files, which are synced first."""
    sync_all(folder)
    write_json(folder / checksums.STAMP, checksums.add_checksum({**facts, "files": checksums.list_files(folder)}))


def read_file(path: Path) -> bytes:
    """Read any other file of a run folder; raise `InputError` for a missing or damaged one."""
    with _naming_command(path):
        return checksums.read_bytes(path)


def read_json(path: Path) -> Any:
    """Read a JSON file of a run folder; raise `InputError` for a missing or damaged one."""
    with _naming_command(path):
        content = json.loads(checksums.read_bytes(path))
        checksums.require_checksum(content)
        return content


def read_table(path: Path) -> Any:
    """Read a JSON file of numbers of a run folder; null, an unknown number, becomes nan."""
    return _null_as_nan(read_json(path))


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray | float]) -> None:
    """Write an npz file, whole or not at all."""
    with replacing(path) as partial, partial.open("wb") as file:  # given a name, NumPy would append its suffix
        np.savez(file, allow_pickle=False, **arrays)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file of a run folder; raise `InputError` for a missing or damaged one."""
    with _naming_command(path):
        content = checksums.read_bytes(path)
        _require_sizes(content)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}


def _finite_or_null(content: object) -> object:
    if isinstance(content, Mapping):
        return {key: _finite_or_null(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite_or_null(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _null_as_nan(content: object) -> object:
    if isinstance(content, dict):
        return {key: _null_as_nan(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_null_as_nan(value) for value in content]
    return math.nan if content is None else content


def _require_sizes(content: bytes) -> None:
    """Raise `ValueError` unless each array of an npz file has its declared size; no memory is allocated for it yet."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.infolist():
            with archive.open(member) as file:
                read_header = {
                    (1, 0): np.lib.format.read_array_header_1_0,
                    (2, 0): np.lib.format.read_array_header_2_0,
                }[np.lib.format.read_magic(file)]
                shape, _, dtype = read_header(file)
                stated = math.prod(shape) * dtype.itemsize
                has_that_size = file.tell() + stated == member.file_size <= len(content)
                if min(shape, default=0) < 0 or not has_that_size:
                    raise ValueError(f"{member.filename} declares {stated} bytes, but has another size")


@contextlib.contextmanager
def _naming_command(path: Path) -> Iterator[None]:
    """Replace an error of reading by one that names the file and the command that writes it."""
    folder = path.parent.name.partition(".")[0]
    is_shipped = path.is_relative_to(PACKAGE_DIR)
    command = folder if path.name != "run.json" and folder in STAGE_COMMANDS else "reproduce"
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"expected {path}, found none; run `lgmdjax {command}` first") from error
    except Exception as error:  # whatever a damaged file makes json, zipfile and NumPy raise
        reason = one_line(error)[:200] or type(error).__name__
        raise InputError(
            f"expected {path} as `lgmdjax {command}` writes it, got a file that cannot be read ({reason}); "
            + (REINSTALL if is_shipped else f"delete its folder and run `lgmdjax {command}` again")
        ) from error


@dataclass(frozen=True, kw_only=True)
class TensorFile:
    """A kind of safetensors file: what its header says, and what messages call it."""

    format: str  # in the header; files of another format are refused
    version: str  # in the header; raise it when the tensors change their meaning
    name: str  # in messages: "expected <name>, got another kind of file"
    remedy: str  # in messages: what to do about a file that is refused


def save_tensors(
    path: Path | str, tensors: Mapping[str, np.ndarray], kind: TensorFile, metadata: Mapping[str, object]
) -> None:
    """Write arrays and `metadata` (JSON values) as one safetensors file, whole or not at all.

    Raises `InputError` for weights that `load_tensors` would refuse, and where the file cannot be written.
    """
    path = Path(path)
    if not _all_finite(tensors):
        raise InputError(f"{path}: expected finite weights to save, got some that are not; train again")
    header = {"format": kind.format, "version": kind.version}
    header |= {name: json.dumps(value) for name, value in metadata.items()}
    header[checksums.CHECKSUM_KEY] = json.dumps(_digest_tensors(tensors, header))
    try:
        with replacing(path) as partial:
            partial.write_bytes(serialise(dict(tensors), header))
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: expected a place to write to, got {reason}; choose another") from error


def load_tensors(path: Path | str, kind: TensorFile) -> tuple[dict[str, np.ndarray], JsonObject]:
    """Read the arrays and the metadata of a file that `save_tensors` wrote.

    Raises `InputError` for a file that is missing, damaged, of another format or version, or not finite.
    """
    remedy = REINSTALL if Path(path).is_relative_to(PACKAGE_DIR) else kind.remedy
    try:
        checksums.read_bytes(Path(path))
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            if header.get("format") != kind.format:
                raise InputError(f"{path}: expected {kind.name}, got another kind of file; {remedy}")
            if header.get("version") != kind.version:
                raise InputError(f"{path}: expected version {kind.version}, got {header.get('version')}; {remedy}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        metadata = {name: json.loads(text) for name, text in header.items() if name not in ("format", "version")}
        if metadata.pop(checksums.CHECKSUM_KEY, None) not in (None, _digest_tensors(tensors, header)):
            raise checksums.ChecksumError("a file with another checksum in its header")
    except InputError:
        raise
    except Exception as error:  # whatever a damaged file makes safetensors, json and NumPy raise
        reason = one_line(error)[:200]
        raise InputError(f"{path}: expected safetensors with {kind.name}, got {reason}; {remedy}") from error
    if not _all_finite(tensors):
        raise InputError(f"{path}: expected finite weights, got some that are not; {remedy}")
    return tensors, metadata


def _digest_tensors(tensors: Mapping[str, np.ndarray], header: Mapping[str, str]) -> str:
    """Return the checksum of arrays and of a header, except the header's own checksum."""
    arrays = [(name, str(array.dtype), array.shape, array.tobytes()) for name, array in sorted(tensors.items())]
    rest = sorted((name, text) for name, text in header.items() if name != checksums.CHECKSUM_KEY)
    return checksums.digest(repr((rest, arrays)).encode())


def check_weights(path: Path | str, tensors: Mapping[str, np.ndarray], kind: TensorFile, expected: Shapes) -> None:
    """Raise `InputError` unless a file's arrays have these names and shapes, and are floats below `MAX_WEIGHT`."""
    found = {name: value.shape for name, value in tensors.items()}
    if found != expected:
        raise InputError(f"{path}: expected weights {expected}, got {found}; {kind.remedy}")
    for name, value in tensors.items():
        schema.check(schema.Numbers(value.shape, -MAX_WEIGHT, MAX_WEIGHT), value, f"{path}: {name}", kind.remedy)


def _all_finite(tensors: Mapping[str, np.ndarray]) -> bool:
    return all(bool(np.isfinite(value).all()) for value in tensors.values())
