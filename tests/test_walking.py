"""The robot walks: rhythm, packaged networks and body together, in C MuJoCo and in MJX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import walking as reference
from scipy.spatial.transform import Rotation

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.locomotion import cpg, gait_fit, shaping, tripod_gait

STEP = 1 / 180
CYCLE = round(cpg.CYCLE_TIME / STEP)


@jax.jit
def course(networks, velocities, start):
    """Servo targets over time, (steps, 6, 3), for commands (steps, 2)."""

    def beat(state, velocity):
        state, rhythm = cpg.step(cpg.Params(), state, STEP)
        return state, shaping.shape(networks, rhythm, velocity)

    return jax.lax.scan(beat, start, velocities)[1]


def targets(left, right, seconds=11.0, networks=None, start=None):
    commands = jnp.tile(jnp.array([left, right], dtype=float), (round(seconds / STEP), 1))
    return course(networks or shaping.taught(), commands, start or cpg.settled(cpg.Params()))


@pytest.fixture(scope="module")
def straight():
    return reference.walk(targets(1.0, 1.0, seconds=20.0))


def test_nominal_speed_within_five_percent(straight):
    assert straight.speed == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("v", [0.5, 1.2, 2.0])
def test_speed_follows_the_command_within_ten_percent(v):
    assert reference.walk(targets(v, v)).speed == pytest.approx(0.05 * v, rel=0.1)


def test_heading_keeps_in_twenty_seconds(straight):
    assert np.abs(straight.yaw).max() < 5.0
    assert abs(straight.position[-1, 1]) < 0.02


def test_trunk_hardly_sways(straight):
    """RMS over whole cycles: a tenth of a degree is a fifth of a pixel of the eyes."""
    whole = slice(-20 * CYCLE, None)
    assert np.std(straight.roll[whole]) < 0.1
    assert np.std(straight.pitch[whole]) < 0.1
    assert np.std(straight.yaw[whole]) < 0.15
    assert np.std(straight.position[whole, 2]) < 0.0005


def test_feet_hold_the_floor_and_swing_clear_of_it(straight):
    for foot in range(6):
        trail = straight.feet[-5 * CYCLE :, foot]
        rise = trail[:, 2] - trail[:, 2].min()
        speed = np.abs(np.gradient(trail[:, 0], STEP))
        standing = rise < 0.0015
        assert 0.4 < standing.mean() < 0.7
        assert np.median(speed[standing]) < straight.speed / 3
        assert rise.max() > 0.012


def test_turns_on_the_spot_left_and_right():
    left, right = (reference.walk(targets(*v)) for v in ((-1.0, 1.0), (1.0, -1.0)))
    assert left.yaw_rate > 0.12 and right.yaw_rate < -0.12
    assert left.yaw_rate == pytest.approx(-right.yaw_rate, rel=0.02)
    assert abs(left.speed) < 0.01
    for walk in (left, right):
        assert np.abs(walk.position[-1, :2]).max() < 0.1


def test_bends_towards_the_slower_side():
    gentle, sharp = (reference.walk(targets(*v)) for v in ((0.9, 1.5), (-1.0, 2.0)))
    assert 0.03 < gentle.yaw_rate < sharp.yaw_rate
    assert gentle.speed == pytest.approx(0.06, rel=0.1)
    assert sharp.yaw_rate > 0.2


def test_walks_backward():
    walk = reference.walk(targets(-1.0, -1.0))
    assert -0.06 < walk.speed < -0.03
    assert np.abs(walk.yaw).max() < 5.0


def test_keeps_level_while_the_command_jumps_every_frame():
    frames = jax.random.uniform(jax.random.key(7), (300, 2), minval=shaping.SLOWEST, maxval=shaping.FASTEST)
    jumping = course(shaping.taught(), jnp.repeat(frames, 6, axis=0), cpg.settled(cpg.Params()))
    walk = reference.walk(jumping)
    assert np.abs(walk.roll).max() < 4.0 and np.abs(walk.pitch).max() < 4.0
    assert walk.position[:, 2].min() > 0.09


def test_walks_after_a_random_start_of_the_rhythm():
    start = cpg.init(cpg.Params(), jax.random.key(11))
    walk = reference.walk(targets(1.0, 1.0, seconds=26.0, start=start), settled=18.0)
    assert walk.speed == pytest.approx(0.05, rel=0.05)
    assert walk.position[:, 2].min() > 0.08


def test_the_papers_input_hardly_walks():
    geometry = tripod_gait.geometry(hexapod.load())
    networks = gait_fit.teach(geometry, steps=300, candidates=6, literal=True)
    assert abs(reference.walk(targets(1.0, 1.0, networks=networks)).speed) < 0.012


@pytest.mark.slow
def test_mjx_walks_as_mujoco_does():
    """The same targets for three seconds: the same way, turn and sway, step for step."""
    model, commands = hexapod.build(hexapod.load()), ((1.0, 1.0), (-1.0, 1.0), (2.0, 2.0))
    courses = jnp.stack([targets(*v, seconds=3.0) for v in commands])
    for walk, course in zip(gait_test.walk_mjx(model, courses), courses, strict=True):
        theirs = reference.walk(course, settled=1.0)
        turned = Rotation.from_quat(np.repeat(walk.quaternion[:, [1, 2, 3, 0]], 6, axis=0))
        feet = walk.position[:, None] + turned.apply(walk.feet.reshape(-1, 3)).reshape(walk.feet.shape)
        ours = reference.measured(np.hstack([walk.position, walk.quaternion]), feet, STEP, 1.0)
        assert ours.speed == pytest.approx(theirs.speed, abs=0.001)
        assert ours.yaw_rate == pytest.approx(theirs.yaw_rate, abs=0.002)
        np.testing.assert_allclose(ours.position, theirs.position, atol=0.001)
        np.testing.assert_allclose(ours.feet, theirs.feet, atol=0.002)
        np.testing.assert_allclose(ours.yaw, theirs.yaw, atol=0.3)
