"""Eta and tau: the published equations, and what they say of an approach at constant speed."""

import clips
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.detectors import eta, tau
from lgmdjax.detectors.protocol import Geometry
from lgmdjax.errors import InputError

FRAME_TIME = 1 / 1000


def approach(l_over_v, times):
    """Return size and expansion of an object that makes contact at t = 0."""
    return Geometry(size=2 * np.arctan(l_over_v / -times), rate=2 * l_over_v / (times**2 + l_over_v**2))


def run(observer, params, geometry):
    frames = len(geometry.size)
    state, out = observer.init(params, Geometry(size=geometry.size[0], rate=geometry.rate[0])), []
    for k in range(frames):
        state, response = observer.step(params, state, Geometry(size=geometry.size[k], rate=geometry.rate[k]))
        out.append((float(response.u), float(response.excitation)))
    return np.transpose(out)


def test_eta_is_the_product_of_expansion_and_an_exponential_of_size():
    times = -np.linspace(1.0, 0.1, 20)
    geometry = approach(0.1, times)
    u, excitation = run(eta, eta.Params(delay=2.5 / 30), geometry)
    now = geometry.rate * np.exp(-4.7 * geometry.size)
    np.testing.assert_allclose(excitation[3:], 0.5 * (now[1:-2] + now[:-3]), rtol=1e-5)
    np.testing.assert_allclose(u, 1 / (1 + np.exp(-10 * excitation)), rtol=1e-5)


@pytest.mark.parametrize("l_over_v", [0.01, 0.03, 0.05])
def test_eta_peaks_a_fixed_time_after_the_angular_threshold(l_over_v):
    """Gabbiani et al. 1999: t_peak = delta - alpha l/|v|, whatever l/|v|."""
    times = np.arange(-0.6, -0.001, FRAME_TIME)
    geometry = approach(l_over_v, times)
    params = eta.Params(frame_time=FRAME_TIME, delay=0.005)
    response = clips.respond_to_geometry(eta, params, geometry)
    peak = times[np.argmax(response.excitation)]
    assert peak == pytest.approx(0.005 - 4.7 * l_over_v, abs=1.5 * FRAME_TIME)


def test_tau_is_the_time_to_contact_at_every_angle():
    times = -np.geomspace(2.0, 0.01, 12)
    _, excitation = run(tau, tau.Params(), approach(0.2, times))
    np.testing.assert_allclose(1 / excitation, -times, rtol=1e-5)


def test_neither_answers_to_recession_or_to_nothing():
    geometry = Geometry(size=jnp.asarray([0.5, 0.4, 0.0]), rate=jnp.asarray([-1.0, -1.0, 0.0]))
    for observer in (eta, tau):
        u, excitation = run(observer, observer.Params(), geometry)
        assert np.all(u == 0.5) and np.all(excitation == 0)


def test_a_delay_beyond_the_history_is_refused():
    eta.check(eta.Params())
    with pytest.raises(InputError, match=r"eta delay: expected 0..0.267 s, got 0.5"):
        eta.check(eta.Params(delay=0.5))
