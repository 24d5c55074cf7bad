"""The simulator as the viewer sees it: a process that takes commands and gives reports."""

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator

from lgmdjax.viewer.messages import Command, Report, Status

GRACE = 0.5  # s for the process to end by itself
MAX_WAITING = 30  # reports that wait to be shown; with more, the simulator waits


class Simulator:
    """A process that simulates, started at the first command."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._reports: queue.Queue[Report] = queue.Queue(MAX_WAITING)
        self._sending = threading.Lock()

    def send(self, *commands: Command) -> None:
        """Send commands; start the process if it does not run."""
        with self._sending:
            process = self._process if self._process is not None and self.runs else self._start()
            with contextlib.suppress(OSError):  # the end of its output also says that it ended
                for command in commands:
                    pickle.dump(command, process.stdin)  # type: ignore[arg-type]
                process.stdin.flush()  # type: ignore[union-attr]

    @property
    def runs(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    def reports(self) -> Iterator[Report]:
        """Yield the reports that have arrived."""
        while True:
            try:
                yield self._reports.get_nowait()
            except queue.Empty:
                return

    def close(self) -> None:
        """End the process."""
        if self._process is None:
            return
        try:
            self._process.stdin.close()  # type: ignore[union-attr]
            self._process.wait(GRACE)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
        self._process = None

    def _start(self) -> "subprocess.Popen[bytes]":
        # Ctrl-C must not reach it: the viewer ends, and then ends it.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lgmdjax.viewer.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=os.name == "posix",
        )
        threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()
        return self._process

    def _listen(self, process: "subprocess.Popen[bytes]") -> None:
        try:
            while True:
                self._reports.put(pickle.load(process.stdout))  # type: ignore[arg-type]
        except Exception:  # the end of its output, or an incomplete report
            if process is self._process:
                self._reports.put(Status("the simulator ended; press Live again", failed=True))
