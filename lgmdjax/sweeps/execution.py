"""Execute the runs of a sweep: as processes of this machine, or as jobs of a cluster by submitit.

Every run is a process `python -m lgmdjax ...` with a folder and a log of its own. A run that succeeded leaves its
measures in `finished.json` and is not executed again. A run that was interrupted resumes if its command can.
"""

import contextlib
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from tqdm.auto import tqdm

from lgmdjax.errors import InputError
from lgmdjax.runtime import interruption
from lgmdjax.runtime.storage import JsonObject, read_json, write_json
from lgmdjax.sweeps import results
from lgmdjax.sweeps.sweep_file import Sweep
from lgmdjax.sweeps.task import LOG, Task

HAS_SUBMITIT = find_spec("submitit") is not None
if HAS_SUBMITIT:
    import submitit

POLL = 0.2  # s between two looks at the processes
PROGRAM = (sys.executable, "-m", "lgmdjax")
FINISHED = "finished.json"
MISTAKE = 2  # exit code of a command that was given something wrong, as it will be in other runs


Ended = Generator[tuple[Task, int], None, None]
"""Tasks with their exit codes, each when it has ended."""


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """Where submitit runs the jobs, and what each may use."""

    name: str  # slurm, or local for processes of this machine
    minutes: int  # longest duration of a job
    cores: int  # of a job
    partition: str = ""  # of SLURM; its default if empty


def run_sweep(folder: Path, sweep: Sweep, workers: int = 1, cluster: Cluster | None = None) -> list[JsonObject]:
    """Execute all runs that have not succeeded yet; return a row for each run: setting, seed and measures.

    Args:
        folder: holds a folder for each run.
        sweep: from `sweep_file.read`.
        workers: number of processes at once on this machine.
        cluster: run jobs by submitit instead.

    Raises InputError if runs failed or lack the measures. A mistake in the flags ends the sweep at once; other failures
    do so when all runs have ended. The next call repeats only runs that failed or did not end.
    """
    folder = folder.resolve()  # jobs of a cluster may start elsewhere
    tasks = [Task(run=run, folder=folder / run.name, program=PROGRAM) for run in sweep.runs()]
    waiting = [task for task in tasks if not (task.folder / FINISHED).exists()]
    execute = _execute_here(waiting, workers) if cluster is None else _execute_on_cluster(waiting, cluster, folder)
    failed: list[Task] = []
    with (
        contextlib.closing(execute),
        tqdm(total=len(tasks), initial=len(tasks) - len(waiting), desc="sweep", unit="run") as bar,
    ):
        for task, code in execute:
            if code == 0:
                write_json(task.folder / FINISHED, results.read_measures(task.folder, sweep))
            else:
                failed.append(task)
            bar.update()
            if code == MISTAKE:
                break
    if failed:
        raise _failure(failed, len(tasks))
    return [_row(task) for task in tasks]


def _row(task: Task) -> JsonObject:
    return {
        "number": task.run.number,
        "setting": dict(task.run.setting),
        "seed": task.run.seed,
        "measures": read_json(task.folder / FINISHED),
    }


def _execute_here(tasks: Sequence[Task], workers: int) -> Ended:
    """Execute tasks as processes, `workers` at once; yield each with its exit code when it has ended."""
    waiting, running = deque(tasks), dict[Task, subprocess.Popen[bytes]]()
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                task = waiting.popleft()
                running[task] = task.start()
            ended = {task: code for task, process in running.items() if (code := process.poll()) is not None}
            for task, code in ended.items():
                del running[task]
                yield task, code
            _pause()
    finally:
        _end([process.terminate for process in running.values()])
        for process in running.values():
            process.wait()


def _execute_on_cluster(tasks: Sequence[Task], cluster: Cluster, folder: Path) -> Ended:
    """Execute tasks as jobs of a cluster; yield each with its exit code when it has ended.

    Jobs read and write `folder`, which all machines of the cluster must see under this path.
    """
    executor = submitit.AutoExecutor(folder=folder / "jobs", cluster=cluster.name)
    executor.update_parameters(name="lgmdjax", timeout_min=cluster.minutes, cpus_per_task=cluster.cores)
    if cluster.partition:
        executor.update_parameters(slurm_partition=cluster.partition)
    with executor.batch():
        jobs = {task: executor.submit(task.execute) for task in tasks}
    try:
        while jobs:
            ended = [task for task, job in jobs.items() if job.done()]
            for task in ended:
                job = jobs.pop(task)
                yield task, 1 if job.exception() else job.result()
            _pause()
    finally:
        _end([job.cancel for job in jobs.values()])


def check(workers: int, cluster: Cluster | None) -> None:
    """Raise `InputError` for numbers that cannot be, and for a cluster without submitit or SLURM."""
    numbers = {"workers": workers} | ({"minutes": cluster.minutes, "cores": cluster.cores} if cluster else {})
    for name, number in numbers.items():
        if number < 1:
            raise InputError(f"expected one or more --{name}, got {number}; choose another number")
    if cluster and not HAS_SUBMITIT:
        raise InputError("expected submitit for --submitit, found none; pip install 'lgmdjax[cluster]'")
    if cluster and cluster.name == "slurm" and submitit.SlurmExecutor.affinity() <= 0:
        raise InputError("expected SLURM's srun on this machine, found none; leave --submitit out to run here")


def _pause() -> None:
    interruption.check()
    time.sleep(POLL)


def _end(actions: Sequence[Callable[[], object]]) -> None:
    """Perform all actions, although one of the processes that they end may be gone."""
    for action in actions:
        with contextlib.suppress(Exception):
            action()


def _failure(failed: Sequence[Task], total: int) -> InputError:
    """Return the error that names the first run that failed, with its own error if it ended with one line."""
    log = failed[0].folder / LOG
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else []
    last = next((line for line in reversed(lines) if line.startswith("lgmdjax: ")), "lgmdjax: see its log")
    return InputError(
        f"expected all {total} runs to succeed, got {len(failed)} that failed, the first with setting "
        f"{dict(failed[0].run.setting)} and seed {failed[0].run.seed} ({last.removeprefix('lgmdjax: ')[:300]}); "
        f"read {log}; the same command repeats only these"
    )
