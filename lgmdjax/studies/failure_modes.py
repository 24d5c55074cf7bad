"""Where the paper's robot fails, and what helps: a wall without contrast, and a corner (sec. 5.4).

A looming detector sees edges that spread. A plain wall has none but its rims, so nothing learned can help; here it is
given contrast step by step. A corner is seen, by both eyes alike: which way to turn is then up to the driver. Eq. 22
has nothing to choose by; the teacher of this package goes on turning the way it has begun to, and a network with a
memory can learn that.

Writes failures.json, a row a place, a contrast and a driver, and the walks.

Source: Cizek & Faigl, sec. 5.4.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lgmdjax.control import policies
from lgmdjax.evaluation import run_trial, trials
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.studies import supervision
from lgmdjax.studies.settings import FailureModesSettings

CONTRASTS = (0.0, 0.03, 0.06, 0.12, 0.25, 0.5)
WAVELENGTH = 0.45  # m, of the wall's texture: the middle of what textured walls have
WHITE, CORNER = "white", "corner"
EQ_22 = "eq. 22"


def work(folder: Path, inputs: Mapping[str, Path], settings: FailureModesSettings, seed: int) -> None:
    """Walk into both, and count who got away."""
    robot = assembly.with_eyes(assembly.trained(inputs["fit-gait"], inputs["train"]), settings.bench.eyes)

    def row(place: str, driver: policies.Driver, contrast: float | None = None, rule: str | None = None):
        walker, name = (supervision.under(robot, rule) if rule else robot), rule or driver.name
        rooms = trials.draw_rooms(place, settings.bench.robots, seed)
        if contrast is not None:
            rooms = papered(rooms, contrast)
        label = f"{place}{'' if contrast is None else f' {contrast:g}'}"
        facts = {"bench": asdict(settings.bench), "contrast": contrast, "robot": assembly.digest(walker)}
        record = recording.walked(
            folder / f"{label}-{name}".replace(" ", "-"), walker, rooms, settings.bench.seconds, driver,
            seed=seed, facts=facts, label=label,
        )  # fmt: skip
        return {"place": place, "contrast": contrast, "driver": name} | run_trial.summary(trials.TRIALS[place], record)

    rows = [row(WHITE, policies.LEARNED, contrast) for contrast in CONTRASTS]
    rows += [row(WHITE, driver, 0.0) for driver in (policies.TEACHER, policies.BLIND)]
    rows += [row(CORNER, driver) for driver in (policies.LEARNED, policies.TEACHER, policies.BLIND, policies.DIRECT)]
    rows.append(row(CORNER, policies.TEACHER, rule=EQ_22))
    storage.write_json(folder / "failure_modes.json", rows)


def papered(rooms: closed_loop.Room, contrast: float) -> closed_loop.Room:
    """Give all walls a texture of some contrast."""
    walls = rooms.arena.wall_texture.at[..., 1].set(contrast).at[..., 3].set(WAVELENGTH)
    return replace(rooms, arena=replace(rooms.arena, wall_texture=walls))


@style.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the share that got away, against contrast and by driver, with intervals; rows as in failures.json."""
    figure = Figure(figsize=(style.WIDTH, 2.6), layout="constrained")
    white, corner = figure.subplots(1, 2, sharey=True)
    learned = [row for row in rows if row["place"] == WHITE and row["driver"] == policies.LEARNED.name]
    _points(white, np.arange(len(learned)), learned)
    white.set_xticks(range(len(learned)), [f"{row['contrast']:g}" for row in learned])
    white.set(title="a wall ahead", xlabel="contrast of the wall", ylabel="got away [%]", ylim=(-4, 104))
    for row in (row for row in rows if row["place"] == WHITE and row["driver"] != policies.LEARNED.name):
        white.axhline(
            100 * row["avoided"]["value"], color=style.DRIVERS[row["driver"]], linewidth=1, label=row["driver"]
        )
    white.legend(loc="center right")
    cornered = [row for row in rows if row["place"] == CORNER]
    _points(corner, np.arange(len(cornered)), cornered)
    corner.set_xticks(range(len(cornered)), [row["driver"] for row in cornered])
    corner.set(title="a corner ahead")
    return figure


def _points(axes: Any, x: np.ndarray, rows: Sequence[Mapping[str, Any]]) -> None:
    for place, row in zip(x, rows, strict=True):
        share, colour = row["avoided"], style.DRIVERS.get(row["driver"], style.INK)
        axes.vlines(place, 100 * share["low"], 100 * share["high"], color=colour, alpha=0.5, linewidth=1.6)
        axes.plot([place], [100 * share["value"]], "o", color=colour, markersize=4.5, clip_on=False, zorder=3)
