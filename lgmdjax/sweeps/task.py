"""One run of a sweep as a process with its own folder and log. Imports no JAX, which would delay every job."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

from lgmdjax.sweeps.sweep_file import SweepRun

LOG = "log.txt"


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """A run and its folder."""

    run: SweepRun
    folder: Path
    program: tuple[str, ...]  # that takes the arguments of the run

    def execute(self) -> int:
        """Execute the run, with its output in the log; return its exit code."""
        return self.start().wait()

    def start(self) -> subprocess.Popen[bytes]:
        """Start the process of the run."""
        self.folder.mkdir(parents=True, exist_ok=True)
        command = [*self.program, *self.run.arguments(self.folder)]
        with (self.folder / LOG).open("ab") as log:
            return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)
