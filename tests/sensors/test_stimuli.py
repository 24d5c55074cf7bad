"""Laboratory stimuli: what is on the screen, and that the detector tells a collision course from the rest."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.detectors import lgmd
from lgmdjax.sensors import camera, stimuli

EYES = camera.Params(width=160, height=120)
PITCH = EYES.fov / EYES.width  # rad a pixel, along the middle row
MIDDLE = EYES.height // 2


def darkness(picture):
    """How much of each pixel is covered by the object."""
    return (stimuli.BRIGHT - np.asarray(picture)) / (stimuli.BRIGHT - stimuli.DARK)


def excitation(film, threshold=1.0):
    """Show a film to an LGMD whose gate is open."""
    params = lgmd.Params(threshold=threshold, suppression=1e3)
    _, response = jax.lax.scan(partial(lgmd.step, params), lgmd.init(params, film[0]), film[1:])
    return np.asarray(response.excitation)


@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.5, 2.0])
def test_an_approaching_square_subtends_what_gabbiani_says(ratio):
    for time in (-5 * ratio, -2 * ratio, -ratio):
        picture = stimuli.approach(EYES, ratio, time)
        theta = 2 * np.arctan(ratio / -time)
        np.testing.assert_allclose(darkness(picture)[MIDDLE].sum() * PITCH, theta, rtol=0.01)
        np.testing.assert_array_equal(picture, picture[:, ::-1])


def test_at_contact_half_of_all_directions_are_dark_and_a_recession_is_the_film_backwards():
    np.testing.assert_allclose(stimuli.approach(EYES, 0.1, 0.0)[MIDDLE, 10:-10], stimuli.DARK)
    times = jnp.linspace(-1.0, 0.0, 31)
    film = jax.vmap(partial(stimuli.approach, EYES, 0.1))(times)
    back = jax.vmap(partial(stimuli.recession, EYES, 0.1))(-times)
    np.testing.assert_array_equal(film, back)


def test_a_square_goes_round_to_the_left_and_keeps_its_size():
    for time in (-0.5, 0.0, 0.5):
        row = darkness(stimuli.translation(EYES, 0.2, 1.0, time))[MIDDLE]
        azimuth = 0.5 * EYES.fov - PITCH * (np.arange(EYES.width) + 0.5)  # left is positive, and on the left
        np.testing.assert_allclose(row @ azimuth / row.sum(), time, atol=1e-3)
        np.testing.assert_allclose(row.sum() * PITCH, 0.4, rtol=0.01)


def test_bars_have_their_period_speed_and_contrast():
    period, rate, time = EYES.fov / 8, 0.4, 0.7
    row = np.asarray(stimuli.grating(EYES, period, rate, time))[MIDDLE]
    azimuth = 0.5 * EYES.fov - PITCH * (np.arange(EYES.width) + 0.5)
    # A pixel off the middle row sees a little above or below, which changes no azimuth by more than a hundredth.
    edges = np.stack([azimuth - PITCH / 2, azimuth + PITCH / 2])
    phase = 2 * np.pi * (edges - rate * time) / period
    mean = (np.cos(phase[0]) - np.cos(phase[1])) / (phase[1] - phase[0])
    np.testing.assert_allclose(row, 100.0 + 60.0 * mean, atol=0.5)


def test_a_turn_moves_the_surroundings_along_the_row():
    step = 5 * PITCH
    before, after = (np.asarray(stimuli.yaw(EYES, step, time))[MIDDLE] for time in (0.0, 1.0))
    assert np.ptp(before) > 20
    np.testing.assert_allclose(after[40:-40], before[35:-45], atol=2.0)


def test_sway_comes_back_and_leaves_the_middle_where_it_is():
    still, quarter, whole = (np.asarray(stimuli.sway(EYES, 0.1, 0.8, time)) for time in (0.0, 0.2, 0.8))
    np.testing.assert_allclose(whole, still, atol=1e-3)
    change = np.abs(quarter - still)
    middle = change[MIDDLE - 3 : MIDDLE + 3, EYES.width // 2 - 3 : EYES.width // 2 + 3]
    assert change.mean() > 5 * middle.mean() > 0


@pytest.mark.parametrize("ratio", [0.03, 0.1, 0.3])
def test_the_detector_prefers_a_collision_course(ratio):
    """By far to a square that goes by, and to bars that go round; in all by a little to the same square that leaves."""
    times = (jnp.arange(-60, 0) + 0.5) / 30
    shown = {
        "approach": lambda time: stimuli.approach(EYES, ratio, jnp.minimum(time + 0.2, 0.0)),
        "recession": lambda time: stimuli.recession(EYES, ratio, jnp.maximum(time + 1.8, 0.0)),
        "translation": partial(stimuli.translation, EYES, 0.3, 0.5),
        "grating": partial(stimuli.grating, EYES, 0.5, 0.5),
    }
    answers = {name: excitation(jax.vmap(stimulus)(times))[2:] for name, stimulus in shown.items()}
    for name in ("translation", "grating"):
        assert answers["approach"].max() > 2 * answers[name].max()
    assert answers["approach"].sum() > answers["recession"].sum() > 0


def test_shows_films_in_single_precision(float32):
    film = jax.jit(jax.vmap(partial(stimuli.yaw, EYES, 0.5)))(jnp.arange(3) / 30)
    assert film.dtype == jnp.float32 and np.isfinite(film).all()
