"""`lgmdjax bench stimuli`: looming detectors on laboratory stimuli, as a table, as JSON and as a figure."""

from collections.abc import Iterator, Sequence

from lgmdjax.cli.flags import BenchFlags
from lgmdjax.evaluation import stimulus_scores
from lgmdjax.evaluation.settings import STIMULUS_SCALES
from lgmdjax.reporting.figures import stimulus_scores as figure
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import partial_files, storage
from lgmdjax.runtime.storage import JsonObject

COLUMNS = ("detector", "AUC dark", "AUC bright", *figure.GROUPS, "slope", "intercept [ms]", "r")


def run_stimuli(flags: BenchFlags) -> Iterator[str]:
    """Score the detectors; yield a line about each, then the names of the files."""
    names = list(dict.fromkeys(name for given in flags.detector for name in _expand(given)))
    for name in names:
        stimulus_scores.get_detector(name)  # refuse a wrong name before the work begins
    clips = stimulus_scores.render_clips(STIMULUS_SCALES[flags.scale], flags.seed)
    rows: list[JsonObject] = []
    for name in names:
        rows.append(stimulus_scores.score(name, clips))
        yield f"{name}: area under ROC {rows[-1]['auc_dark']:.2f} (dark), {rows[-1]['auc_bright']:.2f} (bright)"
    with partial_files.replacing_all(flags.out / f"{flags.on}-{flags.scale}") as folder:
        storage.write_json(folder / "scores.json", rows)
        (folder / "scores.md").write_text(table(rows), encoding="utf-8")
        (folder / "scores.png").write_bytes(style.to_png(figure.plot(rows)))
    for file in ("scores.md", "scores.json", "scores.png"):
        yield str(flags.out / f"{flags.on}-{flags.scale}" / file)


def _expand(name: str) -> Sequence[str]:
    return tuple(stimulus_scores.DETECTORS) if name == "all" else (name,)


def table(rows: Sequence[JsonObject]) -> str:
    """Return the scores as a Markdown table, a row for each detector.

    A stimulus column is the mean peak over the clips of that kind, divided by the mean peak of the dark approaches.
    """
    lines = [COLUMNS, ("---",) * len(COLUMNS), *(_row(row) for row in rows)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _row(row: JsonObject) -> tuple[str, ...]:
    timing = row["timing"]
    delay = None if timing["intercept"] is None else 1000 * timing["intercept"]
    groups = figure.grouped(row)
    numbers = (row["auc_dark"], row["auc_bright"], *groups.values(), timing["slope"])
    return (row["detector"], *(_format(x, 2) for x in numbers), _format(delay, 0), _format(timing["r"], 3))


def _format(number: float | None, digits: int) -> str:
    return "-" if number is None else f"{number:.{digits}f}"
