"""Vehicles and eq. 22 as printed, and a teacher that stays in the range of the gait and turns in front of a wall."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import braitenberg as reference

from lgmdjax.control import braitenberg
from lgmdjax.errors import InputError

PARAMS = braitenberg.Params()
PAPER = replace(PARAMS, base=1.2)
distances = st.tuples(st.floats(0.02, 5.0), st.floats(0.02, 5.0))
step = jax.jit(braitenberg.step)
rule = jax.jit(braitenberg.rule)
no_deadline = settings(deadline=None)  # the first example compiles


def teach(d, side=0.0, params=PARAMS):
    """One step from a turn to `side`; the next side, and the velocity as NumPy."""
    state, velocity = step(params, braitenberg.State(side=jnp.asarray(side)), jnp.asarray(d))
    return float(state.side), np.asarray(velocity)


@pytest.mark.parametrize("name", ["vehicle_2a", "vehicle_2b", "vehicle_3a", "vehicle_3b"])
def test_vehicles_equal_the_paper(strict, name):
    expected = getattr(reference, name)(0.3, 0.9, 1.2, 0.7)
    np.testing.assert_allclose(getattr(braitenberg, name)(jnp.asarray([0.3, 0.9]), 1.2, 0.7), expected)


@no_deadline
@given(distances)
def test_rule_equals_eq_22_and_never_retreats(d):
    """The sum is 2 v_base + (k_2a - k_3b)(1/d_l + 1/d_r) > 0: one side always goes forward."""
    velocity = rule(PAPER, jnp.asarray(d))
    np.testing.assert_allclose(velocity, reference.rule(*d), rtol=1e-6, atol=1e-6)
    assert max(velocity) > 0


@no_deadline
@given(distances, st.sampled_from([-1.0, 0.0, 1.0]))
def test_teacher_stays_in_the_range_of_the_gait(d, side):
    after, velocity = teach(d, side)
    assert np.all(velocity >= -1 - 1e-9) and np.all(velocity <= 2 + 1e-9)
    assert after in (-1, 0, 1)


@no_deadline
@given(distances, st.sampled_from([-1.0, 0.0, 1.0]))
def test_mirrored_distances_give_the_mirrored_velocity(d, side):
    """The default side is mirrored too; only an exact tie before any turn uses it."""
    after, velocity = teach(d, side)
    mirrored, swapped = teach(d[::-1], -side, replace(PARAMS, default_side=-1.0))
    np.testing.assert_allclose(swapped, velocity[::-1], atol=1e-9)
    assert mirrored == -after


@settings(max_examples=200, deadline=None)
@given(st.tuples(st.floats(-3, 5), st.floats(-3, 5)))
def test_limit_keeps_the_turn_rather_than_the_speed(velocity):
    """Inside the range nothing changes. Outside, the turn is kept up to the widest, and the mean moves least."""
    limited = np.asarray(braitenberg.limit(PARAMS, jnp.asarray(velocity)))
    turn = velocity[1] - velocity[0]
    np.testing.assert_allclose(limited[1] - limited[0], np.clip(turn, -3, 3), atol=1e-9)
    assert limited.min() >= -1 - 1e-9 and limited.max() <= 2 + 1e-9
    if min(velocity) >= -1 and max(velocity) <= 2:
        np.testing.assert_allclose(limited, velocity, atol=1e-9)
    elif abs(turn) < 3:  # shifted no further than to the edge of the range
        assert np.isclose(limited.max(), 2) or np.isclose(limited.min(), -1)


def test_what_is_in_the_way_counts_more_than_what_is_near():
    """The nearness that the rule gets is a weighted mean; weight 0 is the paper's, d alone."""
    nearest, corridor = jnp.asarray([0.4, 1.5]), jnp.asarray([5.0, 1.5])
    found = braitenberg.sensed_distances(replace(PARAMS, corridor=0.8), nearest, corridor)
    np.testing.assert_allclose(found, [1 / (0.8 / 5 + 0.2 / 0.4), 1.5])
    for weight, expected in ((0.0, nearest), (1.0, corridor)):
        found = braitenberg.sensed_distances(replace(PARAMS, corridor=weight), nearest, corridor)
        np.testing.assert_allclose(found, expected)


def test_before_a_wall_it_turns_away_from_the_nearer_side():
    """The way is equally closed on both sides, and a second wall is beside it: the first turn is away from that."""
    corridor = jnp.asarray([0.7, 0.7])
    for nearest, side in (((0.35, 0.7), -1), ((0.7, 0.35), 1)):
        sensed = braitenberg.sensed_distances(PARAMS, jnp.asarray(nearest), corridor)
        after, (left, right) = teach(sensed)
        assert after == side and (right - left) * side > 0.3


def test_beside_a_wall_it_goes_on():
    """A wall at 0.35 m, along which the way is free, hardly turns it; the paper's rule turns away hard."""
    nearest, corridor = jnp.asarray([0.35, 5.0]), jnp.asarray([5.0, 5.0])
    turns = []
    for weight in (PARAMS.corridor, 0.0):
        velocity = teach(braitenberg.sensed_distances(replace(PARAMS, corridor=weight), nearest, corridor))[1]
        turns.append(velocity[0] - velocity[1])
    assert 0 < turns[0] < 0.8 and turns[1] == pytest.approx(3)


def test_without_minimum_turn_and_tie_break_the_teacher_is_the_limited_rule():
    plain = replace(PARAMS, full_turn=0.0, tie_tolerance=0.0)
    for d in ((0.4, 2.0), (1.0, 1.3), (0.3, 0.31), (5.0, 5.0)):
        expected = braitenberg.limit(PARAMS, rule(PARAMS, jnp.asarray(d)))
        np.testing.assert_allclose(teach(d, -1.0, plain)[1], expected, atol=1e-9)


@no_deadline
@given(st.tuples(st.floats(0.95, 5.0), st.floats(0.95, 5.0)))
def test_far_from_obstacles_the_teacher_is_eq_22(d):
    expected = braitenberg.limit(PARAMS, rule(PARAMS, jnp.asarray(d)))
    np.testing.assert_allclose(teach(d, 1.0)[1], expected, atol=1e-9)


def test_turns_away_from_the_nearer_side_and_harder_the_nearer_it_is():
    turns = []
    for d in (2.0, 1.2, 0.8, 0.5):
        _, (left, right) = teach((5.0, d))
        assert right > left, "it turns left, away from an obstacle on the right"
        turns.append(right - left)
    assert turns == sorted(turns)


def test_in_front_of_a_wall_it_turns_and_keeps_its_direction():
    """With both sides equally near eq. 22 accelerates; the teacher turns hard, always in the same direction."""
    raw = np.asarray(rule(PARAMS, jnp.asarray([0.4, 0.4])))
    assert raw[0] == raw[1] > 1.2
    for side in (1.0, -1.0):
        for d in ((0.4, 0.4), (0.4, 0.42), (0.42, 0.4), (0.55, 0.5)):
            after, (left, right) = teach(d, side)
            assert after == side
            assert (right - left) * side >= 2
    after, (left, right) = teach((0.4, 0.4))
    assert after == PARAMS.default_side and right > left


def test_a_tie_is_broken_by_the_present_turn():
    """After a right turn of any policy it turns right again, although the left side is slightly farther away."""
    for velocity, side in (([2.0, -1.0], -1), ([-1.0, 2.0], 1), ([1.2, 1.3], 0)):
        assert braitenberg.track_turn(PARAMS, jnp.asarray(velocity)).side == side
    _, velocity = step(PARAMS, braitenberg.track_turn(PARAMS, jnp.asarray([2.0, 0.5])), jnp.asarray([0.42, 0.4]))
    assert velocity[0] - velocity[1] > 2


def test_a_clearly_nearer_side_reverses_the_turn():
    after, (left, right) = teach((0.4, 0.9), side=1.0)
    assert after == -1 and left - right >= 2


def test_far_from_obstacles_no_side_is_chosen():
    """Otherwise a robot and its mirror image would turn to the same side before they meet an obstacle."""
    assert teach((5.0, 5.0))[0] == 0
    np.testing.assert_allclose(teach((5.0, 5.0))[1], 1.3 + 0.2 / 5, rtol=1e-6)


def test_gradients_are_finite_even_at_distance_zero(precision, strict):
    def velocity_sum(params, d):
        return braitenberg.step(params, braitenberg.init(params), d)[1].sum()

    gradient = jax.jit(jax.grad(velocity_sum, argnums=(0, 1)))
    for d in ([0.0, 0.0], [0.7, 0.7], [0.7, 0.9], [5.0, 5.0]):
        gradients = gradient(PARAMS, jnp.asarray(d))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))


@pytest.mark.parametrize(
    "wrong",
    [
        {"base": float("nan")},
        {"gain_2a": -0.1},
        {"min_velocity": 2.5},
        {"full_turn_distance": 1.5},
        {"default_side": 0.0},
    ],
)
def test_invalid_numbers_are_refused(wrong):
    braitenberg.check(PARAMS)
    with pytest.raises(InputError, match=f"braitenberg {next(iter(wrong))}: expected"):
        braitenberg.check(replace(PARAMS, **wrong))
