"""`lgmdjax bench fit`: the constants of every looming detector, before and after a fit by gradient.

Writes a run folder, fit-<scale>, with a folder for each stage (`lgmdjax.bench.fitting`), and there

| file                    | content                                                                      |
| ----------------------- | ---------------------------------------------------------------------------- |
| scores.md, .tex, .csv   | the table for a page, for a paper, and every number with its interval        |
| scores.json             | the same as JSON, with all constants and curves, settings, seed and versions |
| scores.png              | both scores of every detector before and after                               |
"""

from collections.abc import Iterator

from lgmdjax.bench import fitting, stages, tables
from lgmdjax.bench.settings import FIT_SCALES
from lgmdjax.cli import bench_closed_loop
from lgmdjax.cli.flags import BenchFlags
from lgmdjax.evaluation import stimulus_scores
from lgmdjax.reporting.figures import detector_fits
from lgmdjax.runtime import run_folders, storage

CAPTION = "Scores of looming detectors with published constants, after a search, and after a fit by gradient."


def run_fit(flags: BenchFlags) -> Iterator[str]:
    """Run the fits, or resume them; yield a line about each detector, then the names of the files."""
    names, size = stimulus_scores.choose_seeing(flags.detector), FIT_SCALES[flags.scale]
    planned, settings = fitting.plan(bench_closed_loop.load_robot(flags), names, size)
    name, remedy = f"fit-{flags.scale}", "choose another --out"
    run = run_folders.open_run(flags.out, name, flags.scale, flags.seed, settings, remedy=remedy)
    rows = storage.read_json(run_folders.execute(run, planned, stages.SCORES) / "scores.json")
    for row in rows:
        yield f"{row['detector']}: r on walks {_change(row['walks'])}; area under ROC {_change(row['stimuli'])}"
    results = tables.Results(rows, tables.fits(rows), detector_fits.plot(rows), CAPTION, size)
    for file in tables.write(run.folder, results, flags.seed):
        yield str(file)


def _change(found: storage.JsonObject) -> str:
    """Return the scores of the published, searched and fitted constants."""
    values = (found["scores"][step] for step in fitting.STEPS)
    return ", ".join(f"{value['value'] if isinstance(value, dict) else value:.2f}" for value in values)
