"""Ctrl-C, SIGTERM and SIGHUP end a command within two seconds, whatever it is doing.

For a signal, Python raises an exception between two of its instructions. That is not enough: compiled code may run for
minutes between two instructions, and an exception in a callback of the garbage collector, of which JAX has one, is
printed and then lost. A signal therefore also sets a flag, which loops over chunks of work check (`check`), and wakes a
thread that ends the process if it is still running after `GRACE`. Files are safe in either case: they get their names
when they are complete (`lgmdjax.runtime.partial_files`).
"""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator

GRACE = 1.5  # s from a signal to the end of the process
NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows lacks the last

_received: list[int] = []  # signals since the last `handling_signals` began


class Interrupted(KeyboardInterrupt):
    """A signal that ends the command."""

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


def check() -> None:
    """Raise `Interrupted` if a signal arrived and its exception was lost."""
    if _received:
        raise Interrupted(_received[0])


@contextlib.contextmanager
def handling_signals(message: str) -> Iterator[None]:
    """Raise `Interrupted` for signals inside the block; print a message if the process has to be ended at once.

    Signals that the process ignores, as under `nohup`, stay ignored. Outside the main thread this does nothing, since
    Python handles no signals there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _received.clear()
    numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers if signal.getsignal(number) != signal.SIG_IGN}
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    finished = threading.Event()
    threading.Thread(target=_end_at_last, args=(reader, finished, [*before], message), daemon=True).start()
    woken = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    try:
        for number in before:
            signal.signal(number, _interrupt)
        yield
        check()
    finally:
        finished.set()
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(woken)
        writer.close()  # which ends the thread


@contextlib.contextmanager
def counting() -> Iterator[Callable[[], int]]:
    """Count signals instead of ending the command, for code that must finish; yield a function that returns the count.

    For code inside `handling_signals`, in the main thread. Signals that the process ignores stay ignored.
    """
    received: list[int] = []
    numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers if signal.getsignal(number) != signal.SIG_IGN}
    woken = signal.set_wakeup_fd(-1)
    try:
        for number in before:
            signal.signal(number, lambda number, _: received.append(number))
        yield lambda: len(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(woken, warn_on_full_buffer=False)


def _interrupt(number: int, _: object) -> None:
    _received.append(number)
    raise Interrupted(number)


def _end_at_last(reader: socket.socket, finished: threading.Event, numbers: list[int], message: str) -> None:
    """Wait for one of the signals, then for the end of the block; end the process if the block does not end in time."""
    with reader:
        while received := reader.recv(1):
            if received[0] in numbers:
                if not finished.wait(GRACE):
                    os.write(2, f"\n{message}\n".encode(errors="backslashreplace"))
                    os._exit(128 + received[0])
                return
