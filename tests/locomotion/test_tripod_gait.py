"""Legs and gait: kinematics against C MuJoCo, the foot's path as a person would look at it, and the lesson."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping, tripod_gait

TRIPODS = np.array([0.0, 0.5, 0.0, 0.5, 0.0, 0.5])
RANGE = np.linspace(shaping.SLOWEST, shaping.FASTEST, 7)


@pytest.fixture(scope="module")
def body():
    return hexapod.load()


@pytest.fixture(scope="module")
def geometry(body):
    return tripod_gait.geometry(body)


@pytest.fixture(scope="module")
def taught(geometry):
    """A short lesson, enough to look at; the packaged networks had twenty times as long."""
    losses = []
    networks = gait_fit.teach(geometry, steps=300, candidates=6, progress=lambda *told: losses.append(told))
    return networks, losses


def test_forward_kinematics_equal_mujocos(body, geometry):
    data = mujoco.MjData(body)
    feet = [body.site(f"{leg}_foot").id for leg in hexapod.LEGS]
    for angles in np.random.default_rng(0).uniform(-1.2, 1.2, (20, 6, 3)):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *angles.ravel()]
        mujoco.mj_kinematics(body, data)
        np.testing.assert_allclose(kinematics.forward(geometry, jnp.asarray(angles)), data.site_xpos[feet], atol=1e-6)


def test_inverse_undoes_forward(geometry):
    low, high = np.array([-1.3, -0.3, -0.6]), np.array([1.3, 1.2, 1.1])
    angles = jnp.asarray(np.random.default_rng(1).uniform(low, high, (200, 6, 3)))  # no foot behind its coxa
    feet = kinematics.forward(geometry, angles)
    np.testing.assert_allclose(kinematics.inverse(geometry, feet), angles, atol=1e-9)


def test_a_foot_out_of_reach_stretches_the_leg_towards_it(geometry):
    home = tripod_gait.homes(tripod_gait.Gait())
    far = geometry.mounts + 3.0 * (home - geometry.mounts)
    angles = kinematics.inverse(geometry, far)
    np.testing.assert_allclose(angles[:, 2], np.pi / 2, atol=1e-9)  # knee straight
    reached = kinematics.forward(geometry, angles) - geometry.mounts
    towards = far - geometry.mounts
    np.testing.assert_allclose(
        np.arctan2(reached[:, 1], reached[:, 0]), np.arctan2(towards[:, 1], towards[:, 0]), atol=1e-9
    )


@pytest.mark.parametrize("where", ["out of reach", "on the coxa's axis", "on the femur's axis"])
def test_gradients_stay_finite_where_angles_are_not_defined(geometry, where):
    direction = jnp.stack([jnp.cos(geometry.mount_yaws), jnp.sin(geometry.mount_yaws), jnp.zeros(6)], axis=1)
    feet = {
        "out of reach": geometry.mounts + 1.0,
        "on the coxa's axis": geometry.mounts - jnp.array([0.0, 0.0, 0.1]),
        "on the femur's axis": geometry.mounts + geometry.coxa * direction,
    }[where]
    angles = kinematics.inverse(geometry, feet)
    slope = jax.jacrev(lambda feet: kinematics.inverse(geometry, feet))(feet)
    assert np.all(np.isfinite(angles)) and np.all(np.isfinite(slope))


def test_the_standing_foot_goes_backward_at_constant_speed():
    figures = tripod_gait.Gait()
    phase = jnp.linspace(0.0, figures.duty - 1e-6, 50)
    for v in RANGE:
        path = tripod_gait.foot_path(figures, phase, jnp.full(50, v))
        speed = np.gradient(path[:, 0], phase * figures.cycle_time)
        np.testing.assert_allclose(speed, -0.05 * v * figures.stride_gain, atol=1e-9)
        np.testing.assert_allclose(path[:, 1:], 0.0, atol=1e-9)


def test_the_swinging_foot_goes_forward_high_and_lands_softly():
    figures = tripod_gait.Gait()
    phase = jnp.linspace(figures.duty, 1.0, 200)
    path = tripod_gait.foot_path(figures, phase, jnp.ones(200))
    assert path[-1, 0] - path[0, 0] == pytest.approx(0.05 * figures.stride_gain * 0.8 * figures.duty)
    assert np.max(path[:, 2]) == pytest.approx(figures.lift, rel=1e-3)
    assert np.all(path[:, 2] >= 0)
    falling = np.gradient(path[:, 2], phase)
    assert abs(falling[-1]) < 0.05 * np.abs(falling).max()


def test_the_path_is_closed_and_smooth_around_the_cycle():
    figures = tripod_gait.Gait()
    phase = jnp.linspace(0.0, 1.0, 20_001)
    for v in RANGE:
        path = np.asarray(tripod_gait.foot_path(figures, phase, jnp.full(phase.shape, v)))
        np.testing.assert_allclose(path[0], path[-1], atol=1e-9)
        velocity = np.diff(np.concatenate([path, path[1:3]]), axis=0) * 20_000
        assert np.abs(np.diff(velocity, axis=0)).max() < 0.01 * np.abs(velocity).max()


def test_the_stride_follows_the_velocity_and_its_sign():
    figures, phase = tripod_gait.Gait(), jnp.array([0.0, 0.3, 0.7, 0.9])
    one = tripod_gait.foot_path(figures, phase, jnp.ones(4))
    for v in RANGE:
        path = tripod_gait.foot_path(figures, phase, jnp.full(4, v))
        np.testing.assert_allclose(path[:, 0], v * one[:, 0], atol=1e-12)
        np.testing.assert_allclose(path[:, 2], one[:, 2])  # it steps on the spot at v = 0


def test_the_tripod_bears_the_weight_by_statics():
    figures = tripod_gait.Gait()
    middle_of_stance, x = jnp.where(TRIPODS == 0, 0.27, 0.77), jnp.full(6, 0.02)
    share = np.asarray(tripod_gait.load_share(figures, middle_of_stance, x))
    feet = np.asarray(tripod_gait.homes(figures))[::2, :2] + np.array([0.02, 0.0])
    np.testing.assert_allclose(share[1::2], 0.0)
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(share[::2] @ feet, 0.0, atol=1e-12)  # no moment about the trunk's centre


def test_the_two_tripods_hand_over_the_whole_weight():
    phase = jnp.linspace(0.0, 1.0, 201)[:, None] + TRIPODS
    share = tripod_gait.load_share(tripod_gait.Gait(), phase, jnp.zeros((201, 6)))
    np.testing.assert_allclose(share.sum(axis=1), 1.0, atol=1e-12)
    assert np.abs(np.diff(share, axis=0)).max() < 0.1


def test_targets_keep_to_the_joints_and_mirror(body, geometry):
    phase = jnp.linspace(0.0, 1.0, 41)[:, None, None] + jnp.zeros((41, 7, 6))
    velocity = jnp.asarray(RANGE)[None, :, None] + jnp.zeros((41, 7, 6))
    angles = np.asarray(tripod_gait.targets(geometry, tripod_gait.Gait(), phase, velocity))
    low, high = body.jnt_range[1:].reshape(6, 3, 2).transpose(2, 0, 1)
    assert np.all((angles > low) & (angles < high))
    np.testing.assert_allclose(angles[..., ::-1, :] * np.array([-1, 1, 1]), angles, atol=1e-9)


def test_targets_run_ahead_and_beyond(geometry):
    """Without lag and weight they are the path itself; with them they lead it by the lag and press the feet down."""
    figures, phase = tripod_gait.Gait(), jnp.full(6, 0.27)
    bare = geometry.replace(lag=0.0, weight=0.0)
    feet = kinematics.forward(geometry, tripod_gait.targets(bare, figures, phase, jnp.ones(6)))
    home = tripod_gait.homes(figures)
    np.testing.assert_allclose(feet - home, tripod_gait.foot_path(figures, phase, jnp.ones(6)), atol=1e-9)
    loaded = kinematics.forward(geometry, tripod_gait.targets(geometry, figures, phase, jnp.ones(6)))
    assert np.all(loaded[:, 2] < feet[:, 2] - 1e-4)
    led = kinematics.forward(geometry, tripod_gait.targets(bare.replace(lag=0.01), figures, phase, jnp.ones(6)))
    np.testing.assert_allclose(led[:, 0] - feet[:, 0], -0.01 * 0.05 * figures.stride_gain, rtol=0.02)


def test_limit_cycle_is_the_settled_rhythm_whatever_the_cycle_time():
    phases = np.arange(8) / 8
    settled = gait_fit.limit_cycle(cpg.Params(), phases)
    assert settled[0, 0] == pytest.approx(0.0, abs=1e-3) and settled[1, 0] > 0
    np.testing.assert_allclose(settled[:4], -settled[4:], atol=1e-3)
    np.testing.assert_allclose(gait_fit.limit_cycle(cpg.Params(cycle_time=0.5), phases), settled, atol=1e-6)


def foot_error(networks, geometry, velocity):
    """RMS distance [mm] of the standing feet from where the gait wants them, around the cycle."""
    figures, steps = tripod_gait.Gait(), 60
    settled = gait_fit.limit_cycle(cpg.Params(), np.arange(steps) / steps)
    phase = jnp.arange(steps)[:, None] / steps + TRIPODS
    rhythm = jnp.asarray(np.stack([settled, np.roll(settled, -steps // 2, axis=0)] * 3, axis=1))
    angles = jax.vmap(shaping.shape, (None, 0, None))(networks, rhythm, jnp.full(2, velocity))
    wanted = kinematics.forward(geometry, tripod_gait.targets(geometry, figures, phase, jnp.full((steps, 6), velocity)))
    missed = 1e3 * jnp.linalg.norm(kinematics.forward(geometry, angles) - wanted, axis=-1)
    return float(jnp.sqrt(jnp.mean(missed**2, where=phase % 1 < figures.duty)))


def test_packaged_networks_put_standing_feet_where_the_gait_wants_them(geometry):
    for v in (0.5, 1.0, 1.2, 2.0):
        assert foot_error(shaping.taught(), geometry, v) < 2.5


def test_the_lesson_is_learned_and_told(taught, geometry):
    networks, losses = taught
    assert foot_error(networks, geometry, 1.0) < 3.5
    steps, values = zip(*losses, strict=True)
    assert steps[-1] == 300 and list(steps) == sorted(steps)
    assert values[-1] < 0.7 * values[0]


def test_right_legs_are_the_left_ones_mirrored(taught):
    networks, _ = taught
    rhythm, velocity = jax.random.normal(jax.random.key(5), (6, 2)) * 0.3, jnp.array([0.4, 1.3])
    mirrored = shaping.shape(networks, rhythm[::-1], velocity[::-1])
    angles = shaping.shape(networks, rhythm, velocity)
    np.testing.assert_allclose(mirrored[::-1] * jnp.array([-1.0, 1.0, 1.0]), angles, atol=1e-12)


def test_the_papers_input_cannot_learn_it(geometry):
    """A map of one scalar traces an open curve: the feet miss by more than half the stride."""
    networks = gait_fit.teach(geometry, steps=150, candidates=6, literal=True)
    assert networks.literal
    assert foot_error(networks, geometry, 1.0) > 6.0


def test_runs_in_either_precision(precision, strict, body):
    geometry = tripod_gait.geometry(body)
    angles = tripod_gait.targets(geometry, tripod_gait.Gait(), jnp.asarray(TRIPODS, dtype=float), jnp.ones(6))
    assert angles.dtype == kinematics.forward(geometry, angles).dtype == precision


def test_teaches_in_single_precision(float32, strict, body):
    networks = gait_fit.teach(tripod_gait.geometry(body), steps=10, candidates=6)
    assert networks.w1.dtype == "float32"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(networks))
