"""Leg kinematics: agreement with C MuJoCo, inversion, and singular positions."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.locomotion import kinematics, tripod_gait


@pytest.fixture(scope="module")
def body():
    return hexapod.load()


@pytest.fixture(scope="module")
def geometry(body):
    return kinematics.read_geometry(body)


def test_forward_kinematics_equal_mujoco(body, geometry):
    data = mujoco.MjData(body)
    feet = [body.site(f"{leg}_foot").id for leg in hexapod.LEGS]
    for angles in np.random.default_rng(0).uniform(-1.2, 1.2, (20, 6, 3)):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *angles.ravel()]
        mujoco.mj_kinematics(body, data)
        np.testing.assert_allclose(kinematics.forward(geometry, jnp.asarray(angles)), data.site_xpos[feet], atol=1e-6)


def test_inverse_inverts_forward(geometry):
    low, high = np.array([-1.3, -0.3, -0.6]), np.array([1.3, 1.2, 1.1])
    # Within these bounds each foot is in front of its coxa.
    angles = jnp.asarray(np.random.default_rng(1).uniform(low, high, (200, 6, 3)))
    feet = kinematics.forward(geometry, angles)
    np.testing.assert_allclose(kinematics.inverse(geometry, feet), angles, atol=1e-9)


def test_a_foot_out_of_reach_stretches_the_leg_towards_it(geometry):
    neutral = tripod_gait.neutral_feet(tripod_gait.Gait())
    far = geometry.mounts + 3.0 * (neutral - geometry.mounts)
    angles = kinematics.inverse(geometry, far)
    np.testing.assert_allclose(angles[:, 2], np.pi / 2, atol=1e-9)  # knee straight
    reached = kinematics.forward(geometry, angles) - geometry.mounts
    towards = far - geometry.mounts
    np.testing.assert_allclose(
        np.arctan2(reached[:, 1], reached[:, 0]), np.arctan2(towards[:, 1], towards[:, 0]), atol=1e-9
    )


@pytest.mark.parametrize("where", ["out of reach", "on the coxa's axis", "on the femur's axis"])
def test_gradients_are_finite_where_angles_are_undefined(geometry, where):
    direction = jnp.stack([jnp.cos(geometry.mount_yaws), jnp.sin(geometry.mount_yaws), jnp.zeros(6)], axis=1)
    feet = {
        "out of reach": geometry.mounts + 1.0,
        "on the coxa's axis": geometry.mounts - jnp.array([0.0, 0.0, 0.1]),
        "on the femur's axis": geometry.mounts + geometry.coxa * direction,
    }[where]
    angles = kinematics.inverse(geometry, feet)
    jacobian = jax.jacrev(lambda feet: kinematics.inverse(geometry, feet))(feet)
    assert np.all(np.isfinite(angles)) and np.all(np.isfinite(jacobian))
