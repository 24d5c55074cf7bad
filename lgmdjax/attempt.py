"""`lgmdjax trial`: one of the paper's experiments with one driver, walked, judged, drawn and filmed.

Leaves, in a folder of the trial's, the driver's and the seed's name: `outcome.json`, `chunk-00000.parquet` (the
walks, see `lgmdjax.episodes`), `paths.png` (from above) and `walk.mp4` (the liveliest stretch of one robot).
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lgmdjax import arena, camera, cpg, drivers, episodes, figures, files, film, hexapod, rollout, scores, trials
from lgmdjax.errors import InputError
from lgmdjax.runs import SEEDS
from lgmdjax.simulation import FRAME_RATE, Record, Room
from lgmdjax.stages import crew

ROOMS = 2**22  # far from the numbers of a run's episodes: these rooms are met nowhere else
FILM = 15.0  # s
ROOMS_DRAWN = 6
FILES = ("outcome.json", "chunk-00000.parquet", "paths.png", "walk.mp4")


def attempt(name: str, driver: str, *, seed: int, seeds: int | None, run: Path | None, out: Path) -> list[Path]:
    """Walk a trial and give the files written.

    Args:
        name: of the trial. driver: who walks. seed: of rooms, textures and starts.
        seeds: how often; as often as the trial says if None.
        run: the run folder whose robot walks; the one that comes with the package if None.
        out: the folder to write a folder into; nothing is written until all is there.
    """
    if not 0 <= seed < SEEDS:
        raise InputError(f"expected a seed of 0 to {SEEDS - 1}, got {seed}; choose another --seed")
    if seeds is not None and seeds < 1:
        raise InputError(f"expected one or more --seeds, got {seeds}; leave it out for as many as the paper has")
    trial, wheel = trials.TRIALS[name], {driver.name: driver for driver in drivers.ALL}[driver]
    robot = crew.trained(run)
    rooms = trial.rooms(jax.random.fold_in(jax.random.key(seed), ROOMS), seeds or trial.seeds)
    looks = wheel in (drivers.LEARNED, drivers.DIRECT)
    with files.all_or_nothing(out / f"{name}-{driver}-{seed}") as folder:
        walks = crew.walks(
            crew.seat(robot, wheel), hexapod.build(), rooms, trial.seconds, f"{name}: {driver}", draw=looks
        )
        record = rollout.together(list(walks))
        facts = {"trial": name, "driver": driver, "run": "" if run is None else run.name}
        episodes.Writer(folder, facts).write(record, episode=0, rooms=range(len(record.time)), seed=seed)
        files.write_json(folder / "outcome.json", summary(trial, record))
        (folder / "paths.png").write_bytes(figures.to_png(_draw(trial, rooms, record)))
        _film(folder / "walk.mp4", robot.camera, rooms, record)
    return [out / f"{name}-{driver}-{seed}" / file for file in FILES]


def summary(trial: trials.Trial, record: Record) -> dict[str, Any]:
    """Sum up a trial: the share that got through, or collisions per 100 m where robots walk on after a touch."""
    if not trial.ends:
        return asdict(scores.score(record, cpg.CYCLE_TIME))
    outcome = trials.judge(trial, record)
    return {
        "robots": len(outcome.touched),
        "untouched": int((~outcome.touched).sum()),
        "avoided": asdict(outcome.avoided()),
        "retreated": int(outcome.retreated.sum()),
        "clearance": outcome.clearance.tolist(),
        "seconds": (outcome.frames / FRAME_RATE).tolist(),
    }


def _draw(trial: trials.Trial, rooms: Room, record: Record) -> figures.Figure:
    """Draw what was walked, from above, every room the way round that the paper has it."""
    arenas = [jax.tree.map(lambda leaf, robot=robot: leaf[robot], rooms.arena) for robot in range(len(record.time))]
    hands = np.asarray(rooms.arena.handedness)
    paths = np.asarray(record.position)[..., :2] * np.stack([np.ones_like(hands), hands], axis=1)[:, None]
    upright = [arena.mirror(room) if hand < 0 else room for room, hand in zip(arenas, hands, strict=True)]
    if not trial.ends:
        drawn = upright[:ROOMS_DRAWN]
        walks = [figures.Walks(*(x[[k]] for x in (paths, record.setbacks, record.contact))) for k in range(len(drawn))]
        return figures.rooms(drawn, walks)
    outcome = trials.judge(trial, record)
    return figures.passages(
        upright, [path[:end] for path, end in zip(paths, outcome.frames, strict=True)], outcome.touched
    )


def _film(target: Path, eyes: camera.Params, rooms: Room, record: Record) -> None:
    """Film the robot that turned most."""
    liveliest = int(np.argmax(np.abs(np.diff(record.velocity, axis=-1)).mean(axis=(1, 2)) * record.ok[:, -1]))
    walk = film.Walk(*(np.asarray(getattr(record, name))[liveliest] for name in film.Walk._fields))
    room = jax.tree.map(lambda leaf: leaf[liveliest], rooms.arena)
    film.write(target, walk, room, replace(eyes, overlap=1.0), FILM, eyes.overlap)
