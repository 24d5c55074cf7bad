"""Results of a sweep: the measures of every run, and their means over seeds with intervals."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.runtime.storage import JsonObject, read_table
from lgmdjax.sweeps.sweep_file import Sweep


def read_measures(folder: Path, sweep: Sweep) -> JsonObject:
    """Return the measures of one run by name, from the one file in its folder that `sweep.result` matches.

    Raises InputError if there is not one such file, or no finite number under the name of a measure.
    """
    found = sorted(folder.glob(sweep.result))
    if len(found) != 1:
        raise InputError(
            f"expected one file {sweep.result} of `lgmdjax {sweep.command[0]}` in {folder}, found {len(found)}; "
            f"correct result in the file of the sweep"
        )
    content = read_table(found[0])
    return {measure: _find(content, measure, found[0]) for measure in sweep.measures}


def _find(content: Any, measure: str, file: Path) -> float:
    """Return the number at a path of keys, such as progress.coverage.value, or of numbers of a list."""
    for key in measure.split("."):
        names = list(content) if isinstance(content, dict) else []
        names = [str(index) for index in range(len(content))] if isinstance(content, list) else names
        if key not in names:
            choices = ", ".join(names[:20]) or repr(content)
            raise InputError(f"expected {measure} in {file}, found at {key!r} only {choices}; correct measures")
        content = content[int(key)] if isinstance(content, list) else content[key]
    if isinstance(content, bool) or not isinstance(content, (int, float)) or not math.isfinite(content):
        raise InputError(f"expected a finite number at {measure} in {file}, got {content!r}; correct measures")
    return float(content)


def summarise(sweep: Sweep, rows: Sequence[JsonObject]) -> list[JsonObject]:
    """Return, for each setting, the mean of each measure over seeds, with its interval, and the values of the runs."""
    summary = []
    for number, setting in enumerate(sweep.settings):
        own = [row["measures"] for row in rows if row["number"] == number]
        values = {measure: [measures[measure] for measures in own] for measure in sweep.measures}
        means = {measure: vars(metrics.student_mean(some)) for measure, some in values.items()}
        summary.append({"setting": dict(setting), "means": means, "values": values})
    return summary


def table(sweep: Sweep, summary: Sequence[JsonObject]) -> str:
    """Return the summary as a Markdown table, a row for each setting."""
    lines = [(*sweep.varied(), *sweep.measures), ("---",) * (len(sweep.varied()) + len(sweep.measures))]
    for row in summary:
        setting = [_cell(row["setting"].get(flag, "-")) for flag in sweep.varied()]
        lines.append((*setting, *(_estimate(row["means"][measure]) for measure in sweep.measures)))
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _estimate(mean: JsonObject) -> str:
    """Return a mean with its interval; a single run has none."""
    return str(metrics.Estimate(**mean)) if math.isfinite(mean["low"]) else f"{mean['value']:.3g}"


def _cell(value: object) -> str:
    text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
    return text.replace("|", r"\|").replace("\n", " ")
