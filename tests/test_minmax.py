"""The larger and the smaller of two: JAX's and NumPy's values, and the derivative of the one that is taken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.minmax import maximum, amin, minimum, clip

A, B = np.array([[1.0, -2.0, 0.5]]), np.array([[0.0], [0.7]])


@pytest.mark.parametrize(("ours", "numpys", "sign"), [(maximum, np.maximum, 1), (minimum, np.minimum, -1)])
def test_has_the_value_and_the_slope_of_the_one_that_is_taken(ours, numpys, sign):
    np.testing.assert_array_equal(ours(A, B), numpys(A, B))
    taken = sign * A > sign * B
    slopes = jax.grad(lambda a, b: jnp.sum(ours(a, b)), argnums=(0, 1))(jnp.asarray(A), jnp.asarray(B))
    np.testing.assert_array_equal(slopes[0], taken.sum(axis=0, keepdims=True))
    np.testing.assert_array_equal(slopes[1], (~taken).sum(axis=1, keepdims=True))
    tangents = 2 * np.ones_like(A), 3 * np.ones_like(B)
    _, slope = jax.jvp(ours, (jnp.asarray(A), jnp.asarray(B)), tangents)
    np.testing.assert_array_equal(slope, np.where(taken, 2, 3))


@pytest.mark.parametrize("zero", [0, 0.0, np.zeros((), int)])
def test_against_a_number(zero):
    slope = jax.vmap(jax.grad(lambda x: maximum(x, zero)))(jnp.asarray([-1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(slope, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("axis", [0, -1])
def test_the_least_has_the_slope_of_the_first_of_them(axis):
    a = np.array([[3.0, 1.0, 2.0], [0.5, 1.0, 0.5]])
    np.testing.assert_array_equal(amin(a, axis), a.min(axis))
    slope = jax.grad(lambda a: jnp.sum(amin(a, axis)))(jnp.asarray(a))
    expected = np.zeros_like(a)
    np.put_along_axis(expected, np.expand_dims(a.argmin(axis), axis), 1.0, axis)
    np.testing.assert_array_equal(slope, expected)


def test_limits_and_is_level_beyond_them():
    x = jnp.asarray([-3.0, -0.5, 0.9, 4.0])
    np.testing.assert_array_equal(clip(x, -1.0, 1.0), np.clip(x, -1, 1))
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda x: clip(x, -1.0, 1.0)))(x), [0, 1, 1, 0])


def test_keeps_single_precision():
    x = jnp.float32(0.3)
    assert maximum(x, 0.0).dtype == jax.grad(lambda x: minimum(x, 1.0))(x).dtype == jnp.float32
