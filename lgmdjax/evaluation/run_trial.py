"""Run one trial with one policy: simulate, evaluate, plot and make a video (`lgmdjax trial`).

The results are in a folder with the names of the trial, the policy and the seed:

| file            | content                                                              |
| --------------- | -------------------------------------------------------------------- |
| outcome.json    | the outcome (`summarise`)                                            |
| chunk-*.parquet | the recorded walks of one batch each (`lgmdjax.simulation.episodes`) |
| paths.png       | paths seen from above                                                |
| walk.mp4        | video of the most eventful walk                                      |
| walk.html       | the same in 3D, if the extra `viewer` is installed                   |

After an interruption the same call continues with the next batch.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from lgmdjax.control import policies
from lgmdjax.control.names import PolicyName
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, trials
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.reporting import walk_page, walk_video
from lgmdjax.reporting.figures import style, trajectories
from lgmdjax.runtime import storage
from lgmdjax.runtime.run_folders import Stage, execute, open_run
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record, Room
from lgmdjax.world import arena

VIDEO_SECONDS = 15.0  # s
MAX_PANELS = 6  # rooms in the plot of a trial in which robots walk on after a contact
POLICY_BY_NAME = {policy.name: policy for policy in policies.POLICIES}


@dataclass(frozen=True, kw_only=True)
class TrialRun:
    """A trial with one policy of one robot."""

    trial: TrialName
    policy: PolicyName
    seeds: int  # number of repetitions
    seconds: float  # longest duration of a walk
    robot: str  # fingerprint of the robot's parameters

    def parameters(self) -> JsonObject:
        """Return the values that identify the recorded walks, with their names on disk."""
        return {
            "trial": self.trial,
            "driver": self.policy,
            "seeds": self.seeds,
            "seconds": self.seconds,
            "robot": self.robot,
        }


def run_trial(
    trial: TrialName,
    policy: PolicyName = "learned",
    *,
    seed: int = 0,
    seeds: int | None = None,
    width: int | None = None,
    run: Path | None = None,
    out: Path = Path("runs/trials"),
) -> Path:
    """Run a trial and return the folder with its results; finished trials are not repeated.

    Args:
        trial: name of the trial (`trials.TRIALS`).
        policy: name of the policy.
        seed: of rooms, textures and start poses.
        seeds: number of repetitions; by default as many as the trial says.
        width: of the eyes' pictures [px], by default as in training; the LGMD's cells keep their angular size.
        run: run folder of the robot; by default the pretrained robot.
        out: folder in which the folder with the results is created.

    Raises InputError for an unknown name, an impossible number or width, and a folder with results of other settings.

    ```python
    folder = lgmdjax.run_trial("indoor", "learned", seeds=2)
    print((folder / "outcome.json").read_text())
    ```
    """
    _check(trial, policy, seeds)
    robot, definition = equip(_load_robot(run, width), trial), trials.TRIALS[trial]
    trial_run = describe_run(robot, trial, policy, seeds or definition.seeds, definition.seconds)

    def work(folder: Path, inputs: Mapping[str, Path], settings: JsonObject, seed: int) -> None:
        _write_results(folder, trial_run, robot, seed)

    settings = {"trial": trial_run.parameters()}
    name, remedy = f"{trial}-{policy}-{seed}", "choose another --out or --seed"
    place = open_run(out, name, "trial", seed, settings, remedy=remedy)
    return execute(place, (Stage(name="trial", run=work),), "trial")


def _load_robot(run: Path | None, width: int | None) -> closed_loop.Params:
    robot = assembly.load_robot(run / "fit-gait", run / "train") if run else assembly.load_robot()
    return robot if width is None else assembly.with_resolution(robot, assembly.scale_resolution(robot, width))


def _check(trial: str, policy: str, seeds: int | None) -> None:
    for kind, name, known in (("trial", trial, trials.TRIALS), ("policy", policy, POLICY_BY_NAME)):
        if name not in known:
            raise InputError(f"expected the name of a {kind}, got {name!r}; choose one of {', '.join(known)}")
    if seeds is not None and seeds < 1:
        raise InputError(f"expected one or more --seeds, got {seeds}; leave it out for as many as the paper has")


def equip(robot: closed_loop.Params, trial: str) -> closed_loop.Params:
    """Return the robot with what a trial gives it: a compass if the robot keeps a heading."""
    return assembly.with_compass(robot) if trials.TRIALS[trial].keeps_heading else robot


def describe_run(
    robot: closed_loop.Params, trial: TrialName, policy: PolicyName, seeds: int, seconds: float
) -> TrialRun:
    """Describe a trial with one policy of a robot; robots with different parameters have different descriptions."""
    return TrialRun(trial=trial, policy=policy, seeds=seeds, seconds=seconds, robot=assembly.fingerprint(robot))


def record_trial(folder: Path, trial_run: TrialRun, robot: closed_loop.Params, seed: int) -> tuple[Room, Record]:
    """Simulate a trial batch by batch and record the walks; return rooms and walks.

    Batches that are already in the folder are not simulated again.
    """
    rooms = trials.sample_rooms(trial_run.trial, trial_run.seeds, seed)
    record = recording.record_rollouts(
        folder,
        robot,
        rooms,
        trial_run.seconds,
        POLICY_BY_NAME[trial_run.policy],
        seed=seed,
        parameters=trial_run.parameters(),
        label=trial_run.trial,
    )
    return rooms, record


def summarise(trial: trials.Trial, record: Record) -> JsonObject:
    """Summarise a trial: outcomes of all robots, or the score if robots walk on after a contact."""
    if not trial.ends_at_contact:
        return asdict(metrics.score(record))
    outcome = trials.find_outcome(trial, record)
    return {
        "robots": len(outcome.touched),
        "untouched": int((~outcome.touched).sum()),
        "avoided": asdict(outcome.avoided()),
        "passed": int(outcome.passed.sum()),
        "passing": asdict(outcome.passing()),
        "retreated": int(outcome.retreated.sum()),
        "made_good": asdict(metrics.bootstrap_mean(outcome.made_good)),
        "progress": asdict(metrics.progress(trials.truncate_at_end(record, outcome))),
        "clearance": outcome.clearance.tolist(),
        "seconds": (outcome.frames / FRAME_RATE).tolist(),
        **(_summarise_way(outcome) if trial.keeps_heading else {}),
    }


def _summarise_way(outcome: trials.Outcome) -> JsonObject:
    """Summarise the ways of robots with a compass: SPL, distance, and touches per 100 m."""
    distance = float(outcome.walked.sum())
    touches = metrics.poisson_rate(int(outcome.touched.sum()), max(distance, 1e-9) / 100)
    return {
        "spl": asdict(metrics.bootstrap_mean(outcome.spl)),
        "distance": distance,
        "touches_per_100_m": asdict(touches),
    }


def plot_trial(trial: trials.Trial, rooms: Room, record: Record) -> Figure:
    """Plot the paths of a trial seen from above; mirrored rooms are mirrored back, to the paper's orientation."""
    arenas = [jax.tree.map(lambda leaf, robot=robot: leaf[robot], rooms.arena) for robot in range(len(record.time))]
    handedness = np.asarray(rooms.arena.handedness)
    unmirror = np.stack([np.ones_like(handedness), handedness], axis=1)[:, None]
    positions = np.asarray(record.position)[..., :2] * unmirror
    unmirrored = [arena.mirror(room) if hand < 0 else room for room, hand in zip(arenas, handedness, strict=True)]
    outcome = trials.find_outcome(trial, record)
    if not trial.ends_at_contact or trial.random_rooms:
        ends = outcome.frames if trial.ends_at_contact else np.full(len(positions), positions.shape[1])
        shown = unmirrored[:MAX_PANELS]
        series = positions, np.asarray(record.resets), np.asarray(record.contact)
        paths = [trajectories.Paths(*(leaf[[k], : ends[k]] for leaf in series)) for k in range(len(shown))]
        return trajectories.plot_rooms(shown, paths)
    until_end = [path[:end] for path, end in zip(positions, outcome.frames, strict=True)]
    offsets = np.resize(np.repeat(trial.lateral_offsets, 2), len(until_end)) if trial.lateral_offsets else None
    return trajectories.plot_passages(unmirrored, until_end, outcome.touched, outcome.clearance, offsets)


def _write_results(folder: Path, trial_run: TrialRun, robot: closed_loop.Params, seed: int) -> None:
    trial = trials.TRIALS[trial_run.trial]
    rooms, record = record_trial(folder, trial_run, robot, seed)
    storage.write_json(folder / "outcome.json", summarise(trial, record))
    (folder / "paths.png").write_bytes(style.to_png(plot_trial(trial, rooms, record)))
    walk_video.write_video(folder / "walk.mp4", record, rooms, robot, seconds=VIDEO_SECONDS)
    if walk_page.HAS_VISER:
        walk_page.walk_page(record, rooms, seconds=VIDEO_SECONDS, body=robot.body).write(folder / "walk.html")
