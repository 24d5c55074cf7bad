"""Files that are there whole or not at all, and what to do about one that cannot be read."""

import contextlib
import json
import os
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lgmdjax.errors import InputError

JsonObject = dict[str, Any]
"""What JSON calls an object: the rows of a study, the header of a file."""

COMMANDS = ("fit-gait", "collect", "train", "evaluate", "report")  # that make a folder of their name


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    os.replace(partial, path)


def read_json(path: Path) -> Any:
    """Read a JSON file of a run folder; raise `InputError` for a missing or damaged one."""
    with _named(path):
        return json.loads(path.read_text(encoding="utf-8"))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file of a run folder; raise `InputError` for a missing or damaged one."""
    with _named(path), np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Tell which file could not be read, and the command that makes it."""
    folder = path.parent.name.partition(".")[0]
    command = folder if path.name != "run.json" and folder in COMMANDS else "reproduce"
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


@contextlib.contextmanager
def all_or_nothing(folder: Path) -> Iterator[Path]:
    """Give a place to write to, whose files move into the folder when all of them are there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        work = tempfile.TemporaryDirectory(prefix=".partial-", dir=folder)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"expected a folder that can be written, got {folder} ({reason}); choose another --out"
        ) from error
    try:
        with work:
            yield Path(work.name)
            for file in Path(work.name).iterdir():
                os.replace(file, folder / file.name)
    finally:
        with contextlib.suppress(OSError):  # it holds files of an earlier time
            folder.rmdir()
