"""All results of the detectors in one table: what they tell apart, how they steer, what they cost, what a fit changes.

Every benchmark gives some columns, in the order in which they are run:

| benchmark   | columns                                                                                            |
| ----------- | -------------------------------------------------------------------------------------------------- |
| stimuli     | areas under ROC of dark and bright approach against the rest; slope of the peak's time over l/|v|  |
| clips       | area under ROC of the adapted response; hits and false alarms, leave-one-out                       |
| fit         | both scores of `lgmdjax.bench.fitting`, with published constants, after search, and after fit      |
| closed-loop | collisions and coverage in random rooms, obstacles passed, white walls untouched, camera faults    |
"""

from collections.abc import Callable, Mapping, Sequence

from lgmdjax.bench import worlds
from lgmdjax.bench.settings import CAMERA_FAULTS
from lgmdjax.bench.tables import Table, estimate, number, outcome
from lgmdjax.runtime.storage import JsonObject

Rows = Sequence[JsonObject]
"""Scores of a benchmark, one of each detector, as in its scores.json."""

Columns = Mapping[str, str]
"""Cells of one detector by the heads of their columns."""


def tabulate(results: Mapping[str, Rows]) -> Table:
    """Return the table of some benchmarks; a detector that one of them did not run has dashes there."""
    cells: dict[str, dict[str, str]] = {}
    heads: dict[str, None] = {}
    for benchmark, rows in results.items():
        for row in rows:
            columns = COLUMNS[benchmark](row)
            heads |= dict.fromkeys(columns)
            cells.setdefault(row["detector"], {}).update(columns)
    return Table(("detector", *heads), [(name, *(own.get(head, "-") for head in heads)) for name, own in cells.items()])


def _stimuli(row: JsonObject) -> Columns:
    return {
        "AUC dark, bright": f"{number(row['auc_dark'], 2)}, {number(row['auc_bright'], 2)}",
        "slope": number(row["timing"]["slope"], 2),
    }


def _clips(row: JsonObject) -> Columns:
    adapted = row["adapted"]
    alarms = adapted["leave_one_out"]
    return {
        "AUC clips": number(adapted["auc"], 2),
        "hits, false": f"{alarms['hits']} of {alarms['approaches']}, {alarms['false_alarms']}",
    }


def _fit(row: JsonObject) -> Columns:
    walks, stimuli = row["walks"]["scores"], row["stimuli"]["scores"]
    return {
        "fit: r": " / ".join(number(score["value"], 2) for score in walks.values()),
        "fit: AUC": " / ".join(number(score, 2) for score in stimuli.values()),
    }


def _closed_loop(row: JsonObject) -> Columns:
    rooms, scenes = row[worlds.ROOMS], row[worlds.SCENES]
    passable = [scene for name, scene in scenes.items() if outcome(name) == "passed"]
    walls = [scene for name, scene in scenes.items() if outcome(name) != "passed"]
    faulty = {
        f"{world}: / 100 m": estimate(row[world]["per_100_m"], 1) if world in row else "-" for world in CAMERA_FAULTS
    }
    return {
        "collisions / 100 m": estimate(rooms["per_100_m"], 1),
        "coverage [1/min]": estimate(rooms["progress"]["coverage"], 1),
        "passed": f"{sum(scene['passed'] for scene in passable)} of {sum(scene['robots'] for scene in passable)}",
        "walls": f"{sum(scene['untouched'] for scene in walls)} of {sum(scene['robots'] for scene in walls)}",
        **faulty,
        "us": number(row.get("microseconds"), 0),
    }


COLUMNS: Mapping[str, Callable[[JsonObject], Columns]] = {
    "stimuli": _stimuli,
    "clips": _clips,
    "fit": _fit,
    "closed-loop": _closed_loop,
}
