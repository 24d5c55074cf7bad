"""`lgmdjax bench all [FOLDER [labels.csv]]`: every benchmark of looming detectors, in one table and on one page.

Runs the benchmarks of stimuli, of clips if there is a folder of labelled videos, of fits, and of the closed loop, each
in its own folder, and writes a folder all-<scale>:

| file                  | content                                                             |
| --------------------- | ------------------------------------------------------------------- |
| index.html            | the table, with the table and the figure of every benchmark         |
| scores.md, .tex, .csv | the table for a page, for a paper, and for programs                 |
| scores.json           | the scores of every benchmark, with settings, seed and versions     |

After an interruption, fits and closed loop go on where they were; stimuli and clips take minutes and are run again.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from lgmdjax.bench import stages, summary, tables
from lgmdjax.bench.tables import Table
from lgmdjax.cli import bench_clips, bench_closed_loop, bench_fit, bench_stimuli
from lgmdjax.cli.flags import BenchFlags
from lgmdjax.evaluation import stimulus_scores
from lgmdjax.paths import PACKAGE_DIR
from lgmdjax.reporting import pages
from lgmdjax.runtime import partial_files, storage, versions
from lgmdjax.runtime.storage import JsonObject


class Benchmark(NamedTuple):
    """One of the benchmarks."""

    run: Callable[[BenchFlags], Iterator[str]]
    tabulate: Callable[[Sequence[JsonObject]], Table]
    figure: str = "scores.png"  # name of its file


BENCHMARKS: Mapping[str, Benchmark] = {
    "stimuli": Benchmark(bench_stimuli.run_stimuli, bench_stimuli.table),
    "clips": Benchmark(bench_clips.run_clips, bench_clips.table, "roc.png"),
    "fit": Benchmark(bench_fit.run_fit, tables.fits),
    "closed-loop": Benchmark(bench_closed_loop.run_closed_loop, tables.closed_loop),
}
CAPTION = "Looming detectors on laboratory stimuli, on labelled videos, before and after a fit, and as a robot's eyes."


def run_all(flags: BenchFlags) -> Iterator[str]:
    """Run all benchmarks; yield their lines, then the names of the files of the summary."""
    plan = choose(flags)
    for name, own in plan.items():
        yield from BENCHMARKS[name].run(own)
    folders = {name: folder(own) for name, own in plan.items()}
    found = {name: storage.read_json(place / "scores.json") for name, place in folders.items()}
    table = summary.tabulate({name: facts["rows"] for name, facts in found.items()})
    facts = {"scale": flags.scale, "seed": flags.seed, "versions": versions.installed(), "benchmarks": found}
    texts = {
        "index.html": page(table, facts, folders),
        "scores.md": table.markdown(),
        "scores.tex": table.latex(CAPTION),
        "scores.csv": table.csv(),
    }
    out = flags.out / f"all-{flags.scale}"
    with partial_files.replacing_all(out) as partial:
        storage.write_json(partial / "scores.json", facts)
        for name, text in texts.items():
            (partial / name).write_text(text, encoding="utf-8")
    for name in (*texts, "scores.json"):
        yield str(out / name)


def choose(flags: BenchFlags) -> dict[str, BenchFlags]:
    """Return the flags of every benchmark that runs.

    Ideal observers see no pictures and run on stimuli alone; the robot's own LGMD runs in the closed loop alone.

    Raises InputError for an unknown detector or wrong labels, before any work begins.
    """
    if flags.paths:
        bench_clips.read_arguments(flags.paths)
    given = [name for name in flags.detector if name != stages.OWN]
    seeing = [name for name in given if name == "all" or not stimulus_scores.get_detector(name).is_ideal]
    detectors = {
        "stimuli": given,
        "clips": seeing if flags.paths else [],
        "fit": seeing,
        "closed-loop": [name for name in flags.detector if name in (stages.OWN, *seeing)],
    }
    return {
        name: replace(flags, on=name, detector=tuple(some), paths=flags.paths if name == "clips" else ())
        for name, some in detectors.items()
        if some
    }


def folder(flags: BenchFlags) -> Path:
    """Return the folder of a benchmark's results."""
    return bench_clips.folder_of(flags) if flags.on == "clips" else flags.out / f"{flags.on}-{flags.scale}"


def page(table: Table, facts: JsonObject, folders: Mapping[str, Path]) -> str:
    """Return the page of all results.

    Args:
        table: the summary.
        facts: content of scores.json.
        folders: of the benchmarks.
    """
    template = pages.environment(PACKAGE_DIR / "reporting" / "templates").get_template("benchmarks.html.j2")
    parts = {
        name: {
            "table": BENCHMARKS[name].tabulate(facts["benchmarks"][name]["rows"]),
            "figure": pages.inline("image/png", (place / BENCHMARKS[name].figure).read_bytes()),
            "folder": place.name,
        }
        for name, place in folders.items()
    }
    return template.render({"table": table, "parts": parts, "facts": facts})
