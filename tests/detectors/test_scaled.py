"""A detector with other cells and gains: what it gets and gives, against NumPy, and what is refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import lgmd as reference

from lgmdjax.detectors import d_lgmd, eta, lgmd, scaled
from lgmdjax.errors import InputError

FRAMES = np.random.default_rng(0).uniform(97, 103, (6, 12, 16))


def respond(params: scaled.Params, frames: np.ndarray) -> scaled.Response:
    images = jnp.asarray(frames, float)
    return jax.lax.scan(partial(scaled.step, params), scaled.init(params, images[0]), images[1:])[1]


def test_the_lgmd_sees_cells_with_more_contrast():
    response = respond(scaled.Params(contrast=4.0, pooling=2), FRAMES)
    cells = 4.0 * FRAMES.reshape(6, 6, 2, 8, 2).mean(axis=(2, 4))
    expected = reference.lgmd(cells, 6.0, 20.0, 0.4)
    np.testing.assert_allclose(response.u, [row["u"] for row in expected], rtol=1e-9)
    assert np.ptp(response.u) > 0.01


def test_contrast_divides_the_thresholds():
    """The excitation of the detector with thresholds divided by k, times k."""
    with_contrast = respond(scaled.Params(contrast=5.0), FRAMES).excitation
    own = lgmd.Params(threshold=6.0 / 5.0, suppression=20.0 / 5.0)
    np.testing.assert_allclose(with_contrast, 5.0 * respond(scaled.Params(detector=own), FRAMES).excitation, rtol=1e-9)


def test_any_detector_can_be_inside():
    own = d_lgmd.Params(interpolated=True)
    inside = respond(scaled.Params(model=d_lgmd, detector=own, contrast=2.0), FRAMES)
    images = jnp.asarray(2.0 * FRAMES)
    alone = jax.lax.scan(partial(d_lgmd.step, own), d_lgmd.init(own, images[0]), images[1:])[1]
    for name in ("u", "feed_forward", "excitation"):
        np.testing.assert_allclose(getattr(inside, name), getattr(alone, name), rtol=1e-9)


def test_the_response_gain_multiplies_the_excitation_of_a_logistic_function():
    """For the LGMD, whose u is the logistic function of its excitation, and so far below where it is 1."""
    own = lgmd.Params(threshold=0.5, suppression=1e3)
    response = respond(scaled.Params(detector=own, gain=0.3), FRAMES)
    np.testing.assert_allclose(response.u, 1 / (1 + np.exp(-0.3 * np.asarray(response.excitation))), rtol=1e-9)
    with jax.enable_x64(False):
        assert np.isfinite(scaled.expand(jnp.ones(2, jnp.float32), 3.0)).all()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"contrast": 0.0}, "scaled contrast: expected a positive number, got 0.0"),
        ({"contrast": float("inf")}, "scaled contrast"),
        ({"gain": -1.0}, "scaled gain: expected a positive number, got -1.0"),
        ({"pooling": 0}, "scaled pooling: expected 1 pixel or more a cell, got 0"),
        ({"detector": lgmd.Params(threshold=-1.0)}, "lgmd threshold"),
        ({"model": eta, "detector": eta.Params(delay=9.0)}, "eta delay"),
    ],
)
def test_impossible_constants_are_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        scaled.check(scaled.Params(**wrong))
