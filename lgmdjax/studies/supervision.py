"""Which rule should teach, and what should learn? Navigators from several rules and of several kinds, in closed loop.

The paper says that vehicle 2a alone and vehicle 3b alone make poor controllers when learned (sec. 4.2), and that an
LSTM does better than a feed-forward network and than the rule straight on u (sec. 3.4). Here each rule teaches an LSTM,
from its own walks and then from the pupil's, and so does the rule that this package teaches by; by that one learn the
other kinds of network as well. All get the same rooms, the same time and as many starts, so that a difference can be
told from luck.

Writes teaching.json: a row a case and seed, with the score of the pupil, and rows of the teachers and of the direct
driver, which learns nothing.

Source: Cizek & Faigl, sec. 3.4 and 4.2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from lgmdjax.control import braitenberg, navigator, policies
from lgmdjax.evaluation import metrics
from lgmdjax.learning import behaviour_cloning, dagger
from lgmdjax.locomotion import cpg
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import compiled_code, storage
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.studies.settings import SupervisionSettings

_PRINTED = braitenberg.Params(full_turn=0.0, symmetry=0.0)  # eq. 22 within the gait's range
RULES = {
    "2a": replace(_PRINTED, gain_3b=0.0),
    "3b": replace(_PRINTED, gain_2a=0.0),
    "eq. 22": _PRINTED,
    "teacher": braitenberg.Params(),
}


@dataclass(frozen=True, kw_only=True)
class Case:
    """Who learns from whom."""

    rule: str
    variant: navigator.Variant


CASES = (
    Case(rule="2a", variant="lstm"),
    Case(rule="3b", variant="lstm"),
    Case(rule="eq. 22", variant="lstm"),
    Case(rule="teacher", variant="lstm"),
    Case(rule="teacher", variant="lstm-efference"),
    Case(rule="teacher", variant="feed-forward"),
)


def work(folder: Path, inputs: Mapping[str, Path], settings: SupervisionSettings, seed: int) -> None:
    """Teach every case from every start, and score all on one bench."""
    robot = assembly.with_eyes(assembly.trained(inputs["fit-gait"], inputs["train"]), settings.bench.eyes)
    rows = []
    for rule in RULES:
        rows.append(_score(folder / f"rule-{rule}", under(robot, rule), settings, policies.TEACHER, seed, rule=rule))
    rows.append(_score(folder / "direct", robot, settings, policies.DIRECT, seed, rule="teacher"))
    for number in range(settings.seeds):
        for case in CASES:
            place = folder / f"{case.rule}-{case.variant}-{number}"
            pupil = teach(place, under(robot, case.rule), case.variant, settings, seed + number)
            facts = {"rule": case.rule, "variant": case.variant, "start": number}
            rows.append(_score(place / "bench", pupil, settings, policies.LEARNED, seed, **facts))
        compiled_code.let_go()  # a start's fits and walks are two dozen
    storage.write_json(folder / "supervision.json", rows)


def under(robot: closed_loop.Params, rule: str) -> closed_loop.Params:
    """Put a robot under a rule, which labels its walks and drives when the teacher does."""
    params = jax.tree.map(lambda value: jnp.asarray(value, float), RULES[rule])
    return assembly.manned(replace(robot, teacher=params), params)


def teach(
    folder: Path, robot: closed_loop.Params, variant: navigator.Variant, settings: SupervisionSettings, seed: int
) -> closed_loop.Params:
    """Let a robot's teacher walk, its pupil practise, and fit the pupil once more; give the robot with it aboard."""
    school = settings.practice
    facts = {"school": asdict(settings)}
    walks = dagger.lesson(folder / "lesson", robot, school.robots, settings.lesson_seconds, seed, facts)
    walks = dagger.practise(folder, robot, walks, school, seed, variant)
    learned, test = dagger.learn(folder / "checkpoints" / "last", walks, school.epochs, seed, variant)
    return assembly.manned(robot, behaviour_cloning.enliven(learned, test))


def _score(
    folder: Path,
    robot: closed_loop.Params,
    settings: SupervisionSettings,
    driver: policies.Driver,
    seed: int,
    **facts: Any,
) -> dict[str, Any]:
    record = recording.benched(folder, robot, settings.bench, driver, seed, label=" ".join(map(str, facts.values())))
    return {"driver": driver.name, **facts} | asdict(metrics.score(record, cpg.CYCLE_TIME))


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw collisions per 100 m of every case, a dot a start with its interval; rows as in teaching.json."""
    names = list(dict.fromkeys(label(row) for row in rows))
    figure = Figure(figsize=(style.WIDTH, 0.9 + 0.34 * len(names)), layout="constrained")
    axes = figure.subplots()
    for row in rows:
        rate, start = row["per_100_m"], row.get("start", 0)
        y = names.index(label(row)) + 0.16 * (start - 1 if "start" in row else 0)
        colour = style.DRIVERS[row["driver"]]
        axes.plot([rate["low"], rate["high"]], [y, y], color=colour, linewidth=1.6, alpha=0.6)
        axes.plot([rate["value"]], [y], "o", color=colour, markersize=4.5, clip_on=False, zorder=3)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="collisions per 100 m", ylim=(len(names) - 0.4, -0.6))
    axes.set_xlim(0, 1.05 * axes.get_xlim()[1])
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", length=0)
    return figure


def label(row: Mapping[str, Any]) -> str:
    """Name the case of a row."""
    if row["driver"] == "learned":
        return f"{row['variant']}, taught by {row['rule']}"
    return "direct, nothing learned" if row["driver"] == "direct" else f"{row['rule']} itself, on the laser"


def pooled(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Sum collisions and ways of the starts of each case, in the order of the rows, with the rates of each start."""
    cases: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        cases.setdefault(label(row), []).append(row)
    return {
        name: {
            "starts": len(some),
            "distance": sum(row["distance"] for row in some),
            "collisions": sum(row["collisions"] for row in some),
            "per_100_m": asdict(
                metrics.poisson_rate(sum(row["collisions"] for row in some), sum(row["distance"] for row in some) / 100)
            ),
            "each": np.array([row["per_100_m"]["value"] for row in some]).tolist(),
        }
        for name, some in cases.items()
    }
