"""Values equal those of NumPy; the derivative is that of the selected argument."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.minmax import amin, clip, maximum, minimum

A, B = np.array([[1.0, -2.0, 0.5]]), np.array([[0.0], [0.7]])


@pytest.mark.parametrize(("ours", "numpys", "sign"), [(maximum, np.maximum, 1), (minimum, np.minimum, -1)])
def test_value_is_numpys_and_gradient_that_of_the_selected_argument(ours, numpys, sign):
    np.testing.assert_array_equal(ours(A, B), numpys(A, B))
    is_first = sign * A > sign * B
    gradients = jax.grad(lambda a, b: jnp.sum(ours(a, b)), argnums=(0, 1))(jnp.asarray(A), jnp.asarray(B))
    np.testing.assert_array_equal(gradients[0], is_first.sum(axis=0, keepdims=True))
    np.testing.assert_array_equal(gradients[1], (~is_first).sum(axis=1, keepdims=True))
    tangents = 2 * np.ones_like(A), 3 * np.ones_like(B)
    _, tangent = jax.jvp(ours, (jnp.asarray(A), jnp.asarray(B)), tangents)
    np.testing.assert_array_equal(tangent, np.where(is_first, 2, 3))


@pytest.mark.parametrize("zero", [0, 0.0, np.zeros((), int)])
def test_second_argument_may_be_a_number(zero):
    gradient = jax.vmap(jax.grad(lambda x: maximum(x, zero)))(jnp.asarray([-1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(gradient, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("axis", [0, -1])
def test_gradient_of_amin_is_that_of_the_first_minimum(axis):
    a = np.array([[3.0, 1.0, 2.0], [0.5, 1.0, 0.5]])
    np.testing.assert_array_equal(amin(a, axis), a.min(axis))
    gradient = jax.grad(lambda a: jnp.sum(amin(a, axis)))(jnp.asarray(a))
    expected = np.zeros_like(a)
    np.put_along_axis(expected, np.expand_dims(a.argmin(axis), axis), 1.0, axis)
    np.testing.assert_array_equal(gradient, expected)


def test_gradient_of_clip_is_zero_beyond_the_limits():
    x = jnp.asarray([-3.0, -0.5, 0.9, 4.0])
    np.testing.assert_array_equal(clip(x, -1.0, 1.0), np.clip(x, -1, 1))
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda x: clip(x, -1.0, 1.0)))(x), [0, 1, 1, 0])


def test_single_precision_is_kept():
    x = jnp.float32(0.3)
    assert maximum(x, 0.0).dtype == jax.grad(lambda x: minimum(x, 1.0))(x).dtype == jnp.float32
