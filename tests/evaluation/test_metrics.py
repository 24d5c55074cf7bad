"""Metrics of walks with known results, and intervals against published tables and simulation."""

import numpy as np
import pytest
from synthetic import walk

from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics

CYCLE = 1.0
SPEED, FRAMES = 0.05, 1200


def test_sway_does_not_count_as_distance():
    result = metrics.score(walk(), CYCLE)
    assert result.distance == pytest.approx(2 * SPEED * FRAMES / 30, rel=0.02)
    assert result.speed == pytest.approx(SPEED, rel=0.02)


def test_a_reset_adds_no_distance_and_a_contact_counts_once():
    record = walk(1)
    contact, resets, position = (np.array(x) for x in (record.contact, record.resets, record.position))
    contact[0, 600] = True
    resets[0, 601:] = 1
    position[0, 601:, 0] += 3.0  # lifted 3 m ahead
    result = metrics.score(walk(1, contact=contact, resets=resets, position=position), CYCLE)
    assert result.collisions == 1
    assert result.distance == pytest.approx(SPEED * FRAMES / 30, rel=0.05)
    assert result.first_collision.value == pytest.approx(SPEED * 20, rel=0.05)
    assert result.per_100_m.value == pytest.approx(100 / result.distance)


def test_frames_after_a_fall_do_not_count():
    ok = np.ones((2, FRAMES), bool)
    ok[1, 300:] = False
    contact = np.zeros((2, FRAMES), bool)
    contact[1, 900] = True
    result = metrics.score(walk(2, ok=ok, contact=contact), CYCLE)
    assert (result.lost, result.collisions) == (1, 0)
    assert result.distance == pytest.approx(SPEED * (40 + 10), rel=0.02)


def test_walks_without_distance_are_an_input_error():
    with pytest.raises(InputError, match="distance"):
        metrics.score(walk(1, ok=np.zeros((1, FRAMES), bool)), CYCLE)


@pytest.mark.parametrize(("count", "low", "high"), [(0, 0.0, 3.689), (1, 0.0253, 5.572), (10, 4.795, 18.390)])
def test_poisson_interval_matches_the_published_table(count, low, high):
    """Garwood's limits as tabulated in Ulm (1990)."""
    estimate = metrics.poisson_rate(count, 1.0)
    assert (estimate.low, estimate.high) == (pytest.approx(low, abs=1e-3), pytest.approx(high, abs=1e-3))


def test_bootstrap_covers_the_mean_at_about_its_confidence():
    rng = np.random.default_rng(0)
    intervals = [metrics.bootstrap_mean(rng.exponential(1.0, 40)) for _ in range(100)]
    covered = sum(interval.low <= 1.0 <= interval.high for interval in intervals)
    assert 82 <= covered <= 100


@pytest.mark.parametrize(("count", "low", "high"), [(15, 0.7961, 1.0), (0, 0.0, 0.2039), (7, 0.2481, 0.6988)])
def test_wilson_interval_matches_its_formula(count, low, high):
    """Wilson's limits for n = 15, worked out by hand from (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n)."""
    estimate = metrics.wilson_proportion(count, 15)
    assert (estimate.low, estimate.high) == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))


def test_yaw_rate_of_a_turning_robot():
    yaw = np.broadcast_to(0.2 * np.arange(FRAMES) / 30.0, (1, FRAMES))
    quaternion = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
    rates = metrics.yaw_rates(walk(1, quaternion=quaternion), CYCLE)
    assert np.allclose(rates[0, 60:-60], 0.2, atol=1e-3)


def aside() -> np.ndarray:
    """Return the positions of a synthetic walk beside the border between two rows of cells, not on it."""
    return np.asarray(walk(1).position) + np.array([0.0, 0.1, 0.0])


def headings(yaw: np.ndarray) -> np.ndarray:
    """Return quaternions w x y z of headings [rad] of one robot."""
    return np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)[None]


def test_a_straight_walk_enters_a_new_cell_every_quarter_of_a_metre():
    found = metrics.progress(walk(1, position=aside()), CYCLE)
    assert found.coverage.value == pytest.approx(SPEED * 60 / metrics.CELL)
    assert found.hard_turning.value == found.net_rotation.value == found.longest_rotation == 0


def test_a_reset_begins_a_new_count_of_cells():
    there_and_back = np.concatenate([np.linspace(0, 1.9, FRAMES // 2), np.linspace(1.9, 0, FRAMES // 2)])
    position = np.zeros((1, FRAMES, 3))
    position[0, :, 0] = there_and_back
    once = metrics.count_cells(walk(1, position=position), CYCLE)
    resets = np.zeros((1, FRAMES), int)
    resets[0, FRAMES // 2 :] = 1
    twice = metrics.count_cells(walk(1, position=position, resets=resets), CYCLE)
    assert (once[0], twice[0]) == (8, 16)


def test_a_robot_that_turns_on_the_spot_makes_no_progress():
    """It has no collision, and everything else tells that it does not go on."""
    yaw = 0.2 * np.arange(FRAMES) / 30.0
    position = np.broadcast_to([0.1, 0.1, 0.1], (1, FRAMES, 3))
    found = metrics.progress(walk(1, position=position, quaternion=headings(yaw)), CYCLE)
    assert found.coverage.value == pytest.approx(60 / 40)  # the cell in which it stands
    assert found.hard_turning.value > 0.98  # but for the ends of the average
    assert found.longest_rotation == pytest.approx(yaw[-1] / (2 * np.pi), rel=0.02)


def test_turns_to_either_side_are_no_net_rotation():
    time = np.arange(FRAMES) / 30.0
    found = metrics.progress(walk(1, quaternion=headings(np.sin(0.25 * time))), CYCLE)
    assert found.longest_rotation == pytest.approx(2 / (2 * np.pi), rel=0.02)
    assert 0.4 < found.hard_turning.value < 0.8  # |0.25 cos| > 0.15 in 59 % of the time
    assert found.hard_turning.value == pytest.approx(2 * np.arccos(0.6) / np.pi, abs=0.03)


def test_frames_after_a_fall_are_no_progress():
    ok = np.ones((2, FRAMES), bool)
    ok[1, 300:] = False
    whole, half = metrics.count_cells(walk(2, ok=ok, position=np.repeat(aside(), 2, axis=0)), CYCLE)
    assert (whole, half) == (8, 2)
    ok[:] = False
    with pytest.raises(InputError, match="frames"):
        metrics.progress(walk(2, ok=ok), CYCLE)
