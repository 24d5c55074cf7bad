"""Why a robot touched something: recorded walks taken apart at every collision, and collisions sorted into kinds.

| kind                 | what happened in the last 2.5 s                                              |
| -------------------- | ---------------------------------------------------------------------------- |
| tail swing           | tail or hind leg touched: a limit of the rule, whose scanner looks ahead     |
| corner               | things stood near on both sides at once: turning from one led to the other   |
| did not see          | u of neither eye rose above what it is with nothing near                     |
| saw both sides       | u rose alike on both sides, and the command did not turn                     |
| turned the other way | the command turned against the label                                         |
| turned too late      | all else: not against it, but not enough or not in time                      |

The first that fits is the kind: where it happened, then what the eyes said, then what was done about it.

u rises with the robot's own turning no less than with nearness: with nothing near it is 0.53 while the robot walks
straight, and 0.69 in a hard turn (the testing room, medians). What it is with nothing near is therefore looked up among
frames with as much turning, and is taken from the walks themselves, since floors differ (`measure`).

| symbol    | name                                                          | unit    |
| --------- | ------------------------------------------------------------- | ------- |
| u         | LGMD outputs, averaged over the gait cycle that ends there    | 1       |
| v_r - v_l | turn, of the command or of the label; positive to the left    | nominal |

Works on host records with axes (robot, frame). Where a trial ends with the first touch, those collisions are its own
that come before the end that `trials.judge` finds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from lgmdjax.control import braitenberg
from lgmdjax.errors import InputError
from lgmdjax.evaluation import contacts, metrics
from lgmdjax.evaluation.metrics import AVERAGED
from lgmdjax.sensors import laser
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record
from lgmdjax.world import arena

KINDS = {
    "tail swing": "tail or a hind leg touched: the rule's scanner looks ahead",
    "corner": "things stood near on both sides at once: turning from one led to the other",
    "did not see": "neither eye said more than it does with nothing near",
    "saw both sides": "both eyes said alike that something is near, and the command did not turn",
    "turned the other way": "the command turned against what the rule asked for",
    "turned too late": "the command did not turn the wrong way, but not enough or not in time",
}

WINDOW = 2.5  # s before the touch: three gait cycles, in which a hard turn takes the robot round by 40 degrees
FAR = 1.2  # m; where nothing is nearer, nothing is near: the rule begins to turn at 0.8 m
RISEN = 0.99  # quantile of u with nothing near; surpassed in 1 of 5 to 14 windows with nothing near, 0.95 in 1 of 3
BANDS = (0.3, 1.0, 2.0)  # nominal; between these |v_r - v_l|, u with nothing near is taken to be one thing
LEAST = 10.0  # s of walking with nothing near that tell what u then is
LEAST_OF_BAND = 3.0  # s of it that tell so for one of the bands
TELLS = 0.5  # spreads of u_l - u_r; 9 of 10 frames of straight walking lie below, 3 of 4 of hard turns above
STEADY = float(braitenberg.Params().steady)  # nominal; a smaller |v_r - v_l| counts as no turn, as for the rule
MIDDLE = 0.05  # m; middle legs, which step 4 cm, touch no farther ahead or behind: neither front nor tail
NEAR = float(braitenberg.Params().close)  # m; for what is nearer the rule turns as hard as it can
BESIDE = 0.35  # rad; what is nearer to the heading stands ahead: half a robot at 0.5 m is 0.4 rad wide
ABEAM = 0.5 * laser.Params().field_of_view  # rad; what is farther from the heading is not walked into
_CYCLE = round(AVERAGED * FRAME_RATE)  # frames


@dataclass(frozen=True, kw_only=True)
class Yardstick:
    """What u is on walks, to measure by what it was before a touch."""

    quiet: tuple[float, ...]  # u seldom surpassed with nothing near, in each of the bands of turning
    spread: float  # standard deviation of u_l - u_r


@dataclass(frozen=True, kw_only=True)
class Collision:
    """One touch, and what led to it in the window before."""

    robot: int
    frame: int
    limb: str  # what touched, a name of `hexapod.CAPSULES`
    point: tuple[float, float]  # m, where on the robot, seen from above: ahead of the trunk's centre, to its left
    thing: str  # what was touched: box, wall or cylinder
    cornered: bool  # near at once to it and to something on the other side
    rise: float  # greatest u over that with nothing near
    difference: float  # greatest |u_l - u_r|, in spreads
    turn: float  # mean v_r - v_l of the command
    asked: float  # mean v_r - v_l of the label

    @property
    def bearing(self) -> float:
        """Tell in which direction from the trunk's centre it touched [rad], positive to the left."""
        return float(np.arctan2(self.point[1], self.point[0]))

    @property
    def part(self) -> str:
        """Tell which part of the robot touched: front, side or tail."""
        ahead = self.point[0]
        return "front" if ahead > MIDDLE else "tail" if ahead < -MIDDLE else "side"

    @property
    def kind(self) -> str:
        """Tell which of `KINDS` it is."""
        if self.part == "tail":
            return "tail swing"
        if self.cornered:
            return "corner"
        if self.rise <= 0:
            return "did not see"
        if self.difference < TELLS and abs(self.turn) <= STEADY:
            return "saw both sides"
        if self.turn * self.asked < 0 and min(abs(self.turn), abs(self.asked)) > STEADY:
            return "turned the other way"
        return "turned too late"


def find(record: Record, arenas: arena.Arena, yardstick: Yardstick | None = None) -> list[Collision]:
    """Take walks apart at every collision, in the order of robots and frames.

    Args:
        record: walks, axes (robot, frame).
        arenas: the robots' rooms, with a leading axis of robots.
        yardstick: of other walks of the same robot, where these are too few; their own (`measure`) if None.
    """
    hits = np.argwhere(np.asarray(record.contact) & np.asarray(record.ok))
    if not len(hits):
        return []
    yardstick = yardstick or measure(record)
    u, age = averaged(record), _age(record)
    rise = u - np.asarray(yardstick.quiet)[_band(record)][..., None]
    difference = np.abs(u[..., 0] - u[..., 1]) / yardstick.spread
    turn, asked = _turn(record.velocity), _turn(record.label)
    found = []
    for robot, frame in hits.tolist():
        first = frame - min(round(WINDOW * FRAME_RATE) - 1, int(age[robot, frame]))
        rows = robot, slice(first, frame + 1)
        found.append(
            Collision(
                robot=robot,
                frame=frame,
                **_place(_cut(record, rows), _cut(arenas, robot)),
                rise=float(rise[rows].max()),
                difference=float(difference[rows].max()),
                turn=float(turn[rows].mean()),
                asked=float(asked[rows].mean()),
            )
        )
    return found


def count(collisions: Sequence[Collision]) -> dict[str, int]:
    """Count the collisions of each kind, the kinds without any too."""
    kinds = [collision.kind for collision in collisions]
    return {kind: kinds.count(kind) for kind in KINDS}


def measure(record: Record) -> Yardstick:
    """Find what u is with nothing near, and how far the eyes differ, on walks with axes (robot, frame).

    Where hardly any robot turned as hard as that with nothing near, u is taken to be that of the next gentler band.

    Raises InputError if there is too little walking with nothing near.
    """
    u, band = averaged(record), _band(record)
    sound = np.asarray(record.ok) & (_age(record) >= _CYCLE)
    far = sound & np.all(np.asarray(record.distances) > FAR, axis=-1)
    if far.sum() < LEAST * FRAME_RATE:
        raise InputError(
            f"collisions: expected {LEAST:.0f} s or more with nothing within {FAR} m, got "
            f"{far.sum() / FRAME_RATE:.1f} s; give the yardstick of other walks of this robot"
        )
    level, quiet = float(np.quantile(u[far], RISEN)), []
    for number in range(len(BANDS) + 1):
        here = far & (band == number)
        level = float(np.quantile(u[here], RISEN)) if here.sum() >= LEAST_OF_BAND * FRAME_RATE else level
        quiet.append(level)
    # Eyes that never differ tell no side; with a spread of nothing their rounding would.
    spread = max(float(np.std((u[..., 0] - u[..., 1])[sound])), 1e-6)
    return Yardstick(quiet=tuple(quiet), spread=spread)


def averaged(record: Record) -> Float[ndarray, "robots frames 2"]:
    """Average u over the gait cycle that ends with each frame, as if a stretch's first frame had lasted for one."""
    return _trailing(np.asarray(record.u, float), record)


def _trailing(series: ndarray, record: Record) -> ndarray:
    """Average (robot, frame, ...) over the gait cycle that ends with each frame, not across a set-back."""
    means, backward = np.empty_like(series), (_CYCLE - 1) // 2
    for robot, first, end in metrics.stretches(np.asarray(record.setbacks)):
        stretch = series[robot, first:end]
        means[robot, first:end] = ndimage.uniform_filter1d(stretch, _CYCLE, axis=0, mode="nearest", origin=backward)
    return means


def _turn(velocity: Any) -> Float[ndarray, "robots frames"]:
    left, right = np.moveaxis(np.asarray(velocity, float), -1, 0)
    return right - left


def _band(record: Record) -> Int[ndarray, "robots frames"]:
    """Tell in which of the bands the robot turned in the gait cycle that ends with each frame."""
    return np.searchsorted(BANDS, _trailing(np.abs(_turn(record.velocity)), record))


def _age(record: Record) -> Int[ndarray, "robots frames"]:
    """Count the frames since the robot was put down."""
    age = np.empty(np.shape(record.setbacks), int)
    for robot, first, end in metrics.stretches(np.asarray(record.setbacks)):
        age[robot, first:end] = np.arange(end - first)
    return age


def _cut(batch: Any, rows: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], batch)


def _place(walk: Record, room: arena.Arena) -> dict[str, Any]:
    """Find where on the robot it touched what, and whether it was in a corner, in the last frame of a walk."""
    around = [contacts.surfaces(room, float(time)) for time in walk.time]
    touch = contacts.touch(walk, around[-1])
    centres = np.asarray(walk.position, float)[:, None, :2]
    points = np.concatenate([contacts.nearest(*pair) for pair in zip(around, centres, strict=True)])
    return {
        "limb": touch.limb,
        "point": (float(touch.point[0]), float(touch.point[1])),
        "thing": around[-1].names[touch.surface],
        "cornered": bool(np.any(_cornered(walk, points, touch.surface))),
    }


def _cornered(walk: Record, points: Float[ndarray, "frames surfaces 2"], touched: int) -> Bool[ndarray, " frames"]:
    """Tell in which frames the nearest point of what was touched, and one of something else, were near on two sides."""
    position, quaternion = (np.asarray(pose, float)[:, None] for pose in (walk.position, walk.quaternion))
    ahead, left = np.moveaxis(contacts.seen(position, quaternion, points), -1, 0)
    bearing = np.arctan2(left, ahead)
    beside = (np.hypot(ahead, left) < NEAR) & (np.abs(bearing) > BESIDE) & (np.abs(bearing) < ABEAM)
    side = np.sign(bearing) * beside
    return np.any(side * side[:, touched, None] < 0, axis=1)
