"""Tripod gait and its fit: the foot path, load, servo targets, and the fitted networks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping, tripod_gait
from lgmdjax.runtime import tracking

TRIPODS = np.array([0.0, 0.5, 0.0, 0.5, 0.0, 0.5])
VELOCITIES = np.linspace(shaping.MIN_VELOCITY, shaping.MAX_VELOCITY, 7)


@pytest.fixture(scope="module")
def body():
    return hexapod.load()


@pytest.fixture(scope="module")
def geometry(body):
    return kinematics.read_geometry(body)


@pytest.fixture(scope="module")
def fitted(geometry):
    """Fit networks in 300 steps, a twentieth of those of the pretrained networks; return them and the losses."""
    losses = []
    logged = []
    with tracking.add_listener(lambda step, values: logged.append((step, values["shaping/loss_mm2"]))):
        networks = gait_fit.fit(geometry, steps=300, candidates=6, progress=lambda *progress: losses.append(progress))
    assert logged == losses
    return networks, losses


def test_a_standing_foot_moves_backward_at_constant_speed():
    gait = tripod_gait.Gait()
    phase = jnp.linspace(0.0, gait.duty_factor - 1e-6, 50)
    for v in VELOCITIES:
        path = tripod_gait.foot_path(gait, phase, jnp.full(50, v))
        speed = np.gradient(path[:, 0], phase * gait.cycle_time)
        np.testing.assert_allclose(speed, -0.05 * v * gait.stride_gain, atol=1e-9)
        np.testing.assert_allclose(path[:, 1:], 0.0, atol=1e-9)


def test_a_swinging_foot_moves_forward_above_the_floor_and_lands_softly():
    gait = tripod_gait.Gait()
    phase = jnp.linspace(gait.duty_factor, 1.0, 200)
    path = tripod_gait.foot_path(gait, phase, jnp.ones(200))
    assert path[-1, 0] - path[0, 0] == pytest.approx(0.05 * gait.stride_gain * 0.8 * gait.duty_factor)
    assert np.max(path[:, 2]) == pytest.approx(gait.swing_height, rel=1e-3)
    assert np.all(path[:, 2] >= 0)
    vertical = np.gradient(path[:, 2], phase)
    assert abs(vertical[-1]) < 0.05 * np.abs(vertical).max()


def test_the_path_is_closed_and_smooth_over_the_cycle():
    gait = tripod_gait.Gait()
    phase = jnp.linspace(0.0, 1.0, 20_001)
    for v in VELOCITIES:
        path = np.asarray(tripod_gait.foot_path(gait, phase, jnp.full(phase.shape, v)))
        np.testing.assert_allclose(path[0], path[-1], atol=1e-9)
        velocity = np.diff(np.concatenate([path, path[1:3]]), axis=0) * 20_000
        assert np.abs(np.diff(velocity, axis=0)).max() < 0.01 * np.abs(velocity).max()


def test_the_stride_is_proportional_to_the_velocity():
    gait, phase = tripod_gait.Gait(), jnp.array([0.0, 0.3, 0.7, 0.9])
    one = tripod_gait.foot_path(gait, phase, jnp.ones(4))
    for v in VELOCITIES:
        path = tripod_gait.foot_path(gait, phase, jnp.full(4, v))
        np.testing.assert_allclose(path[:, 0], v * one[:, 0], atol=1e-12)
        np.testing.assert_allclose(path[:, 2], one[:, 2])  # it steps on the spot at v = 0


def test_the_load_of_a_tripod_is_in_equilibrium():
    gait = tripod_gait.Gait()
    middle_of_stance, x = jnp.where(TRIPODS == 0, 0.27, 0.77), jnp.full(6, 0.02)
    share = np.asarray(tripod_gait.load_share(gait, middle_of_stance, x))
    feet = np.asarray(tripod_gait.neutral_feet(gait))[::2, :2] + np.array([0.02, 0.0])
    np.testing.assert_allclose(share[1::2], 0.0)
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(share[::2] @ feet, 0.0, atol=1e-12)  # no moment about the trunk's centre


def test_the_loads_always_sum_to_the_weight():
    phase = jnp.linspace(0.0, 1.0, 201)[:, None] + TRIPODS
    share = tripod_gait.load_share(tripod_gait.Gait(), phase, jnp.zeros((201, 6)))
    np.testing.assert_allclose(share.sum(axis=1), 1.0, atol=1e-12)
    assert np.abs(np.diff(share, axis=0)).max() < 0.1


def test_joint_targets_are_within_the_joint_ranges_and_symmetric(body, geometry):
    phase = jnp.linspace(0.0, 1.0, 41)[:, None, None] + jnp.zeros((41, 7, 6))
    velocity = jnp.asarray(VELOCITIES)[None, :, None] + jnp.zeros((41, 7, 6))
    angles = np.asarray(tripod_gait.joint_targets(geometry, tripod_gait.Gait(), phase, velocity))
    low, high = body.jnt_range[1:].reshape(6, 3, 2).transpose(2, 0, 1)
    assert np.all((angles > low) & (angles < high))
    np.testing.assert_allclose(angles[..., ::-1, :] * np.array([-1, 1, 1]), angles, atol=1e-9)


def test_joint_targets_compensate_for_lag_and_load(geometry):
    """Without lag and weight they give the path itself; the lag shifts them in time, the weight lowers the feet."""
    gait, phase = tripod_gait.Gait(), jnp.full(6, 0.27)
    bare = geometry.replace(lag=0.0, weight=0.0)
    feet = kinematics.forward(geometry, tripod_gait.joint_targets(bare, gait, phase, jnp.ones(6)))
    neutral = tripod_gait.neutral_feet(gait)
    np.testing.assert_allclose(feet - neutral, tripod_gait.foot_path(gait, phase, jnp.ones(6)), atol=1e-9)
    loaded = kinematics.forward(geometry, tripod_gait.joint_targets(geometry, gait, phase, jnp.ones(6)))
    assert np.all(loaded[:, 2] < feet[:, 2] - 1e-4)
    early = kinematics.forward(geometry, tripod_gait.joint_targets(bare.replace(lag=0.01), gait, phase, jnp.ones(6)))
    np.testing.assert_allclose(early[:, 0] - feet[:, 0], -0.01 * 0.05 * gait.stride_gain, rtol=0.02)


def test_limit_cycle_rhythm_does_not_depend_on_the_cycle_time():
    phases = np.arange(8) / 8
    rhythm = gait_fit.limit_cycle_rhythm(cpg.Params(), phases)
    assert rhythm[0, 0] == pytest.approx(0.0, abs=1e-3) and rhythm[1, 0] > 0
    np.testing.assert_allclose(rhythm[:4], -rhythm[4:], atol=1e-3)
    np.testing.assert_allclose(gait_fit.limit_cycle_rhythm(cpg.Params(cycle_time=0.5), phases), rhythm, atol=1e-6)


def foot_error(networks, geometry, velocity):
    """Return the RMS distance [mm] of the standing feet from those of the gait, over the cycle."""
    gait, steps = tripod_gait.Gait(), 60
    unit = gait_fit.limit_cycle_rhythm(cpg.Params(), np.arange(steps) / steps)
    phase = jnp.arange(steps)[:, None] / steps + TRIPODS
    rhythm = jnp.asarray(np.stack([unit, np.roll(unit, -steps // 2, axis=0)] * 3, axis=1))
    angles = jax.vmap(shaping.apply, (None, 0, None))(networks, rhythm, jnp.full(2, velocity))
    expected = kinematics.forward(
        geometry, tripod_gait.joint_targets(geometry, gait, phase, jnp.full((steps, 6), velocity))
    )
    errors = 1e3 * jnp.linalg.norm(kinematics.forward(geometry, angles) - expected, axis=-1)
    return float(jnp.sqrt(jnp.mean(errors**2, where=phase % 1 < gait.duty_factor)))


def test_pretrained_networks_follow_the_gait_in_stance(geometry):
    for v in (0.5, 1.0, 1.2, 2.0):
        assert foot_error(shaping.load_pretrained(), geometry, v) < 2.5


def test_the_fit_converges_and_reports_progress(fitted, geometry):
    networks, losses = fitted
    assert foot_error(networks, geometry, 1.0) < 3.5
    steps, values = zip(*losses, strict=True)
    assert steps[-1] == 300 and list(steps) == sorted(steps)
    assert values[-1] < 0.7 * values[0]


def test_right_legs_mirror_the_left_ones(fitted):
    networks, _ = fitted
    rhythm, velocity = jax.random.normal(jax.random.key(5), (6, 2)) * 0.3, jnp.array([0.4, 1.3])
    mirrored = shaping.apply(networks, rhythm[::-1], velocity[::-1])
    angles = shaping.apply(networks, rhythm, velocity)
    np.testing.assert_allclose(mirrored[::-1] * jnp.array([-1.0, 1.0, 1.0]), angles, atol=1e-12)


def test_the_printed_input_cannot_fit_the_gait(geometry):
    """A function of one scalar traces an open curve: the feet are off by more than half the stride."""
    networks = gait_fit.fit(geometry, steps=150, candidates=6, printed_input=True)
    assert networks.printed_input
    assert foot_error(networks, geometry, 1.0) > 6.0


def test_runs_in_either_precision(precision, strict, body):
    geometry = kinematics.read_geometry(body)
    angles = tripod_gait.joint_targets(geometry, tripod_gait.Gait(), jnp.asarray(TRIPODS, dtype=float), jnp.ones(6))
    assert angles.dtype == kinematics.forward(geometry, angles).dtype == precision


def test_fits_in_single_precision(float32, strict, body):
    networks = gait_fit.fit(kinematics.read_geometry(body), steps=10, candidates=6)
    assert networks.w1.dtype == "float32"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(networks))
