"""`lgmdjax bench stimuli`: looming detectors on laboratory stimuli.

Writes scores.md, .tex, .csv, .json and .png into a folder stimuli-<scale>.
"""

from collections.abc import Iterator, Sequence

from lgmdjax.bench import tables
from lgmdjax.cli.flags import BenchFlags
from lgmdjax.evaluation import stimulus_scores
from lgmdjax.evaluation.settings import STIMULUS_SCALES
from lgmdjax.reporting.figures import stimulus_scores as figure
from lgmdjax.runtime.storage import JsonObject

COLUMNS = ("detector", "AUC dark", "AUC bright", *figure.GROUPS, "slope", "intercept [ms]", "r")
CAPTION = (
    "Looming detectors on laboratory stimuli: areas under ROC, peaks over that of dark approaches, and the line of the "
    "peak's time before contact."
)


def run_stimuli(flags: BenchFlags) -> Iterator[str]:
    """Score the detectors; yield a line about each, then the names of the files."""
    names = list(dict.fromkeys(name for given in flags.detector for name in _expand(given)))
    for name in names:
        stimulus_scores.get_detector(name)  # refuse a wrong name before the work begins
    size = STIMULUS_SCALES[flags.scale]
    clips = stimulus_scores.render_clips(size, flags.seed)
    rows: list[JsonObject] = []
    for name in names:
        rows.append(stimulus_scores.score(name, clips))
        yield f"{name}: area under ROC {rows[-1]['auc_dark']:.2f} (dark), {rows[-1]['auc_bright']:.2f} (bright)"
    results = tables.Results(rows, table(rows), figure.plot(rows), CAPTION, size)
    for file in tables.write(flags.out / f"stimuli-{flags.scale}", results, flags.seed):
        yield str(file)


def _expand(name: str) -> Sequence[str]:
    return tuple(stimulus_scores.DETECTORS) if name == "all" else (name,)


def table(rows: Sequence[JsonObject]) -> tables.Table:
    """Return the scores as a table, a row for each detector.

    A stimulus column is the mean peak over the clips of that kind, divided by the mean peak of the dark approaches.
    """
    return tables.Table(COLUMNS, [_row(row) for row in rows])


def _row(row: JsonObject) -> tuple[str, ...]:
    timing = row["timing"]
    delay = None if timing["intercept"] is None else 1000 * timing["intercept"]
    numbers = (row["auc_dark"], row["auc_bright"], *figure.grouped(row).values(), timing["slope"])
    return (
        row["detector"],
        *(tables.number(x, 2) for x in numbers),
        tables.number(delay, 0),
        tables.number(timing["r"], 3),
    )
