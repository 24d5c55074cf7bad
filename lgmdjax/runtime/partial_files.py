"""Atomic writes: files and folders appear whole or not at all, even if the process that writes them is killed.

A file is written under a temporary name and renamed when its content is on the disk, so that not even a power cut
leaves half a file under its final name. The temporary files of killed processes are removed by the next process.
"""

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock

from lgmdjax.errors import InputError
from lgmdjax.runtime import checksums


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; at the end of the block the file there replaces `path`.

    A block that raises leaves `path` as it was, and no temporary file. A process that is killed leaves a temporary
    file, `<name>.<process>.partial` (`remove_partial_files`).
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}{checksums.PARTIAL}")
    try:
        yield partial
        sync(partial)
        os.replace(partial, path)
        sync(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def replacing_all(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; at the end of the block its files move into `folder`, which is created if missing.

    A block that raises leaves `folder` as it was. Temporary folders that killed processes left there are removed; those
    of running processes are not. Raises `InputError` if a folder has the name of a file.
    """
    with _working_folder(folder, remove_empty=True) as work:
        yield work
        files = sorted(work.iterdir())
        for file in files:
            if (folder / file.name).is_dir():
                raise InputError(
                    f"expected {folder / file.name} to be a file, got a folder; move it, or choose another"
                )
        sync_all(work)
        for file in files:
            os.replace(file, folder / file.name)
        sync(folder)


def require_empty(folder: Path) -> None:
    """Raise `InputError` unless a folder is empty or missing, so that no file of the user is replaced."""
    if folder.is_dir() and not any(folder.iterdir()):
        return
    if folder.exists() or folder.is_symlink():
        content = "has files" if folder.is_dir() else "is not a folder"
        raise InputError(f"expected an empty or a new folder, got {folder}, which {content}; choose another")


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder next to `folder`; at the end of the block it becomes `folder`, with all of its files.

    A block that raises leaves nothing. Raises `InputError` for a folder that has files or cannot be made.
    """
    require_empty(folder)
    with _working_folder(folder.parent) as work:
        yield work
        require_empty(folder)
        sync_all(work)
        if folder.exists():
            folder.rmdir()
        os.replace(work, folder)
        sync(folder.parent)


@contextlib.contextmanager
def _working_folder(parent: Path, *, remove_empty: bool = False) -> Iterator[Path]:
    """Yield a locked temporary folder in `parent`, which is created if missing; remove it at the end.

    Temporary folders of killed processes are removed too. Raises `InputError` if no folder can be made.

    Args:
        parent: where the folder is made.
        remove_empty: remove `parent` too, if it is empty at the end.
    """
    try:
        make_folder(parent)
        _remove_abandoned_folders(parent)
        work = parent / f"{checksums.PARTIAL}-{secrets.token_hex(8)}"
        _lock_of(work).touch()  # filelock would try again for ever, where no file can be made
        lock = FileLock(_lock_of(work)).acquire()  # before the folder: a folder without a lock is abandoned
    except OSError as error:
        raise not_writable(parent, error) from error
    try:
        with lock:
            work.mkdir()
            yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        with contextlib.suppress(OSError):
            _lock_of(work).unlink(missing_ok=True)
            if remove_empty:
                parent.rmdir()  # fails if it has other files


def remove_partial_files(folder: Path) -> None:
    """Remove the unfinished files that killed processes left in a folder and below.

    Only the process that holds the lock of the folder may call this.
    """
    for suffix in checksums.UNFINISHED:
        for abandoned in folder.rglob(f"*{suffix}"):
            if abandoned.is_file():
                abandoned.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk."""
    if path.is_dir():
        with contextlib.suppress(OSError):  # Windows cannot open folders; some network disks cannot sync them
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
    else:
        with path.open("rb+") as file:  # for writing, as Windows requires
            os.fsync(file.fileno())


def require_utf8(folder: Path) -> None:
    """Raise `InputError` for a path that is not UTF-8, which Arrow and TensorStore cannot write to."""
    try:
        str(folder.absolute()).encode()
    except UnicodeEncodeError:
        raise InputError(f"expected a folder with a name in UTF-8, got {folder.absolute()}; choose another") from None


def require_writable(folder: Path) -> None:
    """Make a folder if it is missing; raise `InputError` unless files can be written into it."""
    try:
        make_folder(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise not_writable(folder, error) from error


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, unless they exist; wait until their names are on the disk."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync(path.parent)


def sync_all(folder: Path) -> None:
    """Wait until a folder is on the disk, with all files and folders in it."""
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


def _lock_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.lock")


def _remove_abandoned_folders(folder: Path) -> None:
    """Remove the temporary folders of killed processes, whose locks the operating system released."""
    for work in [*folder.glob(f"{checksums.PARTIAL}-*")]:
        lock = work if work.suffix == ".lock" else _lock_of(work)
        with contextlib.suppress(OSError), FileLock(lock).acquire(blocking=False):
            shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
            lock.unlink(missing_ok=True)


def not_writable(folder: Path, error: OSError) -> InputError:
    """Return the error to raise when results cannot be written to a folder."""
    reason = error.strerror or error
    return InputError(f"expected a folder that can be written, got {folder} ({reason}); choose another")
