"""Choose the LGMD's constants on recorded walks: T_s, W_I by what u tells of distance, T_f by what walking looks like.

T_s "has to be set experimentally" (paper sec. 3.3). Here the pictures of a recorded walk are drawn again, and the
detector is run with many thresholds and weights at once. The best one is that whose left-right difference of u,
averaged over about a gait cycle, follows the difference of nearness best: steering is a matter of which side is
nearer.

T_f then lies above all FF that walking and turning make: the gate is left to motion that is not the robot's own, such
as being lifted. A lower one cuts turns, and of two flooded eyes the nearer first, so that the difference of the two
tells the wrong side: while turning hard it follows nearness with r = 0.3 with the gate open, and -0.6 with T_f at the
FF of straight walking.

| symbol      | name                    | unit |
| ----------- | ----------------------- | ---- |
| T_s         | threshold               | grey |
| W_I         | inhibition              | 1    |
| T_f         | suppression             | grey |
| U / n_cell  | excitation              | grey |
| FF          | feed_forward            | grey |
| 1/d         | nearness                | 1/m  |

Source: Cizek & Faigl, eqs. 12-16 and sec. 3.3; the statistic is our own.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from scipy import ndimage

from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation.metrics import AVERAGED
from lgmdjax.sensors import camera
from lgmdjax.simulation import rerender, rollout, sharding
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record
from lgmdjax.world import arena

THRESHOLDS = (0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)  # candidates for T_s, grey
INHIBITIONS = (0.1, 0.2, 0.3, 0.4)  # candidates for W_I; the paper's is 0.4
MARGIN = 1.25  # T_f over the greatest FF of walking


@struct.dataclass(kw_only=True)
class Candidates:
    """Pairs of constants to try."""

    threshold: Float[Array | np.ndarray, "candidates"]  # T_s, grey
    inhibition: Float[Array | np.ndarray, "candidates"]  # W_I


@struct.dataclass(kw_only=True)
class Choice:
    """The constants chosen, and how all candidates did."""

    threshold: float
    inhibition: float
    suppression: float
    table: list[dict[str, float]]


def grid(thresholds: Sequence[float] = THRESHOLDS, inhibitions: Sequence[float] = INHIBITIONS) -> Candidates:
    """Pair each threshold with each weight."""
    pairs = np.array(list(product(inhibitions, thresholds)), dtype=float)
    return Candidates(threshold=pairs[:, 1], inhibition=pairs[:, 0])


@partial(jax.jit, static_argnames="eyes")
def survey(
    params: lgmd.Params, eyes: camera.Params, arenas: arena.Arena, record: Record, candidates: Candidates
) -> tuple[Float[Array, "robots frames 2 candidates"], Float[Array, "robots frames 2"]]:
    """Draw what recorded walks saw once more, and return u for every candidate, the gate open, and FF, of both eyes.

    The eyes open on the first picture, and anew wherever the robot was put down.
    """

    def see(candidate: Candidates, state: lgmd.State, picture: Array) -> tuple[lgmd.State, Array, Array]:
        chosen = {"threshold": candidate.threshold, "inhibition": candidate.inhibition, "suppression": jnp.inf}
        state, response = lgmd.step(replace(params, **chosen), state, picture)
        return state, response.u, response.feed_forward

    # What no candidate changes, the next state and FF, is evaluated once.
    see_all = jax.vmap(see, in_axes=(0, None, None), out_axes=(None, 0, None))

    open_eyes = jax.vmap(partial(lgmd.init, params))

    def step(room: arena.Arena, state: lgmd.State, row: tuple[Array, ...]):
        fresh, *pose = row
        pictures = rerender.frame(eyes, room, *pose)
        opened = jax.tree.map(partial(jnp.where, fresh), open_eyes(pictures), state)
        state, u, FF = jax.vmap(see_all, in_axes=(None, 0, 0))(candidates, opened, pictures)
        return state, (u, FF)

    def work(rooms: arena.Arena, rows: tuple[Array, ...]):
        shut = jax.vmap(open_eyes)(jnp.zeros((len(rows[0]), *camera.shape(eyes))))
        return rollout.march(step, rooms, shut, rows)[1]

    fresh = jnp.asarray(record.fresh).at[:, 0].set(True)
    poses = (record.time, record.position, record.quaternion)
    return sharding.deal(work, arenas, (fresh, *map(jnp.asarray, poses)))


def choose(record: Record, u: np.ndarray, feed_forward: np.ndarray, candidates: Candidates) -> Choice:
    """Choose T_s, W_I and T_f from a survey of recorded walks.

    Args:
        record: the walks, axes (robot, frame).
        u: of every candidate, (robots, frames, 2, candidates).
        feed_forward: FF, (robots, frames, 2) [grey].
        candidates: what was tried.

    Raises InputError when there is too little sound walking to tell.
    """
    sound = _sound(record)
    if sound.sum() < 10 * FRAME_RATE:
        raise InputError(
            f"calibration: expected 10 s or more of walking, got {sound.sum() / FRAME_RATE:.1f} s; "
            "record longer walks, or more robots"
        )
    nearness = 1 / np.asarray(record.distances)
    averaged = ndimage.uniform_filter1d(np.asarray(u), round(AVERAGED * FRAME_RATE), axis=1)[sound]
    pairs = zip(candidates.threshold.tolist(), candidates.inhibition.tolist(), strict=True)
    table = [
        {"threshold": T_s, "inhibition": W_I, **_agreement(averaged[..., k], nearness[sound])}
        for k, (T_s, W_I) in enumerate(pairs)
    ]
    best = max(table, key=lambda row: row["score"])
    suppression = MARGIN * float(np.max(np.asarray(feed_forward)[sound]))
    return Choice(threshold=best["threshold"], inhibition=best["inhibition"], suppression=suppression, table=table)


def follow(record: Record) -> dict[str, float]:
    """Correlate what the eyes of recorded walks said with nearness, as `choose` does for its candidates."""
    sound = _sound(record)
    averaged = ndimage.uniform_filter1d(np.asarray(record.u), round(AVERAGED * FRAME_RATE), axis=1)[sound]
    if not sound.any():  # as of a robot that falls at once
        return dict.fromkeys(("score", "left", "right"), 0.0)
    return _agreement(averaged, 1 / np.asarray(record.distances)[sound])


def _sound(record: Record) -> np.ndarray:
    """Tell which frames are walking that has lasted long enough for the average to be of nothing else."""
    sound = np.asarray(record.ok) & ~np.asarray(record.contact) & ~np.asarray(record.fresh)
    window = round(AVERAGED * FRAME_RATE)
    # The average is centred: half a window on either side would do, and as much again lets the robot find its stride.
    return ndimage.minimum_filter1d(sound.astype(np.uint8), 2 * window + 1, axis=1, mode="constant").astype(bool)


def _agreement(u: Float[np.ndarray, "frames 2"], nearness: Float[np.ndarray, "frames 2"]) -> dict[str, float]:
    """Correlate u with 1/d on either side, and the differences of the sides, which is the score."""

    def correlation(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0 and np.ptp(b) > 0 else 0.0

    return {
        "score": correlation(u[:, 0] - u[:, 1], nearness[:, 0] - nearness[:, 1]),
        "left": correlation(u[:, 0], nearness[:, 0]),
        "right": correlation(u[:, 1], nearness[:, 1]),
    }
