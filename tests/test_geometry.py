"""Rotations equal those of SciPy, and the norm is differentiable at zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgmdjax import geometry

RNG = np.random.default_rng(3)
QUATERNIONS = Rotation.random(20, rng=RNG).as_quat(scalar_first=True)


def test_rotation_matrix_equals_scipys():
    expected = Rotation.from_quat(QUATERNIONS, scalar_first=True).as_matrix()
    recorded = geometry.rotation_matrix(QUATERNIONS.T)
    assert isinstance(recorded, np.ndarray)
    np.testing.assert_allclose(np.moveaxis(recorded, -1, 0), expected, atol=1e-12)
    traced = jax.jit(jax.vmap(geometry.rotation_matrix))(jnp.asarray(QUATERNIONS))
    np.testing.assert_allclose(traced, expected, atol=1e-12)


def test_yaw_equals_scipys():
    expected = Rotation.from_quat(QUATERNIONS, scalar_first=True).as_euler("ZYX")[:, 0]
    np.testing.assert_allclose(geometry.yaw(QUATERNIONS), expected, atol=1e-12)
    assert geometry.yaw(QUATERNIONS.astype(np.float32)).dtype == np.float32


def test_plane_rotations_are_counter_clockwise_and_agree():
    vectors, angles = RNG.normal(size=(5, 2)), RNG.uniform(-np.pi, np.pi, 5)
    expected = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).apply(np.pad(vectors, ((0, 0), (0, 1))))[:, :2]
    np.testing.assert_allclose(geometry.rotate(jnp.asarray(vectors), jnp.asarray(angles)), expected, atol=1e-12)
    np.testing.assert_allclose(geometry.rotate_recorded(vectors, angles), expected, atol=1e-12)


@pytest.mark.parametrize("vector", [[3.0, 4.0], [0.0, 0.0]])
def test_safe_norm_has_a_finite_gradient(vector):
    norm, gradient = jax.value_and_grad(geometry.safe_norm)(jnp.asarray(vector))
    assert norm == np.linalg.norm(vector)
    np.testing.assert_allclose(gradient, np.divide(vector, norm if norm else 1.0))
