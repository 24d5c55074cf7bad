"""Walking: rhythm, default shaping networks and body in open loop, in C MuJoCo and in MJX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import walking as reference
from scipy.spatial.transform import Rotation

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping

pytestmark = pytest.mark.optimised

STEP = 1 / 180
CYCLE = round(cpg.CYCLE_TIME / STEP)


@jax.jit
def servo_targets(networks, velocities, start):
    """Return servo targets (steps, 6, 3) for commands (steps, 2)."""

    def step(state, velocity):
        state, rhythm = cpg.step(cpg.Params(), state, STEP)
        return state, shaping.apply(networks, rhythm, velocity)

    return jax.lax.scan(step, start, velocities)[1]


def constant_targets(left, right, duration=11.0, networks=None, start=None):
    """Return servo targets for a constant command."""
    commands = jnp.tile(jnp.array([left, right], dtype=float), (round(duration / STEP), 1))
    return servo_targets(networks or shaping.load_pretrained(), commands, start or cpg.limit_cycle_state(cpg.Params()))


@pytest.fixture(scope="module")
def straight():
    return reference.simulate(constant_targets(1.0, 1.0, duration=20.0))


def test_nominal_speed_within_five_percent(straight):
    assert straight.speed == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("v", [0.5, 1.2, 2.0])
def test_speed_follows_the_command_within_ten_percent(v):
    assert reference.simulate(constant_targets(v, v)).speed == pytest.approx(0.05 * v, rel=0.1)


def test_heading_is_kept_for_twenty_seconds(straight):
    assert np.abs(straight.yaw).max() < 5.0
    assert abs(straight.position[-1, 1]) < 0.02


def test_trunk_sway_is_small(straight):
    """RMS over whole cycles: a tenth of a degree is a fifth of a pixel of the eyes."""
    cycles = slice(-20 * CYCLE, None)
    assert np.std(straight.roll[cycles]) < 0.1
    assert np.std(straight.pitch[cycles]) < 0.1
    assert np.std(straight.yaw[cycles]) < 0.15
    assert np.std(straight.position[cycles, 2]) < 0.0005


def test_feet_do_not_slip_in_stance_and_clear_the_floor_in_swing(straight):
    for foot in range(6):
        positions = straight.feet[-5 * CYCLE :, foot]
        height = positions[:, 2] - positions[:, 2].min()
        speed = np.abs(np.gradient(positions[:, 0], STEP))
        in_stance = height < 0.0015
        assert 0.4 < in_stance.mean() < 0.7
        assert np.median(speed[in_stance]) < straight.speed / 3
        assert height.max() > 0.012


def test_turns_on_the_spot_left_and_right():
    left, right = (reference.simulate(constant_targets(*v)) for v in ((-1.0, 1.0), (1.0, -1.0)))
    assert left.yaw_rate > 0.12 and right.yaw_rate < -0.12
    assert left.yaw_rate == pytest.approx(-right.yaw_rate, rel=0.02)
    assert abs(left.speed) < 0.01
    for walk in (left, right):
        assert np.abs(walk.position[-1, :2]).max() < 0.1


def test_curves_towards_the_slower_side():
    gentle, sharp = (reference.simulate(constant_targets(*v)) for v in ((0.9, 1.5), (-1.0, 2.0)))
    assert 0.03 < gentle.yaw_rate < sharp.yaw_rate
    assert gentle.speed == pytest.approx(0.06, rel=0.1)
    assert sharp.yaw_rate > 0.2


def test_walks_backward():
    walk = reference.simulate(constant_targets(-1.0, -1.0))
    assert -0.06 < walk.speed < -0.03
    assert np.abs(walk.yaw).max() < 5.0


def test_trunk_stays_level_while_the_command_changes_every_frame():
    frames = jax.random.uniform(jax.random.key(7), (300, 2), minval=shaping.MIN_VELOCITY, maxval=shaping.MAX_VELOCITY)
    jumping = servo_targets(
        shaping.load_pretrained(), jnp.repeat(frames, 6, axis=0), cpg.limit_cycle_state(cpg.Params())
    )
    walk = reference.simulate(jumping)
    assert np.abs(walk.roll).max() < 4.0 and np.abs(walk.pitch).max() < 4.0
    assert walk.position[:, 2].min() > 0.09


def test_walks_after_a_random_initial_state_of_the_cpg():
    start = cpg.init(cpg.Params(), jax.random.key(11))
    walk = reference.simulate(constant_targets(1.0, 1.0, duration=26.0, start=start), settled=18.0)
    assert walk.speed == pytest.approx(0.05, rel=0.05)
    assert walk.position[:, 2].min() > 0.08


def test_shaping_fitted_with_the_papers_input_hardly_walks():
    geometry = kinematics.read_geometry(hexapod.load())
    networks = gait_fit.fit(geometry, steps=300, candidates=6, printed_input=True)
    assert abs(reference.simulate(constant_targets(1.0, 1.0, networks=networks)).speed) < 0.012


@pytest.mark.slow
def test_mjx_walks_like_c_mujoco():
    """The same targets for three seconds give the same path, heading and sway in every step."""
    model, commands = hexapod.build(hexapod.load()), ((1.0, 1.0), (-1.0, 1.0), (2.0, 2.0))
    targets = jnp.stack([constant_targets(*v, duration=3.0) for v in commands])
    for walk, rows in zip(gait_test.simulate_mjx(model, targets), targets, strict=True):
        theirs = reference.simulate(rows, settled=1.0)
        rotation = Rotation.from_quat(np.repeat(walk.quaternion[:, [1, 2, 3, 0]], 6, axis=0))
        feet = walk.position[:, None] + rotation.apply(walk.feet.reshape(-1, 3)).reshape(walk.feet.shape)
        ours = reference.summarise(np.hstack([walk.position, walk.quaternion]), feet, STEP, 1.0)
        assert ours.speed == pytest.approx(theirs.speed, abs=0.001)
        assert ours.yaw_rate == pytest.approx(theirs.yaw_rate, abs=0.002)
        np.testing.assert_allclose(ours.position, theirs.position, atol=0.001)
        np.testing.assert_allclose(ours.feet, theirs.feet, atol=0.002)
        np.testing.assert_allclose(ours.yaw, theirs.yaw, atol=0.3)
