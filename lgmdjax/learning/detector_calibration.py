"""Fit any looming detector to the robot's camera: the same few constants for all, chosen on the same recorded walks.

The constants that authors publish are for their own pictures. Every detector, `scaled`, is run with all pairs of cells
of n pixels and contrast k, and gets for each pair

- T_F, where it has a parameter `suppression` and a response `feed_forward`: `SUPPRESSION_MARGIN` times the largest FF
  of walking and turning, as in `lgmd_grid_search`, so that it suppresses only motion that is not the robot's own,
- g, with which the `FILLED` quantile of u is `FULL`, so that u fills its range,

and the pair is chosen whose left-right difference of u, averaged over a gait cycle, correlates best with that of
proximity, as in `lgmd_grid_search`. All other constants are the published ones.

| symbol | name        | unit                 |
| ------ | ----------- | -------------------- |
| n      | pooling     | px                   |
| k      | contrast    | 1                    |
| g      | gain        | 1                    |
| T_F    | suppression | that of feed_forward |
| r      | score       | 1                    |
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree
from scipy import ndimage
from tqdm.auto import tqdm

from lgmdjax.control.controller import Response
from lgmdjax.detectors import protocol, scaled
from lgmdjax.detectors.protocol import Detector
from lgmdjax.errors import InputError
from lgmdjax.evaluation.metrics import AVERAGING_TIME
from lgmdjax.learning import detector_responses, lgmd_grid_search
from lgmdjax.learning.lgmd_grid_search import SUPPRESSION_MARGIN
from lgmdjax.runtime import interruption
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, finite
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record

POOLINGS = (1, 2, 3)  # px: cells of 2, 4 and 6 degrees of a picture of 80 px
CONTRASTS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
FILLED, FULL = 0.9, 0.9  # quantile of u, and its value
SILENT = 1e-4  # a detector whose quantile of x, u = 1 / (1 + exp(-x)), is less does not respond
NO_RESPONSE = -1.0  # score of a candidate that does not respond
MIN_SECONDS = 10.0  # of steady walking, all robots together


@dataclass(frozen=True)
class Candidate:
    """One pair of constants with what follows from it."""

    pooling: int
    contrast: float
    gain: float
    suppression: float | None  # None without any FF
    score: float


def calibrate(
    robot: closed_loop.Params, model: Detector, detector: PyTree, record: Record, pictures: detector_responses.Pictures
) -> tuple[closed_loop.Params, list[JsonObject]]:
    """Return the robot with a detector fitted to its camera, and a row for every candidate.

    Args:
        robot: the robot that walked.
        model: the detector.
        detector: its published parameters.
        record: recorded walks, axes (robot, frame).
        pictures: of every frame.

    Raises InputError if there is less than 10 s of steady walking, or if the detector responds to nothing.
    """
    record = finite.require_finite(record, "calibration")
    steady = lgmd_grid_search.is_steady_walking(record)
    if steady.sum() < MIN_SECONDS * FRAME_RATE:
        raise InputError(
            f"calibration: expected {MIN_SECONDS:g} s or more of walking, got {steady.sum() / FRAME_RATE:.1f} s; "
            "record longer walks, or more robots"
        )
    known = assembly.with_detector(robot, scaled, scaled.Params(model=model, detector=detector))
    rows = list(_compare(known, record, pictures, steady))
    best = max(rows, key=lambda row: row.score)
    if best.score <= NO_RESPONSE:
        raise InputError(
            f"detector {protocol.name(model)}: expected a response in a tenth of the frames for some of {len(rows)} "
            "pairs of cells and contrast, got none; change its constants"
        )
    return with_candidate(known, best), [asdict(row) | {"chosen": row is best} for row in rows]


def with_candidate(robot: closed_loop.Params, candidate: Candidate) -> closed_loop.Params:
    """Return a robot with the detector `scaled` that has the constants of a candidate."""
    own: scaled.Params = robot.controller.detector
    inside = own.detector
    if candidate.suppression is not None and hasattr(inside, "suppression"):
        inside = replace(inside, suppression=jnp.asarray(candidate.suppression, float))
    fitted = scaled.Params(
        model=own.model, detector=inside, contrast=candidate.contrast, gain=candidate.gain, pooling=candidate.pooling
    )
    return assembly.with_detector(robot, scaled, fitted)


def _compare(
    robot: closed_loop.Params,
    record: Record,
    pictures: detector_responses.Pictures,
    steady: Bool[np.ndarray, "robots frames"],
) -> Iterator[Candidate]:
    """Yield all candidates with their scores; nothing is suppressed."""
    own: scaled.Params = robot.controller.detector
    inside = own.detector
    if hasattr(inside, "suppression"):
        inside = replace(inside, suppression=jnp.asarray(jnp.inf))
    pairs = [(pooling, contrast) for pooling in POOLINGS for contrast in CONTRASTS]
    for pooling, contrast in tqdm(pairs, desc=f"calibrate {protocol.name(own.model)}", unit="pair"):
        interruption.check()
        trial = replace(own, detector=inside, contrast=jnp.asarray(contrast, float), pooling=pooling)
        response = detector_responses.respond(replace(robot.controller, detector=trial), pictures, record.is_first)
        yield judge((pooling, contrast), jax.tree.map(np.asarray, response), record, steady)


def judge(
    pair: tuple[int, float], response: Response, record: Record, steady: Bool[np.ndarray, "robots frames"]
) -> Candidate:
    """Return the candidate that a pair of cells and contrast gives, from its responses (robot, frame, eye)."""
    x = np.asarray(scaled.logit(jnp.asarray(response.u)))
    level, largest = float(np.quantile(x[steady], FILLED)), float(np.max(response.feed_forward[steady]))
    suppression = SUPPRESSION_MARGIN * largest if largest > 0 else None
    if not level > SILENT:
        return Candidate(*pair, gain=1.0, suppression=suppression, score=NO_RESPONSE)
    gain = float(scaled.logit(jnp.asarray(FULL, float))) / level
    u = np.asarray(scaled.expand(jnp.asarray(response.u), gain))
    return Candidate(*pair, gain=gain, suppression=suppression, score=agreement(u, record))


def agreement(u: Float[np.ndarray, "robots frames 2"], record: Record) -> float:
    """Return the correlation of u_left - u_right, averaged over a gait cycle, with that of proximity.

    Only steady walking counts.
    """
    steady = lgmd_grid_search.is_steady_walking(record)
    averaged = ndimage.uniform_filter1d(u, round(AVERAGING_TIME * FRAME_RATE), axis=1)[steady]
    return lgmd_grid_search.correlations(averaged, 1 / np.asarray(record.distances)[steady])["score"]
