"""How often do a white wall and a corner stop the robot, and what helps? (sec. 5.4)

An LGMD responds to expanding edges. A plain wall has no edges but its rims, so training cannot help; the study raises
the wall's contrast step by step. A corner is visible, but both detectors respond alike, so the policy must choose the
side. Eq. 22 has no criterion for the choice. The teacher of this package continues to turn in the direction in which it
began, and a network with memory can learn that.

Writes failure_modes.json, a row for each trial, contrast and policy, and the walks.

Source: Cizek & Faigl, sec. 5.4.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.control import policies
from lgmdjax.evaluation import run_trial, trials
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.studies import supervision
from lgmdjax.studies.settings import FailureModesSettings

CONTRASTS = (0.0, 0.03, 0.06, 0.12, 0.25, 0.5)
WAVELENGTH = 0.45  # m, of the wall's texture: the mean of textured walls
WHITE, CORNER = "white", "corner"
EQ_22 = "eq. 22"


class Case(NamedTuple):
    """A trial, the policy that walks in it, and what is changed."""

    trial: str
    policy: policies.Policy
    contrast: float | None = None  # of all walls; None leaves them as they are
    rule: str | None = None  # of `supervision.RULES`, for the policy `teacher`


CASES = (
    *(Case(WHITE, policies.LEARNED, contrast) for contrast in CONTRASTS),
    *(Case(WHITE, policy, 0.0) for policy in (policies.TEACHER, policies.BLIND)),
    *(Case(CORNER, policy) for policy in (policies.LEARNED, policies.TEACHER, policies.BLIND, policies.DIRECT)),
    Case(CORNER, policies.TEACHER, rule=EQ_22),
)


def run(folder: Path, inputs: Mapping[str, Path], settings: FailureModesSettings, seed: int) -> None:
    """Record every case, and count the robots that touched nothing."""
    robot = assembly.with_resolution(assembly.load_robot(inputs["fit-gait"], inputs["train"]), settings.benchmark.eyes)
    storage.write_json(folder / "failure_modes.json", [_measure(folder, robot, case, settings, seed) for case in CASES])


def _measure(
    folder: Path, robot: closed_loop.Params, case: Case, settings: FailureModesSettings, seed: int
) -> JsonObject:
    """Return the row of a case."""
    trial, policy, contrast, rule = case
    robot, name = (supervision.with_rule(robot, rule) if rule else robot), rule or policy.name
    rooms = trials.sample_rooms(trial, settings.benchmark.robots, seed)
    if contrast is not None:
        rooms = with_wall_contrast(rooms, contrast)
    label = f"{trial}{'' if contrast is None else f' {contrast:g}'}"
    facts = {
        "benchmark": asdict(settings.benchmark), "contrast": contrast, "robot": assembly.fingerprint(robot)
    }  # fmt: skip
    record = recording.record_rollouts(
        folder / f"{label}-{name}".replace(" ", "-"), robot, rooms, settings.benchmark.seconds, policy,
        seed=seed, parameters=facts, label=label,
    )  # fmt: skip
    row = {"trial": trial, "contrast": contrast, "policy": name}
    return row | run_trial.summarise(trials.TRIALS[trial], record)


def with_wall_contrast(rooms: closed_loop.Room, contrast: float) -> closed_loop.Room:
    """Give all walls a texture of the given contrast."""
    walls = rooms.arena.wall_texture.at[..., 1].set(contrast).at[..., 3].set(WAVELENGTH)
    return replace(rooms, arena=replace(rooms.arena, wall_texture=walls))


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot the share of robots that touched nothing, against contrast and by policy; rows as in failure_modes.json."""
    figure = Figure(figsize=(style.WIDTH, 2.6), layout="constrained")
    white, corner = figure.subplots(1, 2, sharey=True)
    learned = [row for row in rows if row["trial"] == WHITE and row["policy"] == policies.LEARNED.name]
    _plot_shares(white, learned)
    white.set_xticks(range(len(learned)), [f"{row['contrast']:g}" for row in learned])
    white.set(title="a wall ahead", xlabel="contrast of the wall", ylabel="touched nothing [%]", ylim=(-4, 104))
    for row in (row for row in rows if row["trial"] == WHITE and row["policy"] != policies.LEARNED.name):
        options = {"color": style.POLICY_COLOURS[row["policy"]], "linewidth": 1}
        white.axhline(100 * row["avoided"]["value"], label=row["policy"], **options)
    white.legend(loc="center right")
    cornered = [row for row in rows if row["trial"] == CORNER]
    _plot_shares(corner, cornered)
    corner.set_xticks(range(len(cornered)), [row["policy"] for row in cornered])
    corner.set(title="a corner ahead")
    return figure


def _plot_shares(axes: Axes, rows: Sequence[JsonObject]) -> None:
    """Plot the share of each row with its interval, side by side."""
    for x, row in enumerate(rows):
        share, colour = row["avoided"], style.POLICY_COLOURS.get(row["policy"], style.DARK)
        axes.vlines(x, 100 * share["low"], 100 * share["high"], color=colour, alpha=0.5, linewidth=1.6)
        axes.plot([x], [100 * share["value"]], "o", color=colour, markersize=4.5, clip_on=False, zorder=3)
