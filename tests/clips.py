"""Short clips of laboratory stimuli for the tests of detectors, and the loop that runs a detector on them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.sensors import camera, stimuli

CAMERA = camera.Params(width=32, height=24)
GREY_SUM = stimuli.DARK + stimuli.BRIGHT


def respond(detector, params, frames):
    """Return the responses to all frames after the first, as a detector's own dataclass of arrays over time."""
    return _scan(detector.step, detector.init, params, jnp.asarray(frames, dtype=float))


@partial(jax.jit, static_argnums=(0, 1))
def _scan(step, init, params, frames):
    return jax.lax.scan(partial(step, params), init(params, frames[0]), frames[1:])[1]


def assert_equals_reference(response, expected, names=("u", "excitation", "feed_forward"), tolerance=1e-5):
    """Compare with what a transcription returned for each frame: a list of dictionaries."""
    for name in names:
        values = np.asarray([frame[name] for frame in expected])
        largest = np.abs(values).max()
        np.testing.assert_allclose(getattr(response, name), values, rtol=tolerance, atol=tolerance * largest)
        assert np.ptp(values) > 0.01 * largest > 0, f"{name} hardly changes, so the comparison says little"


def noise(frames, height=13, width=17, seed=0):
    return np.random.default_rng(seed).uniform(0, 255, (frames, height, width))


def blobs(frames, strength, height=13, width=17, seed=0):
    """Return frames of smooth noise, whose changes come in clusters."""
    coarse = np.random.default_rng(seed).uniform(-1, 1, (frames, (height + 3) // 4, (width + 3) // 4))
    return 128 + strength * np.kron(coarse, np.ones((1, 4, 4)))[:, :height, :width]


def movie(stimulus, times):
    return np.asarray(jax.vmap(stimulus)(jnp.asarray(times)))


def inverted(frames):
    """Return bright on dark for dark on bright."""
    return GREY_SUM - frames


def approach(l_over_v=0.1, seconds=1.5, until=0.05, rate=30):
    """Return the frames of a dark square that approaches until so many seconds before contact."""
    times = np.arange(-round(seconds * rate), 1) / rate - until
    return movie(partial(stimuli.approach, CAMERA, l_over_v), times)


def translation(rate, half_angle=0.3, seconds=1.5, frame_rate=30):
    times = np.arange(round(seconds * frame_rate) + 1) / frame_rate - seconds / 2
    return movie(partial(stimuli.translation, CAMERA, half_angle, rate), times)


def respond_to_geometry(observer, params, geometry):
    """Return the responses of an ideal observer to all frames."""
    geometry = jax.tree.map(lambda x: jnp.asarray(x, dtype=float), geometry)
    start = observer.init(params, jax.tree.map(lambda x: x[0], geometry))
    return jax.lax.scan(partial(observer.step, params), start, geometry)[1]
