"""Which rule should be the teacher, and which network should learn? Navigators compared in the closed loop.

The paper says that vehicle 2a alone and vehicle 3b alone make poor controllers when learned (sec. 4.2), and that an
LSTM does better than a feed-forward network and than the rule applied directly to u (sec. 3.4). Here each rule
supervises an LSTM, first on its own walks and then on the learner's (DAgger), and so does the teacher of this package.
The teacher of this package also supervises the other kinds of network. All cases get the same rooms, the same simulated
time and the same number of random seeds, so that a difference can be distinguished from chance.

Writes supervision.json: a row for each case and seed with the score of the learner, a row for each rule that walks
itself, and a row for the policy `direct`, which learns nothing.

Source: Cizek & Faigl, sec. 3.4 and 4.2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lgmdjax.control import braitenberg, names, policies
from lgmdjax.evaluation import metrics
from lgmdjax.learning import behaviour_cloning, dagger
from lgmdjax.locomotion import cpg
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import compiled_code, storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.studies.settings import SupervisionSettings

# Eq. 22 with the paper's v_base and the nearest distances, within the gait's range.
_PRINTED = braitenberg.Params(base=1.2, full_turn=0.0, tie_tolerance=0.0, corridor=0.0)
RULES = {
    "2a": replace(_PRINTED, gain_3b=0.0),
    "3b": replace(_PRINTED, gain_2a=0.0),
    "eq. 22": _PRINTED,
    "teacher": braitenberg.Params(),
}


@dataclass(frozen=True, kw_only=True)
class Case:
    """A rule, and the kind of network that learns from it."""

    rule: str
    variant: names.Variant


CASES = (
    Case(rule="2a", variant="lstm"),
    Case(rule="3b", variant="lstm"),
    Case(rule="eq. 22", variant="lstm"),
    Case(rule="teacher", variant="lstm"),
    Case(rule="teacher", variant="lstm-efference"),
    Case(rule="teacher", variant="feed-forward"),
)


def run(folder: Path, inputs: Mapping[str, Path], settings: SupervisionSettings, seed: int) -> None:
    """Train every case with every random seed, and score all in the benchmark rooms."""
    robot = assembly.with_resolution(assembly.load_robot(inputs["fit-gait"], inputs["train"]), settings.benchmark.eyes)
    rows = []
    for rule in RULES:
        ruled, facts = with_rule(robot, rule), {"rule": rule}
        rows.append(_score(folder / f"rule-{rule}", ruled, settings, policies.TEACHER, seed, facts=facts))
    rows.append(_score(folder / "direct", robot, settings, policies.DIRECT, seed, facts={"rule": "teacher"}))
    for repeat in range(settings.seeds):
        for case in CASES:
            case_folder = folder / f"{case.rule}-{case.variant}-{repeat}"
            learner = train_learner(case_folder, with_rule(robot, case.rule), case.variant, settings, seed + repeat)
            facts = {"rule": case.rule, "variant": case.variant, "repeat": repeat}
            walks = case_folder / "benchmark"
            rows.append(_score(walks, learner, settings, policies.LEARNED, seed, facts=facts))
        compiled_code.clear_caches_if_near_limit()  # the fits and rollouts of one seed are two dozen programs
    storage.write_json(folder / "supervision.json", rows)


def with_rule(robot: closed_loop.Params, rule: str) -> closed_loop.Params:
    """Set the rule that labels the robot's walks, and that the policy `teacher` follows."""
    return assembly.with_teacher(robot, RULES[rule])


def train_learner(
    folder: Path, robot: closed_loop.Params, variant: names.Variant, settings: SupervisionSettings, seed: int
) -> closed_loop.Params:
    """Record demonstrations of the robot's teacher, train a navigator by DAgger, and return the robot with it."""
    training, facts = settings.dagger, {"settings": asdict(settings)}
    walks = dagger.record_demonstrations(
        folder / "demonstrations",
        robot,
        robots=training.robots,
        seconds=settings.demonstration_seconds,
        seed=seed,
        parameters=facts,
    )
    walks = dagger.run(folder, robot, walks, training, seed, variant=variant)
    learned, test = dagger.fit_navigator(folder / "checkpoints" / "last", walks, training.epochs, seed, variant)
    return assembly.with_policy(robot, "learned", behaviour_cloning.rescale_turns(learned, test))


def _score(
    folder: Path, robot: closed_loop.Params, settings: SupervisionSettings, policy: policies.Policy, seed: int, *,
    facts: JsonObject,
) -> JsonObject:  # fmt: skip
    """Record the robot in the benchmark rooms; return its row, which begins with the policy and `facts`."""
    label = " ".join(map(str, facts.values()))
    record = recording.record_benchmark(folder, robot, settings.benchmark, policy, seed, label=label)
    return {"policy": policy.name, **facts} | asdict(metrics.score(record, cpg.CYCLE_TIME))


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot collisions per 100 m of every case, a dot with its interval for each seed; rows as in supervision.json."""
    names = list(dict.fromkeys(case_label(row) for row in rows))
    figure = Figure(figsize=(style.WIDTH, 0.9 + 0.34 * len(names)), layout="constrained")
    axes = figure.subplots()
    for row in rows:
        rate = row["per_100_m"]
        y = names.index(case_label(row)) + 0.16 * (row["repeat"] - 1 if "repeat" in row else 0)
        colour = style.POLICY_COLOURS[row["policy"]]
        axes.plot([rate["low"], rate["high"]], [y, y], color=colour, linewidth=1.6, alpha=0.6)
        axes.plot([rate["value"]], [y], "o", color=colour, markersize=4.5, clip_on=False, zorder=3)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="collisions per 100 m", ylim=(len(names) - 0.4, -0.6))
    axes.set_xlim(0, 1.05 * axes.get_xlim()[1])
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", length=0)
    return figure


def case_label(row: JsonObject) -> str:
    """Return the name of a row's case.

    >>> case_label({"policy": "learned", "variant": "lstm", "rule": "2a"})
    'lstm, taught by 2a'
    """
    if row["policy"] == "learned":
        return f"{row['variant']}, taught by {row['rule']}"
    return "direct, no learning" if row["policy"] == "direct" else f"{row['rule']} itself, with the laser"


def pool_repeats(rows: Sequence[JsonObject]) -> dict[str, JsonObject]:
    """Sum collisions and distances over the seeds of each case, in the order of the rows; list the rate of each."""
    cases: dict[str, list[JsonObject]] = {}
    for row in rows:
        cases.setdefault(case_label(row), []).append(row)
    return {
        name: {
            "repeats": len(some),
            "distance": sum(row["distance"] for row in some),
            "collisions": sum(row["collisions"] for row in some),
            "per_100_m": asdict(
                metrics.poisson_rate(sum(row["collisions"] for row in some), sum(row["distance"] for row in some) / 100)
            ),
            "each": np.array([row["per_100_m"]["value"] for row in some]).tolist(),
        }
        for name, some in cases.items()
    }
