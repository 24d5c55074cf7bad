"""The standard streams of a command: always open, and able to show any text."""

import codecs
import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def writable() -> Iterator[None]:
    """Make every text printable in any encoding; raise `OSError` at the end if output cannot be written.

    File names that are not valid in the encoding of stdout are printed as their original bytes.
    """
    _open_closed_streams()
    codecs.register_error("lgmdjax-names", _replace_by_bytes)
    for stream, errors in ((sys.stdout, "lgmdjax-names"), (sys.stderr, "backslashreplace")):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=errors)
    try:
        yield
    finally:
        try:
            sys.stdout.flush()
        except OSError:
            with contextlib.suppress(OSError):  # when Python exits, printing the rest must not fail again
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise


def explain_full_disk(error: OSError) -> str:
    """Return what to do about a full disk or a file that may not grow; empty for another error."""
    if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return ""
    place = f" for {error.filename}" if error.filename else ""
    return f"expected space on the disk{place}, got {error.strerror}; free some, or choose another disk"


def complain(line: str, code: int) -> int:
    """Print a line on stderr, if anybody can read it, and return an exit code."""
    with contextlib.suppress(OSError):
        print(line, file=sys.stderr, flush=True)
    return code


def _open_closed_streams() -> None:
    """Open the null device in place of each standard stream that is closed.

    Python has None for such a stream, and the next file that is opened would get its number, so that what a library
    prints would be written into that file.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 (open as long as the process runs)


def _replace_by_bytes(error: UnicodeError) -> tuple[str | bytes, int]:
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.backslashreplace_errors(error)
