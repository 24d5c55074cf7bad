"""Correlation of layers of cells, both ways of computing it, against SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import signal

from lgmdjax.detectors import cells


@pytest.mark.parametrize("most", [cells.MAX_BAND, 0], ids=["bands", "convolution"])
@pytest.mark.parametrize(
    ("shape", "side", "before", "after", "stride"),
    [((12, 16), 13, 6, 6, 1), ((9, 7), 4, 1, 2, 1), ((23, 30), 11, 5, 5, 2), ((23, 31), 5, 2, 2, 3)],
)
def test_layers_are_correlated_with_their_weights(shape, side, before, after, stride, most, monkeypatch):
    monkeypatch.setattr(cells, "MAX_BAND", most)
    rng = np.random.default_rng(0)
    layers, weights = rng.normal(size=(2, *shape)), rng.normal(size=(2, side, side))
    found = cells.correlate(jnp.asarray(layers), jnp.asarray(weights), before, after, stride)
    padded = np.pad(layers, ((0, 0), (before, after), (before, after)))
    expected = [signal.correlate2d(layer, own, "valid") for layer, own in zip(padded, weights, strict=True)]
    np.testing.assert_allclose(found, np.stack(expected)[:, ::stride, ::stride], atol=1e-12)


def test_the_derivative_of_a_correlation_is_that_of_differences():
    rng = np.random.default_rng(1)
    layers, weights = jnp.asarray(rng.normal(size=(2, 6, 9))), jnp.asarray(rng.normal(size=(2, 3, 3)))

    def loss(layers, weights):
        return jnp.sum(jnp.sin(cells.correlate(jnp.asarray(layers), jnp.asarray(weights), 1, 1, 2)))

    check_grads(loss, (layers, weights), order=1, modes=["rev"])
