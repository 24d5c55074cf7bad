"""The paper's experiments as data: where robots start, how long they walk, and when they have got through.

| trial    | paper             | what stands in the way                                      |
| -------- | ----------------- | ----------------------------------------------------------- |
| testing  | fig. 13           | sixteen obstacles, from (0, 2.5)                             |
| unseen   | -                 | random rooms, one a robot                                    |
| tube     | fig. 14           | a tube 1.25 m ahead, 0 to 0.42 m to either side              |
| indoor   | figs. 15a, 16a    | a box ahead, one to the right, a table to the left           |
| outdoor  | fig. 15b          | trees and bushes on grass, a facade behind                   |
| dynamic  | figs. 15c, 16b, c | boxes put in the way from the left, then from the right      |
| white    | sec. 5.4          | a wall without contrast ahead                                |
| corner   | sec. 5.4          | a corner of two walls ahead                                  |

In `testing` and `unseen` a robot that touches something is set back and walks on: collisions are counted per 100 m
(`lgmdjax.evaluation.metrics`). The others ask whether it stayed untouched, up to the frame in which it had passed what
stood in its way, or had walked for long enough; a robot that turns back walks about until then.

A seed draws textures, by a key of its own that no training room has, and where exactly the robot is put down: within
a centimetre, and two degrees. With half the seeds the room is mirrored.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgmdjax.evaluation.metrics import Estimate, wilson, yaws
from lgmdjax.simulation import room_batches
from lgmdjax.simulation.closed_loop import Record, Room
from lgmdjax.world import arena, scenes

LATERALS = tuple(round(0.03 * k, 2) for k in range(15))  # d_y of fig. 14 [m]
TUBE = 1.25  # d_x of fig. 14 [m]
ROOMS = 2**22  # far from the numbers of a run's episodes: these rooms are met nowhere else
LIBERTY = (0.01, 0.01, np.deg2rad(2.0))  # by how much a start may be off: x, y [m], yaw [rad]
TURNED_BACK = 0.5 * np.pi  # rad from the first heading


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One experiment; `rooms(key, seeds)` sets up its robots."""

    name: str
    title: str
    source: str  # figure or section of the paper
    paper: str  # what it reports
    shows: str
    rooms: Callable[[Array, int], Room]
    seeds: int  # as many as the paper has trials, or more
    seconds: float  # of walking, at most
    beyond: float = np.inf  # m, x of the place where the way is free again
    across: tuple[float, ...] = ()  # m, distances beside the robot's way, each once to either side, seed after seed
    ends: bool = True  # with the first touch; otherwise the robot is set back and walks on


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of every robot of a trial, until its end."""

    touched: np.ndarray  # something, or was lost
    frames: np.ndarray  # until the end
    clearance: np.ndarray  # m, the least
    passed: np.ndarray  # untouched, and beyond what stood in its way
    retreated: np.ndarray  # untouched, turned back, and not passed

    def avoided(self) -> Estimate:
        """Estimate the share of robots that stayed untouched, with Wilson's interval."""
        return wilson(int((~self.touched).sum()), len(self.touched))


def judge(trial: Trial, record: Record) -> Outcome:
    """Find each robot's end of the trial, and what had happened by then; axes (robot, frame)."""
    x, heading = np.asarray(record.position)[..., 0], np.unwrap(yaws(np.asarray(record.quaternion)), axis=1)
    turned = np.abs(heading - heading[:, :1]) > TURNED_BACK
    bad = np.asarray(record.contact) | ~np.asarray(record.ok)
    beyond = x > trial.beyond
    over = bad | beyond
    over[:, -1] = True
    end = over.argmax(axis=1)
    at_end = (np.arange(len(end)), end)
    until = np.arange(x.shape[1]) <= end[:, None]
    touched, passed = bad[at_end], (beyond & ~bad)[at_end]
    return Outcome(
        touched=touched,
        frames=end + 1,
        clearance=np.where(until, record.clearance, np.inf).min(axis=1),
        passed=passed,
        retreated=(turned & until).any(axis=1) & ~touched & ~passed,
    )


def _alike(scene: Callable[[Array], arena.Arena]) -> Callable[[Array, int], Room]:
    """Set up a scene once a seed, every second time mirrored."""

    def rooms(key: Array, seeds: int) -> Room:
        return room_batches.stack([_room(scene, jax.random.fold_in(key, n), bool(n % 2)) for n in range(seeds)])

    return rooms


def _tubes(key: Array, seeds: int) -> Room:
    """Set up both sides of every lateral distance, `seeds` times."""
    rooms = [
        _room(lambda key, d_y=d_y: scenes.tube_scene(d_y, key), jax.random.fold_in(key, n), mirrored)
        for n in range(seeds)
        for d_y in LATERALS
        for mirrored in (False, True)
    ]
    return room_batches.stack(rooms)


def _room(scene: Callable[[Array], arena.Arena], key: Array, mirrored: bool) -> Room:
    """Build a scene for one robot, put down not quite at its start."""
    texture_key, start_key, luck = jax.random.split(key, 3)
    built = scene(texture_key)
    # In float32, so that a key means the same start at any precision.
    off = jax.random.uniform(start_key, (3,), jnp.float32, -1.0, 1.0).astype(float)
    built = replace(built, start=built.start + off * jnp.asarray(LIBERTY))
    built = arena.mirror(built) if mirrored else built
    # As many starts as other rooms have, so that one program serves all.
    return Room(arena=built, starts=jnp.tile(built.start, (room_batches.STARTS, 1)), key=luck)


def _white(key: Array) -> arena.Arena:
    white = jnp.asarray([235.0, 0.0, 0.0, 1.0], dtype=float)
    room = scenes.textured(arena.empty_room((4.0, 4.0)), key)
    return replace(room, wall_texture=jnp.broadcast_to(white, (4, 4)))


def _corner(key: Array) -> arena.Arena:
    return scenes.textured(arena.empty_room((4.0, 4.0), start=(0.0, 0.0, 0.25 * jnp.pi)), key)


TRIALS = {
    trial.name: trial
    for trial in (
        Trial(
            name="testing",
            title="the testing room",
            source="fig. 13",
            paper="235.3 m in five trials, no collision",
            shows="Sixteen obstacles, from (0, 2.5).",
            rooms=lambda key, seeds: room_batches.copies(key, scenes.testing_room(), seeds),
            seeds=5,
            seconds=1080.0,
            ends=False,
        ),
        Trial(
            name="unseen",
            title="random rooms never seen",
            source="-",
            paper="not done",
            shows="A random room a robot.",
            rooms=room_batches.random_rooms,
            seeds=64,
            seconds=180.0,
            ends=False,
        ),
        Trial(
            name="tube",
            title="a single obstacle",
            source="fig. 14",
            paper="15 of 15",
            shows="A tube 1.25 m ahead, up to 0.42 m to a side, before a white wall; below, how near the robot came.",
            rooms=_tubes,
            seeds=8,
            seconds=40.0,
            beyond=TUBE + 0.4,
            across=LATERALS,
        ),
        Trial(
            name="indoor",
            title="indoors",
            source="figs. 15a and 16a",
            paper="12 of 12",
            shows="A box 1.2 m ahead, another to the right, a table with thin legs to the left (its top dashed).",
            rooms=_alike(scenes.indoor_scene),
            seeds=12,
            seconds=60.0,
            beyond=2.2,
        ),
        Trial(
            name="outdoor",
            title="outdoors",
            source="fig. 15b",
            paper="10 of 10",
            shows="Trees with crowns (dashed), bushes and hedges on grass, before a facade.",
            rooms=_alike(scenes.outdoor_scene),
            seeds=10,
            seconds=60.0,
            beyond=2.8,
        ),
        Trial(
            name="dynamic",
            title="things put in the way",
            source="figs. 15c, 16b and 16c",
            paper="10 of 10, twice by walking backward",
            shows="A box is put in the way from the left, then one from the right (dotted).",
            rooms=_alike(scenes.dynamic_scene),
            seeds=10,
            seconds=60.0,
            beyond=2.2,
        ),
        Trial(
            name="white",
            title="a white wall",
            source="sec. 5.4",
            paper="fails",
            shows="Walls without contrast make no edges: a detector of edges cannot see them but for their rims.",
            rooms=_alike(_white),
            seeds=12,
            seconds=60.0,
        ),
        Trial(
            name="corner",
            title="a corner",
            source="sec. 5.4",
            paper="fails",
            shows="Walking into the corner of two walls, the robot has as much before the one eye as before the other.",
            rooms=_alike(_corner),
            seeds=12,
            seconds=90.0,
        ),
    )
}


def draw_rooms(name: str, seeds: int, seed: int) -> Room:
    """Set up the rooms of a trial, a robot each: `seeds` times what the trial has."""
    return TRIALS[name].rooms(jax.random.fold_in(jax.random.key(seed), ROOMS), seeds)
