"""`lgmdjax sweep`: all runs of a sweep, then a table and a figure of their measures."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from lgmdjax.cli.flags import SweepFlags
from lgmdjax.reporting.figures import style
from lgmdjax.reporting.figures import sweeps as figure
from lgmdjax.runtime import storage
from lgmdjax.runtime.run_folders import Stage, execute, open_run
from lgmdjax.sweeps import execution, results, sweep_file


def run(flags: SweepFlags) -> Path:
    """Execute a sweep, or resume it; return the folder with runs.json, sweep.json, sweep.md and sweep.png.

    `runs.json` has the measures of every run, the others their means over seeds.
    """
    sweep = sweep_file.read(flags.file)
    cluster = None
    if flags.submitit:
        cluster = execution.Cluster(
            name=flags.submitit, minutes=flags.minutes, cores=flags.cores, partition=flags.partition
        )
    execution.check(flags.workers, cluster)

    def work(folder: Path, inputs: Mapping[str, Path], settings: object, seed: int) -> None:
        rows = execution.run_sweep(folder / "runs", sweep, flags.workers, cluster)
        summary = results.summarise(sweep, rows)
        storage.write_json(folder / "runs.json", rows)
        storage.write_json(folder / "sweep.json", summary)
        (folder / "sweep.md").write_text(results.table(sweep, summary), encoding="utf-8")
        (folder / "sweep.png").write_bytes(style.to_png(figure.plot(summary)))

    opened = open_run(flags.out, flags.name or flags.file.stem, "sweep", 0, {"sweep": asdict(sweep)})
    return execute(opened, (Stage(name="sweep", run=work),), "sweep")
