"""`--distributed`: join the other processes of a run, and tell them when this one fails."""

import contextlib
import math
import os
import sys
from collections.abc import Iterator

from lgmdjax.cli.flags import PipelineFlags
from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import distributed


@contextlib.contextmanager
def joined(given: PipelineFlags, command: str) -> Iterator[None]:
    """Join the other processes that the flags or the cluster name, for the block; all but the first print no progress.

    Raises `InputError` if they don't find each other, and in the block, at the next wait, if another one fails.
    """
    if not _is_asked_for(given):
        yield
        return
    distributed.start(
        given.coordinator,
        given.processes,
        given.process,
        seconds=given.wait,
        task=f"{command} {given.name}",
    )
    fault = ""
    try:
        with _quiet(not distributed.is_first()):
            yield
    except BaseException as error:
        if not isinstance(error, distributed.OtherProcessError):
            fault = one_line(error) or type(error).__name__
        if fault and distributed.is_first() and distributed.count() > 1:
            print(f"lgmdjax: {fault}; waiting for the other processes to end", file=sys.stderr, flush=True)
        raise
    finally:
        distributed.leave(fault)


def _is_asked_for(given: PipelineFlags) -> bool:
    """Tell whether there are other processes; raise `InputError` for an impossible time."""
    if not 0 < given.wait < math.inf:
        raise InputError(f"expected a --wait of more than 0 s, got {given.wait}; choose another number")
    return given.distributed or bool(given.coordinator) or (given.processes, given.process) != (None, None)


@contextlib.contextmanager
def _quiet(is_quiet: bool) -> Iterator[None]:
    """Print nothing but errors and warnings."""
    if not is_quiet:
        yield
        return
    os.environ["TQDM_DISABLE"] = "1"  # read when tqdm is imported
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield
