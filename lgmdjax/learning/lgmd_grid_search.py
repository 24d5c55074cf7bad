"""Choose the LGMD's constants on recorded walks: T_s and W_I by a grid search, T_f by the FF values of walking.

T_s "has to be set experimentally" (paper sec. 3.3). Here the images of recorded walks are rendered again, and the
detector is run with many pairs of T_s and W_I at once. The best pair is the one whose left-right difference of u,
averaged over about a gait cycle, correlates best with the left-right difference of proximity, since steering depends on
which side is nearer. Proximity is that of the nearest obstacle, in the way or not. Obstacles in the way are rare: with
their proximity as the criterion, a threshold was chosen that kept u at rest in 97 % of the frames.

T_f is then set above every FF value of walking and turning, so that suppression only responds to motion that is not the
robot's own, such as being lifted. A lower T_f suppresses u during turns, and first on the nearer side, so that the
difference of the two eyes indicates the wrong side:

| T_f                    | correlation of u with proximity in hard turns, left - right |
| ---------------------- | ----------------------------------------------------------- |
| infinite               | 0.3                                                         |
| FF of straight walking | -0.6                                                        |

| symbol      | name                    | unit |
| ----------- | ----------------------- | ---- |
| T_s         | threshold               | grey |
| W_I         | inhibition              | 1    |
| T_f         | suppression             | grey |
| U / n_cell  | excitation              | grey |
| FF          | feed_forward            | grey |
| 1/d         | proximity               | 1/m  |

Source: Cizek & Faigl, eqs. 12-16 and sec. 3.3; the correlation as a criterion is ours.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float
from scipy import ndimage

from lgmdjax.control import braitenberg
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation.metrics import AVERAGING_TIME
from lgmdjax.sensors import camera, hemifield
from lgmdjax.simulation import finite, rerender, rollout, sharding
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record
from lgmdjax.world import arena

THRESHOLDS = (0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)  # candidates for T_s, grey
INHIBITIONS = (0.1, 0.2, 0.3, 0.4)  # candidates for W_I; the paper's is 0.4
SUPPRESSION_MARGIN = 1.25  # T_f relative to the largest FF of walking
CALIBRATION_RULE = braitenberg.Params(corridor=0.0, turn_distance=0.95, full_turn_distance=0.6)
"""The rule of the calibration walks, which turns away from everything near.

T_f has to be above the FF values of hard turns. The teacher's own walks have too few of them: T_f became half as large,
and the detectors of a robot that had to turn were suppressed.
"""


@struct.dataclass(kw_only=True)
class Candidates:
    """Pairs of constants to compare."""

    threshold: Float[Array | np.ndarray, "candidates"]  # T_s, grey
    inhibition: Float[Array | np.ndarray, "candidates"]  # W_I


@struct.dataclass(kw_only=True)
class Selection:
    """The selected constants, and the correlations of every candidate."""

    threshold: float
    inhibition: float
    suppression: float
    table: list[dict[str, float]]


def candidate_grid(thresholds: Sequence[float] = THRESHOLDS, inhibitions: Sequence[float] = INHIBITIONS) -> Candidates:
    """Combine every threshold with every weight.

    >>> grid = candidate_grid([1.0, 2.0], [0.2, 0.4])
    >>> grid.threshold.tolist(), grid.inhibition.tolist()
    ([1.0, 2.0, 1.0, 2.0], [0.2, 0.2, 0.4, 0.4])
    """
    pairs = np.array(list(product(inhibitions, thresholds)), dtype=float)
    return Candidates(threshold=pairs[:, 1], inhibition=pairs[:, 0])


@partial(jax.jit, static_argnames="camera_params")
def evaluate(
    params: lgmd.Params, camera_params: camera.Params, arenas: arena.Arena, record: Record, candidates: Candidates
) -> tuple[Float[Array, "robots frames 2 candidates"], Float[Array, "robots frames 2"]]:
    """Render recorded walks again; return u of every candidate without suppression, and FF, of both eyes.

    The detectors are initialised with the first image, and again after every reset of the robot.
    """

    def respond(candidate: Candidates, state: lgmd.State, image: Array) -> tuple[lgmd.State, Array, Array]:
        constants = {"threshold": candidate.threshold, "inhibition": candidate.inhibition, "suppression": jnp.inf}
        state, response = lgmd.step(replace(params, **constants), state, image)
        return state, response.u, response.feed_forward

    # The next state and FF are the same for all candidates, and are computed once.
    respond_all = jax.vmap(respond, in_axes=(0, None, None), out_axes=(None, 0, None))

    init_both = jax.vmap(partial(lgmd.init, params))

    def step(room: arena.Arena, state: lgmd.State, row: tuple[Array, ...]):
        is_first, *pose = row
        images = hemifield.outermost_first(rerender.render_pose(camera_params, room, *pose))
        state = jax.tree.map(partial(jnp.where, is_first), init_both(images), state)
        state, u, FF = jax.vmap(respond_all, in_axes=(None, 0, 0))(candidates, state, images)
        return state, (u, FF)

    def work(rooms: arena.Arena, rows: tuple[Array, ...]):
        black = jax.vmap(init_both)(jnp.zeros((len(rows[0]), *camera.image_shape(camera_params))))
        return rollout.scan_batch(step, rooms, black, rows)[1]

    is_first = jnp.asarray(record.is_first).at[:, 0].set(True)
    poses = (record.time, record.position, record.quaternion)
    return sharding.shard_robots(work, arenas, (is_first, *map(jnp.asarray, poses)))


def select(record: Record, u: np.ndarray, feed_forward: np.ndarray, candidates: Candidates) -> Selection:
    """Select T_s, W_I and T_f from the responses to recorded walks.

    Args:
        record: the walks, axes (robot, frame).
        u: of every candidate, (robots, frames, 2, candidates).
        feed_forward: FF, (robots, frames, 2) [grey].
        candidates: the pairs of constants.

    Raises InputError if there are less than 10 s of steady walking, or responses that are not finite.
    """
    record = finite.require_finite(record, "calibration")
    steady = is_steady_walking(record)
    if steady.sum() < 10 * FRAME_RATE:
        raise InputError(
            f"calibration: expected 10 s or more of walking, got {steady.sum() / FRAME_RATE:.1f} s; "
            "record longer walks, or more robots"
        )
    responses = np.concatenate([np.asarray(u), np.asarray(feed_forward)[..., None]], axis=-1)[steady]
    if not np.isfinite(responses).all():
        raise InputError("calibration: expected finite responses, got nan; are all textures of the rooms finite?")
    proximity = 1 / np.asarray(record.distances)
    averaged = ndimage.uniform_filter1d(np.asarray(u), round(AVERAGING_TIME * FRAME_RATE), axis=1)[steady]
    pairs = zip(candidates.threshold.tolist(), candidates.inhibition.tolist(), strict=True)
    table = [
        {"threshold": T_s, "inhibition": W_I, **correlations(averaged[..., k], proximity[steady])}
        for k, (T_s, W_I) in enumerate(pairs)
    ]
    best = max(table, key=lambda row: row["score"])
    suppression = SUPPRESSION_MARGIN * float(np.max(np.asarray(feed_forward)[steady]))
    return Selection(threshold=best["threshold"], inhibition=best["inhibition"], suppression=suppression, table=table)


def correlate_with_proximity(record: Record) -> dict[str, float]:
    """Return the correlations of the recorded u with proximity, by which `select` compares candidates."""
    steady = is_steady_walking(record)
    averaged = ndimage.uniform_filter1d(np.asarray(record.u), round(AVERAGING_TIME * FRAME_RATE), axis=1)[steady]
    if not steady.any():  # as for a robot that falls at once
        return dict.fromkeys(("score", "left", "right"), 0.0)
    return correlations(averaged, 1 / np.asarray(record.distances)[steady])


def is_steady_walking(record: Record) -> Bool[np.ndarray, "robots frames"]:
    """Flag frames whose averaging window, and half a window on either side of it, contain nothing but walking."""
    walking = np.asarray(record.ok) & ~np.asarray(record.contact) & ~np.asarray(record.is_first)
    window = round(AVERAGING_TIME * FRAME_RATE)
    # The average is centred and needs half a window on either side; the other half lets the gait become steady.
    return ndimage.minimum_filter1d(walking.astype(np.uint8), 2 * window + 1, axis=1, mode="constant").astype(bool)


def correlations(u: Float[np.ndarray, "frames 2"], proximity: Float[np.ndarray, "frames 2"]) -> dict[str, float]:
    """Correlate u with 1/d on each side, and the left-right differences of both, which is the score."""

    def correlation(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0 and np.ptp(b) > 0 else 0.0

    return {
        "score": correlation(u[:, 0] - u[:, 1], proximity[:, 0] - proximity[:, 1]),
        "left": correlation(u[:, 0], proximity[:, 0]),
        "right": correlation(u[:, 1], proximity[:, 1]),
    }
