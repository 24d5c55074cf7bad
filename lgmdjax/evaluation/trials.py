"""The paper's trials as data: rooms, start poses, duration, and the condition for having passed the obstacle.

| trial    | paper             | obstacles                                                      |
| -------- | ----------------- | -------------------------------------------------------------- |
| testing  | fig. 13           | sixteen, start at (0, 2.5)                                     |
| unseen   | -                 | held-out random rooms, one per robot                           |
| tube     | fig. 14           | a tube 1.25 m ahead, 0 to 0.42 m to either side                |
| indoor   | figs. 15a, 16a    | a box ahead, one to the right, a table to the left             |
| outdoor  | fig. 15b          | trees and bushes on grass, a facade behind them                |
| dynamic  | figs. 15c, 16b, c | boxes that move in from the left, then from the right          |
| gap      | -                 | two boxes ahead, 0.8 m apart; also 0.7 m and 0.6 m             |
| traverse | -                 | random, in a room of 12 x 6 m, to cross with a compass         |
| pocket   | sec. 6            | three walls of a U around the robot, with a compass            |
| white    | sec. 5.4          | a wall without contrast ahead                                  |
| corner   | sec. 5.4          | a corner of two walls ahead                                    |

In `testing` and `unseen` a robot that touches something is reset and walks on; the result is the number of collisions
per 100 m (`lgmdjax.evaluation.metrics`). In the other trials the result is whether the robot touched anything. They end
when it touches something, when it has passed the obstacle, or when the time is up. A robot that turns back walks on.

Each seed samples textures and an offset of the start pose: up to 1 cm and 2 degrees, before a gap up to 0.2 m and 15
degrees. No training room uses the textures' random key. Every second seed mirrors the room.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from lgmdjax import geometry
from lgmdjax.evaluation import metrics
from lgmdjax.evaluation.metrics import Estimate, wilson_proportion
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.html import NotebookTable
from lgmdjax.locomotion import cpg
from lgmdjax.simulation import finite, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record, Room
from lgmdjax.world import arena, scenes

LATERAL_OFFSETS = tuple(round(0.03 * k, 2) for k in range(15))  # d_y of fig. 14 [m]
TUBE_DISTANCE = 1.25  # d_x of fig. 14 [m]
TRIAL_EPISODE = 2**22  # folded into the seed's key; far from the episode numbers of a run, whose rooms therefore differ
START_JITTER = (0.01, 0.01, np.deg2rad(2.0))  # largest offset of a start pose: x, y [m], yaw [rad]
GAP_JITTER = (0.2, 0.2, np.deg2rad(15.0))  # the same before a gap
POCKET_JITTER = (0.1, 0.1, np.deg2rad(15.0))  # the same in a pocket
TRAVERSE_END = 5.0  # m, x at which a room has been crossed
TURN_BACK_ANGLE = 0.5 * np.pi  # rad from the first heading


@dataclass(frozen=True, kw_only=True)
class Trial(NotebookTable):
    """One trial; `make_rooms(key, seeds)` builds a room for each robot."""

    name: TrialName
    title: str
    source: str  # figure or section of the paper
    paper: str  # the paper's result
    caption: str  # caption of the figure
    make_rooms: Callable[[Array, int], Room]
    seeds: int  # number of repetitions: as many as in the paper, or more
    seconds: float  # longest duration of a walk
    beyond: float = np.inf  # m; a robot with a greater x has passed the obstacle
    lateral_offsets: tuple[float, ...] = ()  # m, of the obstacle; every seed has each of them to the left and the right
    ends_at_contact: bool = True  # otherwise the robot is reset and walks on
    random_rooms: bool = False  # every robot has obstacles of its own
    keeps_heading: bool = False  # the robot has a compass and returns to its first heading (`control.compass`)


@dataclass(frozen=True, kw_only=True)
class Outcome(NotebookTable):
    """Outcome of a trial for each robot."""

    touched: Bool[ndarray, " robots"]  # touched something, or was lost
    frames: Int[ndarray, " robots"]  # until the robot's trial ended
    clearance: Float[ndarray, " robots"]  # m, smallest until the end
    passed: Bool[ndarray, " robots"]  # passed the obstacle without contact
    retreated: Bool[ndarray, " robots"]  # turned back without contact, and did not pass
    made_good: Float[ndarray, " robots"]  # m/s, distance towards what is behind the obstacle over time
    walked: Float[ndarray, " robots"]  # m, length of the path until the end, averaged over a cycle of the gait
    spl: Float[ndarray, " robots"]  # success weighted by path length (Anderson et al. 2018), with the straight line

    def avoided(self) -> Estimate:
        """Estimate the proportion of robots without contact, with Wilson's interval."""
        return wilson_proportion(int((~self.touched).sum()), len(self.touched))

    def passing(self) -> Estimate:
        """Estimate the proportion of robots that passed the obstacle, with Wilson's interval."""
        return wilson_proportion(int(self.passed.sum()), len(self.passed))


def find_outcome(trial: Trial, record: Record) -> Outcome:
    """Find when each robot's trial ended and what happened until then; the record has axes (robot, frame).

    Raises InputError if a frame that is ok is not finite.
    """
    record = finite.require_finite(record, "trial")
    x = np.asarray(record.position)[..., 0]
    heading = np.unwrap(geometry.yaw(np.asarray(record.quaternion, dtype=float)), axis=1)
    has_turned = np.abs(heading - heading[:, :1]) > TURN_BACK_ANGLE
    has_failed = np.asarray(record.contact) | ~np.asarray(record.ok)
    is_beyond = x > trial.beyond
    is_over = has_failed | is_beyond
    is_over[:, -1] = True
    end = is_over.argmax(axis=1)
    at_end = (np.arange(len(end)), end)
    until_end = np.arange(x.shape[1]) <= end[:, None]
    touched, passed = has_failed[at_end], (is_beyond & ~has_failed)[at_end]
    walked = np.where(until_end, metrics.step_lengths(record, cpg.CYCLE_TIME), 0.0).sum(axis=1)
    straight = trial.beyond - x[:, 0]  # no path is shorter
    return Outcome(
        touched=touched,
        frames=end + 1,
        clearance=np.where(until_end, record.clearance, np.inf).min(axis=1),
        passed=passed,
        retreated=(has_turned & until_end).any(axis=1) & ~touched & ~passed,
        made_good=(x[at_end] - x[:, 0]) * FRAME_RATE / (end + 1),
        walked=walked,
        spl=np.divide(straight, np.maximum(walked, straight), out=np.zeros(len(end)), where=passed),
    )


def truncate_at_end(record: Record, outcome: Outcome) -> Record:
    """Return the walks with `ok` false in the frames after the end of each robot's trial."""
    frames = np.arange(np.shape(record.ok)[1])
    return replace(record, ok=np.asarray(record.ok) & (frames < outcome.frames[:, None]))


def _repeat_scene(
    scene: Callable[[Array], arena.Arena], jitter: tuple[float, float, float] = START_JITTER
) -> Callable[[Array, int], Room]:
    """Return a function that builds a scene once per seed, every second time mirrored."""

    def make_rooms(key: Array, seeds: int) -> Room:
        keys = [jax.random.fold_in(key, n) for n in range(seeds)]
        return room_batches.stack_rooms([_room(scene, key, bool(n % 2), jitter) for n, key in enumerate(keys)])

    return make_rooms


@partial(jax.jit, static_argnames="seeds")
def _traverse_rooms(key: Array, seeds: int) -> Room:
    """Build a random room to cross for each seed."""

    def room(key: Array) -> Room:
        built = scenes.traverse_room(key)
        starts = jnp.tile(built.start, (room_batches.START_COUNT, 1))
        return Room(arena=built, starts=starts, key=jax.random.fold_in(key, 1))

    return jax.vmap(lambda n: room(jax.random.fold_in(key, n)))(jnp.arange(seeds))


def _tube_rooms(key: Array, seeds: int) -> Room:
    """Build rooms with a tube at every lateral offset, to the left and to the right, `seeds` times."""
    rooms = [
        _room(lambda key, d_y=d_y: scenes.tube_scene(d_y, key), jax.random.fold_in(key, n), mirrored)
        for n in range(seeds)
        for d_y in LATERAL_OFFSETS
        for mirrored in (False, True)
    ]
    return room_batches.stack_rooms(rooms)


def _room(
    scene: Callable[[Array], arena.Arena],
    key: Array,
    mirrored: bool,
    jitter: tuple[float, float, float] = START_JITTER,
) -> Room:
    """Build a scene for one robot and add a random offset to its start pose."""
    texture_key, start_key, policy_key = jax.random.split(key, 3)
    built = scene(texture_key)
    # In float32, so that a key gives the same start at any precision.
    offset = jax.random.uniform(start_key, (3,), jnp.float32, -1.0, 1.0).astype(float)
    built = replace(built, start=built.start + offset * jnp.asarray(jitter))
    built = arena.mirror(built) if mirrored else built
    # As many starts as other rooms have, so that one compiled program serves all.
    return Room(arena=built, starts=jnp.tile(built.start, (room_batches.START_COUNT, 1)), key=policy_key)


def _white_wall(key: Array) -> arena.Arena:
    white = jnp.asarray([235.0, 0.0, 0.0, 1.0], dtype=float)
    room = scenes.with_random_textures(arena.empty_room((4.0, 4.0)), key)
    return replace(room, wall_texture=jnp.broadcast_to(white, (4, 4)))


def _corner(key: Array) -> arena.Arena:
    return scenes.with_random_textures(arena.empty_room((4.0, 4.0), start=(0.0, 0.0, 0.25 * jnp.pi)), key)


def _gap_trial(name: TrialName, width: float) -> Trial:
    return Trial(
        name=name,
        title=f"a gap of {width:g} m",
        source="-",
        paper="not done",
        caption=f"Two boxes 1.2 m ahead with {width:g} m between them; the robot is 0.4 m wide.",
        make_rooms=_repeat_scene(lambda key: scenes.gap_scene(width, key), GAP_JITTER),
        seeds=40,
        seconds=60.0,
        beyond=2.0,
    )


TRIALS: dict[str, Trial] = {
    trial.name: trial
    for trial in (
        Trial(
            name="testing",
            title="the testing room",
            source="fig. 13",
            paper="235.3 m in five trials, no collision",
            caption="Sixteen obstacles; the robots start at (0, 2.5).",
            make_rooms=lambda key, seeds: room_batches.replicate_room(key, scenes.testing_room(), seeds),
            seeds=5,
            seconds=1080.0,
            ends_at_contact=False,
        ),
        Trial(
            name="unseen",
            title="held-out random rooms",
            source="-",
            paper="not done",
            caption="One random room per robot.",
            make_rooms=room_batches.random_rooms,
            seeds=64,
            seconds=180.0,
            random_rooms=True,
            ends_at_contact=False,
        ),
        Trial(
            name="tube",
            title="a single obstacle",
            source="fig. 14",
            paper="15 of 15",
            caption="A tube 1.25 m ahead, up to 0.42 m to a side, before a white wall; below, the smallest clearance.",
            make_rooms=_tube_rooms,
            seeds=8,
            seconds=90.0,
            beyond=TUBE_DISTANCE + 0.4,
            lateral_offsets=LATERAL_OFFSETS,
        ),
        Trial(
            name="indoor",
            title="indoors",
            source="figs. 15a and 16a",
            paper="12 of 12",
            caption="A box 1.2 m ahead, another to the right, a table with thin legs to the left (its top dashed).",
            make_rooms=_repeat_scene(scenes.indoor_scene),
            seeds=12,
            seconds=90.0,
            beyond=2.2,
        ),
        Trial(
            name="outdoor",
            title="outdoors",
            source="fig. 15b",
            paper="10 of 10",
            caption="Trees with crowns (dashed), bushes and hedges on grass, before a facade.",
            make_rooms=_repeat_scene(scenes.outdoor_scene),
            seeds=10,
            seconds=90.0,
            beyond=2.8,
        ),
        Trial(
            name="dynamic",
            title="moving obstacles",
            source="figs. 15c, 16b and 16c",
            paper="10 of 10, twice by walking backward",
            caption="A box moves into the way from the left, then one from the right (dotted).",
            make_rooms=_repeat_scene(scenes.dynamic_scene),
            seeds=10,
            seconds=90.0,
            beyond=2.2,
        ),
        _gap_trial("gap", 0.8),
        _gap_trial("gap-70cm", 0.7),
        _gap_trial("gap-60cm", 0.6),
        Trial(
            name="traverse",
            title="a room to cross",
            source="-",
            paper="not done",
            caption="Each robot has a compass and crosses a random room of 12 x 6 m, 10 m along its first heading.",
            make_rooms=_traverse_rooms,
            seeds=40,
            seconds=300.0,
            beyond=TRAVERSE_END,
            random_rooms=True,
            keeps_heading=True,
        ),
        Trial(
            name="pocket",
            title="a pocket",
            source="sec. 6",
            paper="future work",
            caption="Each robot starts in a U of three walls, facing its closed end; its compass points beyond it.",
            make_rooms=_repeat_scene(scenes.pocket_scene, POCKET_JITTER),
            seeds=10,
            seconds=240.0,
            beyond=1.5,
            keeps_heading=True,
        ),
        Trial(
            name="white",
            title="a white wall",
            source="sec. 5.4",
            paper="fails",
            caption="A wall without contrast has no edges but its rims, so a detector of edges can't see it.",
            make_rooms=_repeat_scene(_white_wall),
            seeds=12,
            seconds=60.0,
        ),
        Trial(
            name="corner",
            title="a corner",
            source="sec. 5.4",
            paper="fails",
            caption="The robot walks into the corner of two walls, and both eyes see the same.",
            make_rooms=_repeat_scene(_corner),
            seeds=12,
            seconds=90.0,
        ),
    )
}


def sample_rooms(name: str, seeds: int, seed: int) -> Room:
    """Build the rooms of a trial, one per robot, for a number of seeds."""
    return TRIALS[name].make_rooms(jax.random.fold_in(jax.random.key(seed), TRIAL_EPISODE), seeds)
