"""Constants selected on synthetic walks with a known best pair; all candidates at once equal single detectors."""

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

pytestmark = pytest.mark.optimised

CANDIDATES = lgmd_grid_search.Candidates(threshold=np.array([0.5, 2.0, 8.0]), inhibition=np.array([0.4, 0.2, 0.4]))
MAX_FF = 5.0  # grey, largest FF of the synthetic walks


def record(proximity: np.ndarray, turning: np.ndarray | bool = False, **fields: np.ndarray) -> Record:
    """Return walks past obstacles of given proximity (robots, frames, 2), with a hard left turn where `turning`."""
    robots, frames, _ = proximity.shape
    steering = np.broadcast_to(turning, (robots, frames))[..., None] * np.array([-0.8, 0.8])
    defaults = {
        "time": np.tile(np.arange(frames) / FRAME_RATE, (robots, 1)),
        "position": np.zeros((robots, frames, 3)),
        "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (robots, frames, 1)),
        "joints": np.zeros((robots, frames, 6, 3)),
        "u": np.full((robots, frames, 2), 0.5),
        "feed_forward": np.zeros((robots, frames, 2)),
        "excitation": np.zeros((robots, frames, 2)),
        "distances": 1 / proximity,
        "corridor": 1 / proximity,
        "label": 1.2 + steering,
        "velocity": 1.2 + steering,
        "clearance": np.ones((robots, frames)),
        "contact": np.zeros((robots, frames), bool),
        "is_first": np.zeros((robots, frames), bool),
        "resets": np.zeros((robots, frames), int),
        "ok": np.ones((robots, frames), bool),
    }
    return Record(**{**defaults, **fields})


def passing(robots: int = 3, frames: int = 1800) -> np.ndarray:
    """Return the proximity [1/m] of obstacles on either side, which varies slowly compared with a gait cycle."""
    time = np.arange(frames)[:, None] / FRAME_RATE
    phases = np.random.default_rng(4).uniform(0, 2 * np.pi, (robots, 1, 2))
    return 1.2 + np.sin(2 * np.pi * time / [13.0, 17.0] + phases)


def responses(proximity: np.ndarray, good: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return u, which follows proximity with gait oscillation for one candidate and is noise for others, and FF."""
    rng = np.random.default_rng(5)
    robots, frames, _ = proximity.shape
    sway = 1 + 0.8 * np.sin(2 * np.pi * 1.25 * np.arange(frames) / FRAME_RATE)[:, None]
    u = rng.uniform(0.5, 1.0, (robots, frames, 2, len(CANDIDATES.threshold)))
    u[..., good] = 0.5 + 0.1 * proximity * sway
    return u, rng.uniform(0, MAX_FF, (robots, frames, 2))


@pytest.mark.parametrize("good", range(len(CANDIDATES.threshold)))
def test_the_candidate_that_follows_proximity_is_selected(good):
    proximity = passing()
    selection = lgmd_grid_search.select(record(proximity), *responses(proximity, good), CANDIDATES)
    assert (selection.threshold, selection.inhibition) == (CANDIDATES.threshold[good], CANDIDATES.inhibition[good])
    assert [row["threshold"] for row in selection.table] == CANDIDATES.threshold.tolist()
    scores = [row["score"] for row in selection.table]
    assert scores[good] > 0.9 and max(np.delete(scores, good)) < 0.3


def test_a_candidate_with_exchanged_eyes_is_not_selected():
    proximity = passing()
    u, feed_forward = responses(proximity)
    swapped = u.copy()
    swapped[..., 1] = swapped[:, :, ::-1, 1]
    selection = lgmd_grid_search.select(record(proximity), swapped, feed_forward, CANDIDATES)
    assert selection.threshold != CANDIDATES.threshold[1]
    assert selection.table[1]["score"] < 0


def test_walking_and_turning_do_not_cause_suppression():
    proximity = passing()
    u, feed_forward = responses(proximity)
    turning = np.zeros(proximity.shape[:2], bool)
    turning[:, 600:900] = True
    feed_forward[turning] *= 4
    selection = lgmd_grid_search.select(record(proximity, turning=turning), u, feed_forward, CANDIDATES)
    assert feed_forward.max() < selection.suppression < 2 * feed_forward.max()


@pytest.mark.parametrize("left_out", ["contact", "is_first", "not ok"])
def test_frames_without_walking_are_left_out(left_out):
    """Responses in and near such frames do not change the selection."""
    proximity = passing()
    u, feed_forward = responses(proximity)
    bad = np.zeros(proximity.shape[:2], bool)
    bad[:, 600:900] = True
    walk = {
        "contact": record(proximity, contact=bad),
        "is_first": record(proximity, is_first=bad),
        "not ok": record(proximity, ok=~bad),
    }[left_out]
    expected = lgmd_grid_search.select(walk, u, feed_forward, CANDIDATES)
    disturbed = np.where(bad[..., None, None], 10.0 * proximity[..., ::-1, None], u)
    selection = lgmd_grid_search.select(walk, disturbed, np.where(bad[..., None], 200.0, feed_forward), CANDIDATES)
    assert selection.threshold == expected.threshold
    assert selection.suppression == expected.suppression < 2 * MAX_FF
    for row, expected_row in zip(selection.table, expected.table, strict=True):
        assert row == pytest.approx(expected_row, abs=1e-6)


def test_too_little_walking_is_refused():
    proximity = passing(robots=1, frames=240)
    with pytest.raises(InputError, match=r"expected .* walking, got .* s; record longer walks"):
        lgmd_grid_search.select(record(proximity), *responses(proximity), CANDIDATES)
    long = passing()
    with pytest.raises(InputError, match=r"got 0.0 s"):
        lgmd_grid_search.select(record(long, is_first=np.ones(long.shape[:2], bool)), *responses(long), CANDIDATES)


def test_constant_responses_score_zero():
    """A threshold above all differences has no correlation, and must not win with NaN."""
    proximity = passing()
    u, feed_forward = responses(proximity)
    u[..., 2] = 0.5
    selection = lgmd_grid_search.select(record(proximity), u, feed_forward, CANDIDATES)
    assert selection.threshold == CANDIDATES.threshold[1]
    assert all(np.isfinite(list(row.values())).all() for row in selection.table)


def test_the_grid_combines_every_threshold_with_every_weight():
    grid = lgmd_grid_search.candidate_grid([1.0, 2.0, 3.0], [0.2, 0.4])
    pairs = set(zip(grid.threshold.tolist(), grid.inhibition.tolist(), strict=True))
    assert pairs == {(t, w) for t in (1.0, 2.0, 3.0) for w in (0.2, 0.4)}


def test_all_candidates_at_once_equal_one_detector_for_each():
    """Two robots in different rooms; one passes a moving box and is reset once."""
    camera_params = camera.Params(width=32, height=24, overlap=0.6)
    still = arena.make_prisms([[0.8, -0.3], [1.2, 0.6]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    moving = arena.make_prisms([[1.0, 0.4]], 0.2, 0.8, goal=[[1.0, -0.4]], arrives=1.0)
    rooms = [arena.empty_room(boxes=boxes) for boxes in (still, moving)]
    arenas = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)
    steps = 0.02 * np.arange(8)[:, None] * np.array([[1.0, 0.1, 0.0], [0.9, -0.2, 0.0]])[:, None]
    is_first = np.zeros((2, 8), bool)
    is_first[0, 0] = is_first[1, 5] = True  # detectors start on the first frame, whatever is recorded
    steps[1, 5:] += [-0.5, 0.3, 0.0]
    walk = replace(record(passing(2, 8), is_first=is_first), position=steps + np.array([0.0, 0.0, 0.11]))
    params = lgmd.Params()
    u, feed_forward = lgmd_grid_search.evaluate(params, camera_params, arenas, walk, CANDIDATES)
    assert u.shape == (2, 8, 2, 3) and feed_forward.shape == (2, 8, 2)
    step = jax.jit(lgmd.step)
    for robot, images in enumerate(jnp.asarray(rerender.render_walks(camera_params, arenas, walk))):
        for side in (hemifield.LEFT, hemifield.RIGHT):
            for k, pair in enumerate(zip(CANDIDATES.threshold, CANDIDATES.inhibition, strict=True)):
                detector = replace(params, threshold=pair[0], inhibition=pair[1], suppression=1e9)
                for frame, image in enumerate(images[:, side]):
                    state = lgmd.init(detector, image) if frame == 0 or is_first[robot, frame] else state
                    state, response = step(detector, state, image)
                    here = robot, frame, side
                    np.testing.assert_allclose(u[*here, k], response.u, atol=1e-9)
                    np.testing.assert_allclose(feed_forward[here], response.feed_forward, atol=1e-9)
    assert np.all(np.ptp(np.asarray(u)[:, 1:5, :, 0], axis=1) > 0.001)  # u varies
    np.testing.assert_array_equal(u[1, 5], 0.5)
    assert np.all(feed_forward[1, 4] > 0) and not np.any(feed_forward[1, 5])
