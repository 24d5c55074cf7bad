"""`lgmdjax trial`: one of the paper's experiments with one driver, walked, judged, drawn and filmed.

Leaves, in a folder of the trial's, the driver's and the seed's name: `outcome.json`, `chunk-*.parquet` (the walks of a
crowd each, see `lgmdjax.simulation.episodes`), `paths.png` (from above) and `walk.mp4` (the liveliest stretch of one
robot). Interrupted, the same command carries on with the crowd that it was at.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lgmdjax.control import policies
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, trials
from lgmdjax.locomotion import cpg
from lgmdjax.reporting import walk_video
from lgmdjax.reporting.figures import style, trajectories
from lgmdjax.runtime import storage
from lgmdjax.runtime.run_folders import Stage, execute, open_run
from lgmdjax.sensors import camera
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, recording
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record, Room
from lgmdjax.world import arena

FILM = 15.0  # s
ROOMS_DRAWN = 6
DRIVERS = {driver.name: driver for driver in policies.ALL}


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Who walks what, how often, and for how long at most."""

    trial: str
    driver: str
    seeds: int
    seconds: float
    robot: str  # digest of all its numbers


def attempt(
    name: str, driver: str, *, seed: int, seeds: int | None, width: int | None, run: Path | None, out: Path
) -> Path:
    """Walk a trial and give the folder of its files.

    Args:
        name: of the trial. driver: who walks. seed: of rooms, textures and starts.
        seeds: how often; as often as the trial says if None.
        width: of the pictures, whose cells go on looking at as many degrees [px]; as it learned with if None.
        run: the run folder whose robot walks; the one that comes with the package if None.
        out: the folder to write a folder into.
    """
    if seeds is not None and seeds < 1:
        raise InputError(f"expected one or more --seeds, got {seeds}; leave it out for as many as the paper has")
    robot = assembly.trained(run / "fit-gait", run / "train") if run else assembly.trained()
    robot = robot if width is None else assembly.with_eyes(robot, _eyes(robot, width))
    trial = trials.TRIALS[name]
    asked = tried(robot, name, driver, seeds or trial.seeds, trial.seconds)
    place = open_run(out, f"{name}-{driver}-{seed}", "trial", seed, {"trial": asked})
    return execute(place, (Stage(name="trial", work=partial(_work, robot)),), "trial")


def _eyes(robot: closed_loop.Params, width: int) -> CameraSettings:
    """Find eyes with pictures of another width and cells of the same size in degrees."""
    eyes, pooling = robot.camera, robot.controller.lgmd.pooling
    if width < 1 or (pooling * width) % eyes.width or (eyes.height * width) % eyes.width:
        raise InputError(
            f"expected a --width whose cells are whole pixels as the {pooling} of {eyes.width} are, got {width}; "
            f"try {2 * eyes.width}"
        )
    height, cell = eyes.height * width // eyes.width, pooling * width // eyes.width
    return CameraSettings(width=width, height=height, overlap=eyes.overlap, pooling=cell)


def tried(robot: closed_loop.Params, trial: str, driver: str, seeds: int, seconds: float) -> Attempt:
    """Say what is tried with a robot."""
    return Attempt(trial=trial, driver=driver, seeds=seeds, seconds=seconds, robot=assembly.digest(robot))


def walk(folder: Path, tried: Attempt, robot: closed_loop.Params, seed: int) -> tuple[Room, Record]:
    """Walk a trial crowd by crowd, after those that are in the folder already; give its rooms and all walks."""
    rooms = trials.draw_rooms(tried.trial, tried.seeds, seed)
    record = recording.walked(
        folder, robot, rooms, tried.seconds, DRIVERS[tried.driver], seed=seed, facts=asdict(tried), label=tried.trial
    )
    return rooms, record


def summary(trial: trials.Trial, record: Record) -> dict[str, Any]:
    """Sum up a trial: the share that stayed untouched, or collisions per 100 m where robots walk on after a touch."""
    if not trial.ends:
        return asdict(metrics.score(record, cpg.CYCLE_TIME))
    outcome = trials.judge(trial, record)
    return {
        "robots": len(outcome.touched),
        "untouched": int((~outcome.touched).sum()),
        "avoided": asdict(outcome.avoided()),
        "passed": int(outcome.passed.sum()),
        "retreated": int(outcome.retreated.sum()),
        "clearance": outcome.clearance.tolist(),
        "seconds": (outcome.frames / FRAME_RATE).tolist(),
    }


def draw(trial: trials.Trial, rooms: Room, record: Record) -> style.Figure:
    """Draw what was walked, from above, every room the way round that the paper has it."""
    arenas = [jax.tree.map(lambda leaf, robot=robot: leaf[robot], rooms.arena) for robot in range(len(record.time))]
    hands = np.asarray(rooms.arena.handedness)
    paths = np.asarray(record.position)[..., :2] * np.stack([np.ones_like(hands), hands], axis=1)[:, None]
    upright = [arena.mirror(room) if hand < 0 else room for room, hand in zip(arenas, hands, strict=True)]
    if not trial.ends:
        drawn = upright[:ROOMS_DRAWN]
        series = paths, np.asarray(record.setbacks), np.asarray(record.contact)
        walks = [trajectories.Walks(*(x[[k]] for x in series)) for k in range(len(drawn))]
        return trajectories.rooms(drawn, walks)
    outcome = trials.judge(trial, record)
    ways = [path[:end] for path, end in zip(paths, outcome.frames, strict=True)]
    across = np.resize(np.repeat(trial.across, 2), len(ways)) if trial.across else None
    return trajectories.passages(upright, ways, outcome.touched, outcome.clearance, across)


def _work(robot: closed_loop.Params, folder: Path, inputs: Mapping[str, Path], tried: Attempt, seed: int) -> None:
    trial = trials.TRIALS[tried.trial]
    rooms, record = walk(folder, tried, robot, seed)
    storage.write_json(folder / "outcome.json", summary(trial, record))
    (folder / "paths.png").write_bytes(style.to_png(draw(trial, rooms, record)))
    _film(folder / "walk.mp4", robot.camera, rooms, record)


def _film(target: Path, eyes: camera.Params, rooms: Room, record: Record) -> None:
    """Film the robot that turned most."""
    turning = np.abs(np.diff(record.velocity, axis=-1)).mean(axis=(1, 2))
    liveliest = int(np.argmax(turning * np.asarray(record.ok)[:, -1]))
    shown = walk_video.Walk(*(np.asarray(getattr(record, name))[liveliest] for name in walk_video.Walk._fields))
    room = jax.tree.map(lambda leaf: leaf[liveliest], rooms.arena)
    walk_video.write(target, shown, room, replace(eyes, overlap=1.0), FILM, eyes.overlap)
