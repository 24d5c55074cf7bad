"""Files that appear whole or not at all, and one-line errors for files that cannot be read.

| file                     | written by                       | read by                     |
| ------------------------ | -------------------------------- | --------------------------- |
| JSON                     | `write_json`                     | `read_json`                 |
| npz                      | the stages                       | `read_arrays`               |
| safetensors              | `save_tensors`                   | `load_tensors`              |
| any other                | `replacing`, `replacing_all`     | the module that knows it    |
| a new folder             | `new_folder`                     | the user                    |
"""

import contextlib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialise

from lgmdjax.errors import InputError

JsonObject = dict[str, Any]
"""A JSON object: a row of a study, a file's header."""

Shapes = Mapping[str, tuple[int, ...]]
"""Shapes of arrays by name."""

PARTIAL_PREFIX = ".partial-"
"""Of the temporary folders of `replacing_all`."""

LOCK_NAME = ".lock"
"""File in a temporary folder, locked while a process works there."""

STAGE_COMMANDS = ("fit-gait", "collect", "train", "evaluate", "report")
"""Commands that write a folder of their own name."""


@contextlib.contextmanager
def replacing(path: Path, *, sync: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; at the end of the block the file there replaces `path`.

    A block that raises leaves `path` as it was, and no temporary file. A process that is killed leaves a temporary
    file, `<name>.<process>.partial` (`remove_partial_files`).

    Args:
        path: of the file.
        sync: wait until the content is on the disk, so that not even a power cut leaves half a file.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        if sync:
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def replacing_all(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; at the end of the block its files move into `folder`, which is made if need be.

    A block that raises leaves `folder` as it was. What a killed process left there is removed; its lock tells that it
    has ended.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for abandoned in folder.glob(f"{PARTIAL_PREFIX}*"):
            _remove_abandoned(abandoned)
        work = tempfile.TemporaryDirectory(prefix=PARTIAL_PREFIX, dir=folder)
    except OSError as error:
        raise not_writable(folder, error) from error
    try:
        with work, FileLock(Path(work.name) / LOCK_NAME):
            yield Path(work.name)
            for file in Path(work.name).iterdir():
                if file.name != LOCK_NAME:
                    os.replace(file, folder / file.name)
    finally:
        with contextlib.suppress(OSError):  # the folder has other files
            folder.rmdir()


def _remove_abandoned(partial: Path) -> None:
    """Remove a temporary folder of `replacing_all` unless a process works in it."""
    lock = FileLock(partial / LOCK_NAME)
    with contextlib.suppress(Timeout, OSError), lock.acquire(timeout=0):
        shutil.rmtree(partial)


def require_empty(folder: Path) -> None:
    """Raise `InputError` unless a folder is empty or missing, so that nothing of the user's is replaced."""
    if folder.is_dir() and not any(folder.iterdir()):
        return
    if folder.exists() or folder.is_symlink():
        content = "has files" if folder.is_dir() else "is no folder"
        raise InputError(f"expected an empty or a new folder, got {folder}, which {content}; choose another")


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `folder`; at the end of the block it becomes `folder`, with all of its files.

    A block that raises leaves nothing. Raises `InputError` for a folder that has files or cannot be made.
    """
    require_empty(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"expected a folder that can be made, got {folder} ({reason}); choose another") from error
    with work:
        whole = Path(work.name, folder.name)
        whole.mkdir()
        yield whole
        require_empty(folder)
        if folder.exists():
            folder.rmdir()
        os.replace(whole, folder)


def remove_partial_files(folder: Path) -> None:
    """Remove what killed processes left of unfinished files in a folder and in those below it."""
    for pattern in ("*.partial", "*.part"):  # version 0.1.0 wrote *.part
        for abandoned in folder.rglob(pattern):
            if abandoned.is_file():
                abandoned.unlink(missing_ok=True)


def not_writable(folder: Path, error: OSError) -> InputError:
    """Return the error to raise when results cannot be written to a folder."""
    reason = error.strerror or error
    return InputError(f"expected a folder that can be written, got {folder} ({reason}); choose another --out")


def write_json(path: Path, content: object) -> None:
    """Write a JSON file, whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file of a run folder; raise `InputError` for a missing or damaged one."""
    with _naming_command(path):
        return json.loads(path.read_text(encoding="utf-8"))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file of a run folder; raise `InputError` for a missing or damaged one."""
    with _naming_command(path), np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


@contextlib.contextmanager
def _naming_command(path: Path) -> Iterator[None]:
    """Turn an error of reading into one that names the file, and the command that makes it."""
    folder = path.parent.name.partition(".")[0]
    command = folder if path.name != "run.json" and folder in STAGE_COMMANDS else "reproduce"
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"expected {path}, found none; run `lgmdjax {command}` first") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"expected {path} as `lgmdjax {command}` writes it, got a file that cannot be read ({reason}); "
            f"delete its folder and run `lgmdjax {command}` again"
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

    Raises `InputError` for arrays that are not finite, and where the file cannot be written.
    """
    path = Path(path)
    if not _all_finite(tensors):
        raise InputError(f"{path}: expected finite weights to save, got some that are not; train again")
    header = {"format": kind.format, "version": kind.version}
    header |= {name: json.dumps(value) for name, value in metadata.items()}
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
    try:
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            if header.get("format") != kind.format:
                raise InputError(f"{path}: expected {kind.name}, got another kind of file; {kind.remedy}")
            if header.get("version") != kind.version:
                raise InputError(f"{path}: expected version {kind.version}, got {header.get('version')}; {kind.remedy}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        metadata = {name: json.loads(text) for name, text in header.items() if name not in ("format", "version")}
    except (OSError, SafetensorError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: expected safetensors with {kind.name}, got {error}; {kind.remedy}") from error
    if not _all_finite(tensors):
        raise InputError(f"{path}: expected finite weights, got some that are not; {kind.remedy}")
    return tensors, metadata


def check_shapes(path: Path | str, tensors: Mapping[str, np.ndarray], kind: TensorFile, expected: Shapes) -> None:
    """Raise `InputError` unless a file's arrays have the names and shapes that are expected."""
    found = {name: value.shape for name, value in tensors.items()}
    if found != expected:
        raise InputError(f"{path}: expected weights {expected}, got {found}; {kind.remedy}")


def _all_finite(tensors: Mapping[str, np.ndarray]) -> bool:
    return all(bool(np.isfinite(value).all()) for value in tensors.values())
