"""Thresholds chosen on walks whose best ones are known, and a survey that equals the detector run one by one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.learning import lgmd_grid_search
from lgmdjax.sensors import camera, hemifield
from lgmdjax.simulation import rerender
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record
from lgmdjax.world import arena

CANDIDATES = lgmd_grid_search.Candidates(threshold=np.array([0.5, 2.0, 8.0]), inhibition=np.array([0.4, 0.2, 0.4]))
FASTEST = 5.0  # grey, FF of the invented walking


def record(nearness: np.ndarray, turning: np.ndarray | bool = False, **fields: np.ndarray) -> Record:
    """A walk by things as near as `nearness` (robots, frames, 2), steering hard to the left where it is `turning`."""
    robots, frames, _ = nearness.shape
    steering = np.broadcast_to(turning, (robots, frames))[..., None] * np.array([-0.8, 0.8])
    defaults = {
        "time": np.tile(np.arange(frames) / FRAME_RATE, (robots, 1)),
        "position": np.zeros((robots, frames, 3)),
        "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (robots, frames, 1)),
        "joints": np.zeros((robots, frames, 6, 3)),
        "u": np.full((robots, frames, 2), 0.5),
        "feed_forward": np.zeros((robots, frames, 2)),
        "excitation": np.zeros((robots, frames, 2)),
        "distances": 1 / nearness,
        "label": 1.2 + steering,
        "velocity": 1.2 + steering,
        "clearance": np.ones((robots, frames)),
        "contact": np.zeros((robots, frames), bool),
        "fresh": np.zeros((robots, frames), bool),
        "setbacks": np.zeros((robots, frames), int),
        "ok": np.ones((robots, frames), bool),
    }
    return Record(**{**defaults, **fields})


def passing(robots: int = 3, frames: int = 1800) -> np.ndarray:
    """Nearness [1/m] of things that come and go on either side, slowly beside a gait cycle."""
    time = np.arange(frames)[:, None] / FRAME_RATE
    phases = np.random.default_rng(4).uniform(0, 2 * np.pi, (robots, 1, 2))
    return 1.2 + np.sin(2 * np.pi * time / [13.0, 17.0] + phases)


def survey_of(nearness: np.ndarray, good: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """u that follows nearness for one candidate alone, with the sway of the gait on it; others are noise."""
    rng = np.random.default_rng(5)
    robots, frames, _ = nearness.shape
    sway = 1 + 0.8 * np.sin(2 * np.pi * 1.25 * np.arange(frames) / FRAME_RATE)[:, None]
    u = rng.uniform(0.5, 1.0, (robots, frames, 2, len(CANDIDATES.threshold)))
    u[..., good] = 0.5 + 0.1 * nearness * sway
    return u, rng.uniform(0, FASTEST, (robots, frames, 2))


@pytest.mark.parametrize("good", range(len(CANDIDATES.threshold)))
def test_the_threshold_that_tells_which_side_is_nearer_is_chosen(good):
    nearness = passing()
    choice = lgmd_grid_search.choose(record(nearness), *survey_of(nearness, good), CANDIDATES)
    assert (choice.threshold, choice.inhibition) == (CANDIDATES.threshold[good], CANDIDATES.inhibition[good])
    assert [row["threshold"] for row in choice.table] == CANDIDATES.threshold.tolist()
    scores = [row["score"] for row in choice.table]
    assert scores[good] > 0.9 and max(np.delete(scores, good)) < 0.3


def test_an_eye_that_looks_the_wrong_way_is_not_chosen():
    nearness = passing()
    u, feed_forward = survey_of(nearness)
    swapped = u.copy()
    swapped[..., 1] = swapped[:, :, ::-1, 1]
    choice = lgmd_grid_search.choose(record(nearness), swapped, feed_forward, CANDIDATES)
    assert choice.threshold != CANDIDATES.threshold[1]
    assert choice.table[1]["score"] < 0


def test_the_gate_is_left_open_by_walking_and_turning():
    nearness = passing()
    u, feed_forward = survey_of(nearness)
    turning = np.zeros(nearness.shape[:2], bool)
    turning[:, 600:900] = True
    feed_forward[turning] *= 4
    choice = lgmd_grid_search.choose(record(nearness, turning=turning), u, feed_forward, CANDIDATES)
    assert feed_forward.max() < choice.suppression < 2 * feed_forward.max()


@pytest.mark.parametrize("left_out", ["contact", "fresh", "not ok"])
def test_frames_that_are_no_walking_are_left_out(left_out):
    """Whatever the eyes say there, and near it: the choice is that of a walk that has no such frames."""
    nearness = passing()
    u, feed_forward = survey_of(nearness)
    bad = np.zeros(nearness.shape[:2], bool)
    bad[:, 600:900] = True
    walk = {
        "contact": record(nearness, contact=bad),
        "fresh": record(nearness, fresh=bad),
        "not ok": record(nearness, ok=~bad),
    }[left_out]
    alone = lgmd_grid_search.choose(walk, u, feed_forward, CANDIDATES)
    flooded = np.where(bad[..., None, None], 10.0 * nearness[..., ::-1, None], u)
    choice = lgmd_grid_search.choose(walk, flooded, np.where(bad[..., None], 200.0, feed_forward), CANDIDATES)
    assert choice.threshold == alone.threshold
    assert choice.suppression == alone.suppression < 2 * FASTEST
    for row, expected in zip(choice.table, alone.table, strict=True):
        assert row == pytest.approx(expected, abs=1e-6)


def test_too_little_walking_is_refused():
    nearness = passing(robots=1, frames=240)
    with pytest.raises(InputError, match=r"expected .* walking, got .* s; record longer walks"):
        lgmd_grid_search.choose(record(nearness), *survey_of(nearness), CANDIDATES)
    long = passing()
    with pytest.raises(InputError, match=r"got 0.0 s"):
        lgmd_grid_search.choose(record(long, fresh=np.ones(long.shape[:2], bool)), *survey_of(long), CANDIDATES)


def test_a_silent_eye_scores_nothing():
    """A threshold above all that is seen has no correlation; it must not be a NaN that wins."""
    nearness = passing()
    u, feed_forward = survey_of(nearness)
    u[..., 2] = 0.5
    choice = lgmd_grid_search.choose(record(nearness), u, feed_forward, CANDIDATES)
    assert choice.threshold == CANDIDATES.threshold[1]
    assert all(np.isfinite(list(row.values())).all() for row in choice.table)


def test_every_threshold_is_tried_with_every_weight():
    grid = lgmd_grid_search.grid([1.0, 2.0, 3.0], [0.2, 0.4])
    pairs = set(zip(grid.threshold.tolist(), grid.inhibition.tolist(), strict=True))
    assert pairs == {(t, w) for t in (1.0, 2.0, 3.0) for w in (0.2, 0.4)}


def test_survey_equals_the_detector_run_once_a_candidate():
    """Two robots, each in its own room with its own way, one of them by a box that moves, and once put down again."""
    eyes = camera.Params(width=32, height=24, overlap=0.6)
    still = arena.place([[0.8, -0.3], [1.2, 0.6]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    moving = arena.place([[1.0, 0.4]], 0.2, 0.8, goal=[[1.0, -0.4]], arrives=1.0)
    rooms = [arena.empty_room(boxes=boxes) for boxes in (still, moving)]
    arenas = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)
    steps = 0.02 * np.arange(8)[:, None] * np.array([[1.0, 0.1, 0.0], [0.9, -0.2, 0.0]])[:, None]
    fresh = np.zeros((2, 8), bool)
    fresh[0, 0] = fresh[1, 5] = True  # the eyes open on the first picture, whatever is recorded
    steps[1, 5:] += [-0.5, 0.3, 0.0]
    walk = replace(record(passing(2, 8), fresh=fresh), position=steps + np.array([0.0, 0.0, 0.11]))
    params = lgmd.Params()
    u, feed_forward = lgmd_grid_search.survey(params, eyes, arenas, walk, CANDIDATES)
    assert u.shape == (2, 8, 2, 3) and feed_forward.shape == (2, 8, 2)
    see = jax.jit(lgmd.step)
    for robot, pictures in enumerate(jnp.asarray(rerender.walks(eyes, arenas, walk))):
        for side in (hemifield.LEFT, hemifield.RIGHT):
            for k, pair in enumerate(zip(CANDIDATES.threshold, CANDIDATES.inhibition, strict=True)):
                detector = replace(params, threshold=pair[0], inhibition=pair[1], suppression=1e9)
                for frame, picture in enumerate(pictures[:, side]):
                    state = lgmd.init(detector, picture) if frame == 0 or fresh[robot, frame] else state
                    state, response = see(detector, state, picture)
                    here = robot, frame, side
                    np.testing.assert_allclose(u[*here, k], response.u, atol=1e-9)
                    np.testing.assert_allclose(feed_forward[here], response.feed_forward, atol=1e-9)
    assert np.all(np.ptp(np.asarray(u)[:, 1:5, :, 0], axis=1) > 0.001)  # there is something to see
    np.testing.assert_array_equal(u[1, 5], 0.5)
    assert np.all(feed_forward[1, 4] > 0) and not np.any(feed_forward[1, 5])
