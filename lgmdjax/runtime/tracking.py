"""Curves of fits while they run: every fit calls `log(step, values)`, which passes the values to all listeners.

>>> seen = []
>>> with add_listener(lambda step, values: seen.append((step, dict(values)))):
...     log(100, {"fit/loss": 0.5})
>>> log(200, {"fit/loss": 0.25})  # nobody listens
>>> seen
[(100, {'fit/loss': 0.5})]

A value's name is that of the fit, a slash, and that of the quantity with its unit. `lgmdjax train --track` adds as a
listener TensorBoard or a function of the user (`lgmdjax.cli.tracking`).
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path

Log = Callable[[int, Mapping[str, float]], object]
"""`log(step, values)`: takes values of one step of a fit, which is an epoch, an update or a window."""

_listeners: ContextVar[tuple[Log, ...]] = ContextVar("listeners", default=())


@contextlib.contextmanager
def add_listener(to: Log) -> Iterator[None]:
    """Pass what fits log inside the block to `to`, in addition to earlier listeners."""
    token = _listeners.set((*_listeners.get(), to))
    try:
        yield
    finally:
        _listeners.reset(token)


def has_listener() -> bool:
    """Return whether there is a listener; without one, a fit need not fetch values from its device."""
    return bool(_listeners.get())


def log(step: int, values: Mapping[str, float]) -> None:
    """Pass values of one step of a fit to all listeners."""
    for listener in _listeners.get():
        listener(step, values)


def name_fit(folder: Path) -> str:
    """Return the name of a fit from the folder of its checkpoints.

    >>> name_fit(Path("runs/quick-0/train.partial-1a2b/checkpoints/round-0"))
    'round-0'
    >>> name_fit(Path("study.partial-1a2b/repeat-1/checkpoints/rounds-2"))
    'repeat-1/rounds-2'
    """
    return "/".join(part for part in folder.parts[-3:] if part != "checkpoints" and ".partial-" not in part)
