"""Why a robot collided: each collision of recorded walks is described and classified by its cause.

| cause                | condition in the 2.5 s before the contact                                  |
| -------------------- | -------------------------------------------------------------------------- |
| tail swing           | the tail or a hind leg touched; the rule's scanner looks only ahead        |
| corner               | obstacles were near on both sides at once                                  |
| did not see          | neither u rose above its baseline                                          |
| saw both sides       | both u rose alike, and the command did not turn                            |
| turned the other way | the command turned against the label                                       |
| turned too late      | otherwise: the command did not turn the wrong way, but too little or late  |

The first cause whose condition holds is chosen.

u rises not only near obstacles but also when the robot turns. Medians of u with nothing near, in the testing room:

| walking   | u    |
| --------- | ---- |
| straight  | 0.53 |
| hard turn | 0.69 |

The baseline of u is therefore looked up among frames with similar turning. It is fitted to the walks themselves, since
it depends on the texture of the floor (`fit_baseline`).

| symbol    | name                                                       | unit    |
| --------- | ---------------------------------------------------------- | ------- |
| u         | LGMD outputs, averaged over the preceding gait cycle       | 1       |
| v_r - v_l | turn, of the command or of the label; positive to the left | nominal |

Works on host records with axes (robot, frame). In a trial that ends at the first contact, only collisions before the
end found by `trials.find_outcome` belong to the trial.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from lgmdjax.body.robot_xml import Body
from lgmdjax.control import braitenberg
from lgmdjax.errors import InputError
from lgmdjax.evaluation import contacts, metrics
from lgmdjax.evaluation.metrics import AVERAGING_TIME
from lgmdjax.sensors import laser
from lgmdjax.simulation.closed_loop import FRAME_RATE, AnyArray, Record
from lgmdjax.world import arena

_Tree = TypeVar("_Tree")

CAUSES = {
    "tail swing": "the tail or a hind leg touched: the rule's scanner looks only ahead",
    "corner": "obstacles were near on both sides at once: turning from one led to the other",
    "did not see": "neither eye's u rose above its level with nothing near",
    "saw both sides": "both eyes' u rose alike, and the command did not turn",
    "turned the other way": "the command turned against the rule's label",
    "turned too late": "the command did not turn the wrong way, but too little or too late",
}
"""Name and meaning of each cause."""

WINDOW = 2.5  # s before the contact: three gait cycles, in which a hard turn rotates the robot by 40 degrees
CLEAR_DISTANCE = 1.2  # m; with nothing nearer, nothing counts as near: the rule starts to turn at 0.8 m
QUIET_QUANTILE = 0.99  # of u with nothing near; 1 of 5 to 14 windows with nothing near exceed it (0.95: 1 of 3)
TURN_BANDS = (0.3, 1.0, 2.0)  # nominal; bounds of |v_r - v_l|, between which the baseline of u is constant
MIN_QUIET_TIME = 10.0  # s of walking with nothing near that the baseline needs
MIN_BAND_TIME = 3.0  # s of it that the baseline of one band needs
MIN_DIFFERENCE = 0.5  # in units of difference_std; exceeded in 1 of 10 frames of straight walks, 3 of 4 of hard turns
MIN_TURN = float(braitenberg.Params().turn_deadband)  # nominal; a smaller |v_r - v_l| counts as no turn, as in the rule
SIDE_REACH = 0.05  # m; middle legs, which step 4 cm, touch no farther ahead or behind: neither front nor tail
NEAR_DISTANCE = float(braitenberg.Params().full_turn_distance)  # m; nearer than this the rule turns as hard as it can
MIN_SIDE_BEARING = 0.35  # rad; at a smaller bearing it is ahead: half a robot at 0.5 m subtends 0.4 rad
MAX_SIDE_BEARING = 0.5 * laser.Params().fov  # rad; at a greater bearing the robot doesn't walk into it
_CYCLE = round(AVERAGING_TIME * FRAME_RATE)  # frames


@dataclass(frozen=True, kw_only=True)
class QuietBaseline:
    """Levels of u with nothing near, with which u before a contact is compared."""

    u_levels: tuple[float, ...]  # quantile `QUIET_QUANTILE` of u with nothing near, in each band of turning
    difference_std: float  # standard deviation of u_l - u_r


@dataclass(frozen=True, kw_only=True)
class Collision:
    """One collision, and u, command and label in the window before."""

    robot: int
    frame: int
    limb: str  # touching limb, a name of `hexapod.CAPSULES`
    point: tuple[float, float]  # m, on the robot, seen from above: ahead of the trunk's centre, to its left
    obstacle: str  # touched obstacle: box, wall or cylinder
    in_corner: bool  # another obstacle was near on the other side at the same time
    u_rise: float  # maximum of u minus its baseline
    u_difference: float  # maximum of |u_l - u_r|, in units of difference_std
    command_turn: float  # mean v_r - v_l of the command
    label_turn: float  # mean v_r - v_l of the label

    @property
    def bearing(self) -> float:
        """Return the bearing [rad] of the contact from the trunk's centre, positive to the left."""
        return float(np.arctan2(self.point[1], self.point[0]))

    @property
    def part(self) -> str:
        """Return the part of the robot that touched: front, side or tail."""
        ahead = self.point[0]
        return "front" if ahead > SIDE_REACH else "tail" if ahead < -SIDE_REACH else "side"

    @property
    def cause(self) -> str:
        """Return the cause, a key of `CAUSES`."""
        if self.part == "tail":
            return "tail swing"
        if self.in_corner:
            return "corner"
        if self.u_rise <= 0:
            return "did not see"
        if self.u_difference < MIN_DIFFERENCE and abs(self.command_turn) <= MIN_TURN:
            return "saw both sides"
        if self.command_turn * self.label_turn < 0 and min(abs(self.command_turn), abs(self.label_turn)) > MIN_TURN:
            return "turned the other way"
        return "turned too late"


class _Place(NamedTuple):
    """Where on the robot a contact was, and with what."""

    limb: str
    point: tuple[float, float]
    obstacle: str
    in_corner: bool


def classify(
    record: Record, arenas: arena.Arena, baseline: QuietBaseline | None = None, body: Body | None = None
) -> list[Collision]:
    """Describe every collision of recorded walks, in the order of robots and frames; each has its `cause`.

    Args:
        record: walks, axes (robot, frame).
        arenas: the robots' rooms, with a leading axis of robots.
        baseline: fitted to other walks of the same robot; by default fitted to these walks (`fit_baseline`).
        body: of the robot; the package's if None.
    """
    found = np.argwhere(np.asarray(record.contact) & np.asarray(record.ok))
    if not len(found):
        return []
    baseline = baseline or fit_baseline(record)
    u, age = average_over_cycle(record), _frames_since_reset(record)
    rise = u - np.asarray(baseline.u_levels)[_turn_band(record)][..., None]
    difference = np.abs(u[..., 0] - u[..., 1]) / baseline.difference_std
    command_turn, label_turn = _turn(record.velocity), _turn(record.label)
    collisions = []
    for robot, frame in found.tolist():
        first = frame - min(round(WINDOW * FRAME_RATE) - 1, int(age[robot, frame]))
        window = robot, slice(first, frame + 1)
        collisions.append(
            Collision(
                robot=robot,
                frame=frame,
                **_locate(_index(record, window), _index(arenas, robot), body)._asdict(),
                u_rise=float(rise[window].max()),
                u_difference=float(difference[window].max()),
                command_turn=float(command_turn[window].mean()),
                label_turn=float(label_turn[window].mean()),
            )
        )
    return collisions


def count_causes(collisions: Sequence[Collision]) -> dict[str, int]:
    """Count the collisions of each cause, including causes without any."""
    causes = [collision.cause for collision in collisions]
    return {cause: causes.count(cause) for cause in CAUSES}


def fit_baseline(record: Record) -> QuietBaseline:
    """Fit the baseline of u to the frames of walks with nothing near; axes (robot, frame).

    A band of turning with too few such frames gets the level of the next gentler band.

    Raises InputError if there is too little walking with nothing near.
    """
    u, band = average_over_cycle(record), _turn_band(record)
    valid = np.asarray(record.ok) & (_frames_since_reset(record) >= _CYCLE)
    quiet = valid & np.all(np.asarray(record.distances) > CLEAR_DISTANCE, axis=-1)
    if quiet.sum() < MIN_QUIET_TIME * FRAME_RATE:
        raise InputError(
            f"collision_causes: expected {MIN_QUIET_TIME:.0f} s or more with nothing within {CLEAR_DISTANCE} m, got "
            f"{quiet.sum() / FRAME_RATE:.1f} s; give the baseline of other walks of this robot"
        )
    level, levels = float(np.quantile(u[quiet], QUIET_QUANTILE)), []
    for number in range(len(TURN_BANDS) + 1):
        in_band = quiet & (band == number)
        level = float(np.quantile(u[in_band], QUIET_QUANTILE)) if in_band.sum() >= MIN_BAND_TIME * FRAME_RATE else level
        levels.append(level)
    # If both u are always equal, a deviation of zero would make rounding errors count as differences.
    difference_std = max(float(np.std((u[..., 0] - u[..., 1])[valid])), 1e-6)
    return QuietBaseline(u_levels=tuple(levels), difference_std=difference_std)


def average_over_cycle(record: Record) -> Float[ndarray, "robots frames 2"]:
    """Average u over the gait cycle that ends with each frame; the first frame of a segment is repeated before it."""
    return _trailing_mean(np.asarray(record.u, float), record)


def _trailing_mean(series: ndarray, record: Record) -> ndarray:
    """Average a series (robot, frame, ...) over the gait cycle that ends with each frame, but not across a reset."""
    means, backward = np.empty_like(series), (_CYCLE - 1) // 2
    for robot, first, end in metrics.segment_bounds(np.asarray(record.resets)):
        segment = series[robot, first:end]
        means[robot, first:end] = ndimage.uniform_filter1d(segment, _CYCLE, axis=0, mode="nearest", origin=backward)
    return means


def _turn(velocity: Float[AnyArray, "robots frames 2"]) -> Float[ndarray, "robots frames"]:
    left, right = np.moveaxis(np.asarray(velocity, float), -1, 0)
    return right - left


def _turn_band(record: Record) -> Int[ndarray, "robots frames"]:
    """Return the number of the band of mean |v_r - v_l| in the gait cycle that ends with each frame."""
    return np.searchsorted(TURN_BANDS, _trailing_mean(np.abs(_turn(record.velocity)), record))


def _frames_since_reset(record: Record) -> Int[ndarray, "robots frames"]:
    """Count the frames since the robot's last reset."""
    age = np.empty(np.shape(record.resets), int)
    for robot, first, end in metrics.segment_bounds(np.asarray(record.resets)):
        age[robot, first:end] = np.arange(end - first)
    return age


def _index(batch: _Tree, index: int | tuple[int, slice]) -> _Tree:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], batch)


def _locate(walk: Record, room: arena.Arena, body: Body | None) -> _Place:
    """Locate the contact in the last frame of a walk, and check whether the robot was in a corner."""
    surfaces = [contacts.touchable_surfaces(room, float(time)) for time in walk.time]
    contact = contacts.locate_contact(walk, surfaces[-1], body)
    centres = np.asarray(walk.position, float)[:, None, :2]
    points = np.concatenate([contacts.nearest_points(*pair) for pair in zip(surfaces, centres, strict=True)])
    return _Place(
        limb=contact.limb,
        point=(float(contact.point[0]), float(contact.point[1])),
        obstacle=surfaces[-1].kinds[contact.surface],
        in_corner=bool(np.any(_is_in_corner(walk, points, contact.surface))),
    )


def _is_in_corner(walk: Record, points: Float[ndarray, "frames surfaces 2"], touched: int) -> Bool[ndarray, " frames"]:
    """Find the frames in which the touched surface and another one were near on opposite sides of the robot."""
    position, quaternion = (np.asarray(pose, float)[:, None] for pose in (walk.position, walk.quaternion))
    ahead, left = np.moveaxis(contacts.to_body_frame(position, quaternion, points), -1, 0)
    bearing = np.arctan2(left, ahead)
    beside = (np.abs(bearing) > MIN_SIDE_BEARING) & (np.abs(bearing) < MAX_SIDE_BEARING)
    side = np.sign(bearing) * ((np.hypot(ahead, left) < NEAR_DISTANCE) & beside)
    return np.any(side * side[:, touched, None] < 0, axis=1)
