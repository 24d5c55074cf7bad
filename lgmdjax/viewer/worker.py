"""The simulator: a process that reads commands on its input and writes reports to its output, as pickles.

`python -m lgmdjax.viewer.worker` is started by `lgmdjax.viewer.simulator`, and ends when its input does, even
while it compiles, or if the viewer was killed.
"""

import os
import pickle
import queue
import sys
import threading
import time
from typing import BinaryIO

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import program_cache
from lgmdjax.viewer.live import LiveSimulation
from lgmdjax.viewer.messages import Command, Controls, Live, Move, Open, Place, RecordCommand, Report, Status, Step
from lgmdjax.viewer.sources import WalkSource

IDLE = 0.05  # s between two checks for commands, while nothing is simulated


class Worker:
    """Takes commands and simulates in between."""

    def __init__(self, output: BinaryIO):
        self.output = output
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self.live: LiveSimulation | None = None
        self.source: WalkSource | None = None
        self.controls = Controls()

    def report(self, report: Report) -> None:
        """Send a report."""
        pickle.dump(report, self.output, protocol=pickle.HIGHEST_PROTOCOL)
        self.output.flush()

    def run(self) -> None:
        """Execute commands until the process ends."""
        while True:
            try:
                self._turn()
            except InputError as error:
                self.report(Status(one_line(error), failed=self.live is None))
            except Exception as error:  # the viewer shows it: nobody reads this process's stderr
                self.live = self.source = None
                self.report(Status(f"{type(error).__name__}: {one_line(error)[:300]}", failed=True))

    def _turn(self) -> None:
        while not self.commands.empty():
            self._execute(self.commands.get())
        if self.live is not None and self.live.is_due():
            self.report(self.live.advance())
        elif self.source is not None and self.source.is_behind():
            self.report(self.source.sense())
        else:
            time.sleep(IDLE if self.live is None else 0.001)

    def _execute(self, command: Command) -> None:
        match command:
            case Open():
                self.live = self.source = None
                self.source = WalkSource(command, self.report)
                self.report(self.source.walks())
            case Live():
                self.live = self.source = None
                self.live = LiveSimulation(command, self.controls, self.report)
                self.report(self.live.entered())
            case Controls():
                self.controls = command
                if self.live is not None:
                    self.live.steer(command)
            case Move() | Place() | Step() | RecordCommand() if self.live is not None:
                self.live.execute(command)


def main() -> None:
    """Run the simulator on stdin and stdout; what libraries print goes to stderr."""
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    program_cache.protect()
    worker = Worker(output)

    def listen() -> None:
        try:
            while True:
                worker.commands.put(pickle.load(sys.stdin.buffer))
        except Exception:  # the end of the input, or an incomplete command
            os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    try:
        worker.run()
    except OSError:  # nobody reads the output
        os._exit(0)


if __name__ == "__main__":
    main()
