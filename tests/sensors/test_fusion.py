"""The identities that steer XLA's fusion: values, gradients, and the division that XLA must not remove."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.sensors import fusion

VALUES = jnp.linspace(0.5, 4.0, 8)


def materialised(x):
    return fusion.materialise(x, x[0])


@pytest.mark.parametrize("identity", [materialised, fusion.fusible])
def test_values_and_gradients_are_those_of_the_identity(identity):
    values, gradient = jax.jit(lambda x: jax.vjp(identity, x)[0])(VALUES), jax.jit(jax.jacrev(identity))(VALUES)
    np.testing.assert_array_equal(values, VALUES)
    np.testing.assert_array_equal(gradient, np.eye(8))
    np.testing.assert_array_equal(jax.jacfwd(identity)(VALUES), np.eye(8))


def test_xla_does_not_remove_the_division():
    program = jax.jit(materialised).lower(VALUES).compile().as_text()
    assert program and "divide(" in program
