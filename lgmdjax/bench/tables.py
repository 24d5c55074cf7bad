"""Scores as tables and files: Markdown for pages, LaTeX for papers, CSV with all numbers for programs, JSON, figure."""

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from lgmdjax.bench import worlds
from lgmdjax.bench.settings import CAMERA_FAULTS
from lgmdjax.evaluation import trials
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import partial_files, storage, versions
from lgmdjax.runtime.storage import JsonObject

ESCAPED = {"\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$", "<": "$<$"}


class Table(NamedTuple):
    """Texts of a table; the first column is a name."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Return the table as Markdown.

        >>> print(Table(("a", "b"), [("x", "1")]).markdown(), end="")
        | a | b |
        | --- | --- |
        | x | 1 |
        """
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def csv(self) -> str:
        """Return the table as CSV."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.header, *self.rows])
        return text.getvalue()

    def latex(self, caption: str) -> str:
        """Return the table for LaTeX with the package booktabs.

        >>> print(Table(("a_b",), [("50 %",)]).latex("c").splitlines()[4])
        a\\_b \\\\
        """
        lines = [" & ".join(map(_escape, line)) + r" \\" for line in (self.header, *self.rows)]
        return "\n".join(
            [
                r"\begin{table}",
                rf"\caption{{{_escape(caption)}}}",
                rf"\begin{{tabular}}{{l{'r' * (len(self.header) - 1)}}}",
                r"\toprule",
                lines[0],
                r"\midrule",
                *lines[1:],
                r"\bottomrule",
                r"\end{tabular}",
                r"\end{table}",
                "",
            ]
        )


class Results(NamedTuple):
    """What a benchmark writes."""

    rows: Sequence[JsonObject]  # scores, one of each detector
    table: Table
    figure: Figure
    caption: str
    settings: Any  # a dataclass


def write(folder: Path, results: Results, seed: int) -> list[Path]:
    """Write results into a folder, in every format; return the files."""
    with partial_files.replacing_all(folder) as partial:
        names = write_into(partial, results, seed)
    return [folder / name for name in names]


def write_into(folder: Path, results: Results, seed: int) -> list[str]:
    """Write results into a folder that is being made; return the names of the files."""
    texts = {
        "scores.md": results.table.markdown(),
        "scores.tex": results.table.latex(results.caption),
        "scores.csv": to_csv(results.rows),
    }
    storage.write_json(folder / "scores.json", facts(results.rows, results.settings, seed))
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "scores.png").write_bytes(style.to_png(results.figure))
    return [*texts, "scores.json", "scores.png"]


def facts(rows: Sequence[JsonObject], settings: Any, seed: int) -> JsonObject:
    """Return the content of scores.json: rows, and what they were made with."""
    return {"settings": asdict(settings), "seed": seed, "versions": versions.installed(), "rows": rows}


def fits(rows: Sequence[JsonObject]) -> Table:
    """Return the table of the fits; rows as in its scores.json."""
    steps = list(rows[0]["stimuli"]["scores"])
    header = ["detector", *(f"walks: r, {step}" for step in steps), *(f"stimuli: AUC, {step}" for step in steps)]
    return Table(
        header,
        [
            [
                row["detector"],
                *(estimate(row["walks"]["scores"][step], 2) for step in steps),
                *(number(row["stimuli"]["scores"][step], 2) for step in steps),
            ]
            for row in rows
        ],
    )


def closed_loop(rows: Sequence[JsonObject]) -> Table:
    """Return the table of the closed loop; rows as in its scores.json."""
    scenes = list(rows[0][worlds.SCENES])
    header = [
        "detector", "collisions / 100 m", "coverage [1/min]", "hard turning",
        *(f"{scene} {outcome(scene)}" for scene in scenes),
        *(f"{world}: collisions / 100 m, coverage" for world in CAMERA_FAULTS), "r of turns", "us a frame",
    ]  # fmt: skip
    return Table(header, [[*_cells(row, scenes)] for row in rows])


def outcome(scene: str) -> str:
    """Return what counts as success in a scene: whether there is anything to pass."""
    return "passed" if math.isfinite(trials.TRIALS[scene].beyond) else "untouched"


def _cells(row: JsonObject, scenes: Sequence[str]) -> Iterator[str]:
    rooms = row[worlds.ROOMS]
    yield row["detector"]
    yield estimate(rooms["per_100_m"], 1)
    yield estimate(rooms["progress"]["coverage"], 1)
    yield f"{100 * rooms['progress']['hard_turning']['value']:.0f} %"
    for scene in scenes:
        found = row[worlds.SCENES][scene]
        yield f"{found[outcome(scene)]} of {found['robots']}"
    for world in CAMERA_FAULTS:
        faulty = row.get(world)
        yield (
            f"{estimate(faulty['per_100_m'], 1)}, {number(faulty['progress']['coverage']['value'], 1)}"
            if faulty
            else "-"
        )
    fits = row.get("fits")
    yield number(sum(fit["steering"] for fit in fits) / len(fits), 2) if fits else "-"
    yield number(row.get("microseconds"), 0)


def estimate(value: Mapping[str, float | None], digits: int) -> str:
    """Return an estimate with its interval.

    >>> estimate({"value": 2.22, "low": 0.27, "high": 8.03}, 1), estimate({"value": 2.0, "low": None, "high": None}, 0)
    ('2.2 (0.3 to 8.0)', '2')
    """
    middle, low, high = (number(value[name], digits) for name in ("value", "low", "high"))
    return middle if low == "-" else f"{middle} ({low} to {high})"


def number(value: float | None, digits: int) -> str:
    """Return a number with some decimals, or a dash for none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def to_csv(rows: Sequence[JsonObject]) -> str:
    """Return all numbers and texts of the rows as CSV; a column's name is its path in scores.json."""
    flat = [dict(_flatten(row, "")) for row in rows]
    names = list(dict.fromkeys(name for row in flat for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


def _flatten(value: object, name: str) -> Iterator[tuple[str, object]]:
    """Yield the path and value of every number and text in nested mappings; lists are left out."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _flatten(part, f"{name}.{key}".lstrip("."))
    elif not isinstance(value, list):
        yield name, value


def _escape(text: str) -> str:
    return "".join(ESCAPED.get(character, character) for character in text)
