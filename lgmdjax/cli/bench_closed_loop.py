"""`lgmdjax bench closed-loop`: every looming detector as the eyes of the same robot.

Writes a run folder, closed-loop-<scale>, with a folder for each stage (`lgmdjax.bench.closed_loop`), and there

| file                    | content                                                                |
| ----------------------- | ---------------------------------------------------------------------- |
| scores.md, .tex, .csv   | the table for a page, for a paper, and every number with its interval  |
| scores.json             | the same as JSON, with settings, seed and versions                     |
| scores.png              | collisions, coverage and hard turning of every detector                |
"""

from collections.abc import Iterator

from lgmdjax.bench import closed_loop, stages, tables, worlds
from lgmdjax.bench.settings import CAMERA_FAULTS, CLOSED_LOOP_SCALES
from lgmdjax.cli.flags import BenchFlags
from lgmdjax.errors import InputError
from lgmdjax.evaluation import stimulus_scores
from lgmdjax.reporting.figures import detector_walks
from lgmdjax.runtime import run_folders, storage
from lgmdjax.simulation import assembly
from lgmdjax.simulation.closed_loop import Params

CAPTION = "Looming detectors that steer the same robot, with navigators trained in the same way."


def run_closed_loop(flags: BenchFlags) -> Iterator[str]:
    """Run the comparison, or resume it; yield a line about each detector, then the names of the files."""
    names, size = stimulus_scores.choose_seeing(flags.detector, [stages.OWN]), CLOSED_LOOP_SCALES[flags.scale]
    planned, settings = closed_loop.plan(load_robot(flags), names, size)
    name, remedy = f"closed-loop-{flags.scale}", "choose another --out"
    run = run_folders.open_run(flags.out, name, flags.scale, flags.seed, settings, remedy=remedy)
    rows = storage.read_json(run_folders.execute(run, planned, stages.SCORES) / "scores.json")
    for row in rows:
        rooms = row[worlds.ROOMS]
        yield (
            f"{row['detector']}: collisions per 100 m {tables.estimate(rooms['per_100_m'], 1)}, "
            f"coverage {tables.estimate(rooms['progress']['coverage'], 1)} / min"
        )
    figure = detector_walks.plot(rows, (worlds.ROOMS, *CAMERA_FAULTS))
    for file in tables.write(
        run.folder, tables.Results(rows, tables.closed_loop(rows), figure, CAPTION, size), flags.seed
    ):
        yield str(file)


def load_robot(flags: BenchFlags) -> Params:
    """Return the robot that walks: that of a run folder, or the pretrained one. Raises InputError for paths."""
    if flags.paths:
        raise InputError(f"expected no paths after bench {flags.on}, got {flags.paths[0]}; only bench clips has some")
    return assembly.load_robot(flags.run / "fit-gait", flags.run / "train") if flags.run else assembly.load_robot()
