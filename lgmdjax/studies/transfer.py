"""Does the trained robot avoid obstacles in a world in which nothing was trained, and which fault stops it?

The robot is unchanged. In the other world C MuJoCo computes hard contacts of true shapes, OpenGL draws the pictures,
surfaces are photographs or 1/f noise under a lamp that casts shadows, and some obstacles are spheres, chairs or rocks
(`lgmdjax.transfer`). Rooms, starts and measures are those of our own world.

| world  | what it is                                                                                |
| ------ | ----------------------------------------------------------------------------------------- |
| own    | MJX, ray-cast pictures, textures of plane waves                                           |
| prisms | the other engine, photographs and lamps; all obstacles keep their shape                   |
| other  | the same with obstacles of other shapes                                                   |
| faults | the other world, and a robot with one fault (`lgmdjax.transfer.faults`), or all `together` |

The policies teacher and blind walk in own, other, and with all faults together; learned walks in every world. Writes
transfer.json, a row for each world, trial and policy: its metrics, or the outcome in a scene. The walks of each row are
stored in Parquet, so that an interrupted study resumes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lgmdjax.control import policies
from lgmdjax.control.names import PolicyName
from lgmdjax.evaluation import run_trial, trials
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, episodes, recording
from lgmdjax.studies.settings import TransferSettings, TransferSize
from lgmdjax.transfer import walk
from lgmdjax.transfer.names import FaultName
from lgmdjax.world.mujoco_world import Style

OWN, PRISMS, OTHER, TOGETHER = "own", "prisms", "other", "together"
UNSEEN = "unseen"
COMPARED: tuple[PolicyName, ...] = ("learned", "teacher", "blind")
BATCH = 8  # robots that are simulated at once and written to one file


class Case(NamedTuple):
    """A world with its faults, a trial and a policy."""

    world: str
    trial: str
    policy: PolicyName
    style: Style | None  # None: our own world
    faults: tuple[FaultName, ...] = ()


def run(folder: Path, inputs: Mapping[str, Path], settings: TransferSettings, seed: int) -> None:
    """Record the walks of every case, and score them."""
    robot = assembly.load_robot(inputs["fit-gait"], inputs["train"])
    rows = []
    for case in plan(settings):
        record = _record(folder, robot, case, settings.size(), seed)
        summary = run_trial.summarise(trials.TRIALS[case.trial], record)
        rows.append({"world": case.world, "trial": case.trial, "policy": case.policy} | summary)
        storage.write_json(folder / "transfer.json", rows)


def plan(settings: TransferSettings) -> Iterator[Case]:
    """Yield the cases of the study, the most informative ones first."""
    other = Style()
    for trial in (UNSEEN, *settings.scenes):
        for policy in COMPARED:
            yield Case(OWN, trial, policy, None)
            yield Case(OTHER, trial, policy, other)
    yield Case(PRISMS, UNSEEN, "learned", replace(other, shapes=False))
    for policy in COMPARED if settings.faults else ():
        yield Case(TOGETHER, UNSEEN, policy, other, settings.faults)
    for name in settings.faults:
        yield Case(name, UNSEEN, "learned", other, (name,))


def _record(folder: Path, robot: closed_loop.Params, case: Case, size: TransferSize, seed: int) -> closed_loop.Record:
    """Record the walks of a case, or read them if they are on disk."""
    count, seconds = (size.robots, size.seconds) if case.trial == UNSEEN else (size.seeds, size.scene_seconds)
    rooms = trials.sample_rooms(case.trial, count, seed)
    facts = {
        "trial": case.trial, "policy": case.policy, "seconds": seconds, "robots": count, "faults": list(case.faults),
        "style": asdict(case.style) if case.style else None, "robot": assembly.fingerprint(robot),
    }  # fmt: skip
    place, label = folder / f"{case.world}-{case.trial}-{case.policy}", f"{case.world}, {case.trial}, {case.policy}"
    if case.style is None:
        policy = policies.get_policy(case.policy)
        return recording.record_rollouts(place, robot, rooms, seconds, policy, seed=seed, parameters=facts, label=label)
    writer = episodes.Writer(place, facts)
    for first in range(writer.chunks * BATCH, count, BATCH):
        present = list(range(first, min(first + BATCH, count)))
        some = jax.tree.map(lambda leaf, present=present: leaf[np.asarray(present)], rooms)
        world = walk.World(style=case.style, faults=case.faults, seed=seed + first)
        record = walk.walk(robot, some, seconds, case.policy, world, label=f"{label}, {first + 1} to {present[-1] + 1}")
        writer.write(record, episode=writer.chunks, rooms=present, seed=seed)
    return episodes.stack_walks(episodes.read(place))


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot collisions and coverage of every world in the random rooms, with intervals; rows as in transfer.json."""
    unseen = [row for row in rows if row["trial"] == UNSEEN]
    worlds = list(dict.fromkeys(row["world"] for row in unseen))
    worlds.sort(key=lambda world: (OWN, PRISMS, OTHER).index(world) if world in (OWN, PRISMS, OTHER) else 3)
    figure = Figure(figsize=(style.WIDTH, 0.9 + 0.21 * len(worlds)), layout="constrained")
    collisions, coverage = figure.subplots(1, 2, sharey=True)
    for row in unseen:
        shift = {"learned": 0.0, "teacher": -0.25, "blind": 0.25}[row["policy"]]
        y = worlds.index(row["world"]) + shift
        _plot_estimate(collisions, y, row["per_100_m"], row["policy"])
        _plot_estimate(coverage, y, row["progress"]["coverage"], row["policy"])
    collisions.set_yticks(range(len(worlds)), worlds)
    collisions.invert_yaxis()
    collisions.set_xscale("symlog", linthresh=1)
    collisions.set(xlabel="collisions per 100 m", xlim=(-0.05, None))
    coverage.set(xlabel="new cells of 25 cm a minute", xlim=(0, None))
    for policy in COMPARED:
        coverage.plot([], [], "o", color=style.POLICY_COLOURS[policy], markersize=4, label=policy)
    figure.legend(loc="outside upper center", ncols=len(COMPARED))
    return figure


def _plot_estimate(axes: Axes, y: float, estimate: Mapping[str, float], policy: str) -> None:
    colour = style.POLICY_COLOURS[policy]
    axes.hlines(y, estimate["low"], estimate["high"], color=colour, alpha=0.5, linewidth=1.6)
    axes.plot([estimate["value"]], [y], "o", color=colour, markersize=4, clip_on=False, zorder=3)
