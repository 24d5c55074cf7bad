"""Tables of scores: Markdown for pages, LaTeX for papers, CSV with every number and interval for programs."""

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from lgmdjax.bench import worlds
from lgmdjax.bench.settings import CAMERA_FAULTS
from lgmdjax.evaluation import trials
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


def closed_loop(rows: Sequence[JsonObject]) -> Table:
    """Return the table of the closed loop; rows as in its scores.json."""
    scenes = list(rows[0][worlds.SCENES])
    header = [
        "detector", "collisions / 100 m", "coverage [1/min]", "hard turning",
        *(f"{scene} {_outcome(scene)}" for scene in scenes),
        *(f"{world}: collisions / 100 m, coverage" for world in CAMERA_FAULTS), "r of turns", "us a frame",
    ]  # fmt: skip
    return Table(header, [[*_cells(row, scenes)] for row in rows])


def _outcome(scene: str) -> str:
    """Return what counts as success in a scene: whether there is anything to pass."""
    return "passed" if math.isfinite(trials.TRIALS[scene].beyond) else "untouched"


def _cells(row: JsonObject, scenes: Sequence[str]) -> Iterator[str]:
    rooms = row[worlds.ROOMS]
    yield row["detector"]
    yield estimate(rooms["per_100_m"], 1)
    yield estimate(rooms["progress"]["coverage"], 1)
    yield f"{100 * rooms['progress']['hard_turning']['value']:.0f} %"
    for scene in scenes:
        outcome = row[worlds.SCENES][scene]
        yield f"{outcome[_outcome(scene)]} of {outcome['robots']}"
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

    >>> estimate({"value": 2.22, "low": 0.27, "high": 8.03}, 1)
    '2.2 (0.3 to 8.0)'
    """
    middle, low, high = (number(value[name], digits) for name in ("value", "low", "high"))
    return f"{middle} ({low} to {high})"


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
