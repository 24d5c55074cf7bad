"""Laboratory stimuli: the images themselves, and that the detector prefers a collision course."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.detectors import lgmd
from lgmdjax.sensors import camera, stimuli

CAMERA = camera.Params(width=160, height=120)
PITCH = CAMERA.fov / CAMERA.width  # rad per pixel, along the middle row
MIDDLE = CAMERA.height // 2


def darkness(image):
    """Return the part of each pixel that the object covers."""
    return (stimuli.BRIGHT - np.asarray(image)) / (stimuli.BRIGHT - stimuli.DARK)


def excitation(images, threshold=1.0):
    """Return the excitation of an LGMD without suppression, for a sequence of images."""
    params = lgmd.Params(threshold=threshold, suppression=1e3)
    _, response = jax.lax.scan(partial(lgmd.step, params), lgmd.init(params, images[0]), images[1:])
    return np.asarray(response.excitation)


@pytest.mark.parametrize("l_over_v", [0.01, 0.1, 0.5, 2.0])
def test_an_approaching_square_has_the_angle_of_gabbiani(l_over_v):
    for time in (-5 * l_over_v, -2 * l_over_v, -l_over_v):
        image = stimuli.approach(CAMERA, l_over_v, time)
        theta = 2 * np.arctan(l_over_v / -time)
        np.testing.assert_allclose(darkness(image)[MIDDLE].sum() * PITCH, theta, rtol=0.01)
        np.testing.assert_array_equal(image, image[:, ::-1])


def test_contact_fills_the_image_and_a_recession_is_the_reversed_approach():
    np.testing.assert_allclose(stimuli.approach(CAMERA, 0.1, 0.0)[MIDDLE, 10:-10], stimuli.DARK)
    times = jnp.linspace(-1.0, 0.0, 31)
    approach = jax.vmap(partial(stimuli.approach, CAMERA, 0.1))(times)
    recession = jax.vmap(partial(stimuli.recession, CAMERA, 0.1))(-times)
    np.testing.assert_array_equal(approach, recession)


def test_a_translating_square_moves_left_and_keeps_its_size():
    for time in (-0.5, 0.0, 0.5):
        row = darkness(stimuli.translation(CAMERA, 0.2, 1.0, time))[MIDDLE]
        azimuth = 0.5 * CAMERA.fov - PITCH * (np.arange(CAMERA.width) + 0.5)  # positive to the left
        np.testing.assert_allclose(row @ azimuth / row.sum(), time, atol=1e-3)
        np.testing.assert_allclose(row.sum() * PITCH, 0.4, rtol=0.01)


def test_an_elongating_bar_keeps_its_height():
    for time in (-0.5, -0.2, -0.1):
        covered = darkness(stimuli.elongation(CAMERA, 0.1, 0.1, time))
        np.testing.assert_allclose(covered[MIDDLE].sum() * PITCH, 2 * np.arctan(0.1 / -time), rtol=0.01)
        np.testing.assert_allclose(covered[:, CAMERA.width // 2].sum() * PITCH, 0.2, rtol=0.01)


def test_a_textured_square_grows_with_its_texture_and_is_as_bright_as_its_surroundings():
    """Half as far away, the same point of the object is seen twice as far from the middle (by the tangent)."""
    far, near = (np.asarray(stimuli.textured_approach(CAMERA, 0.1, time)) for time in (-0.1, -0.05))
    angles = np.arctan(np.linspace(0.2, 0.6, 9))
    columns = [
        np.interp(-k, (np.arange(CAMERA.width) + 0.5) * PITCH - CAMERA.fov / 2, np.arange(CAMERA.width))
        for k in (angles, np.arctan(2 * np.tan(angles)))
    ]
    rows = [
        np.interp(columns[0], np.arange(CAMERA.width), far[MIDDLE]),
        np.interp(columns[1], np.arange(CAMERA.width), near[MIDDLE]),
    ]
    assert np.corrcoef(*rows)[0, 1] > 0.95
    assert abs(near[40:80, 60:100].mean() - 120) < 15 and near[40:80, 60:100].std() > 10


def test_a_flash_brightens_the_whole_image_at_once():
    np.testing.assert_array_equal(stimuli.flash(CAMERA, -1e-3), stimuli.DARK)
    np.testing.assert_array_equal(stimuli.flash(CAMERA, 0.0), stimuli.BRIGHT)


def test_a_grating_has_its_period_speed_and_contrast():
    period, rate, time = CAMERA.fov / 8, 0.4, 0.7
    row = np.asarray(stimuli.grating(CAMERA, period, rate, time))[MIDDLE]
    azimuth = 0.5 * CAMERA.fov - PITCH * (np.arange(CAMERA.width) + 0.5)
    # The middle row is half a pixel off the horizon, which changes the azimuth by less than a hundredth.
    edges = np.stack([azimuth - PITCH / 2, azimuth + PITCH / 2])
    phase = 2 * np.pi * (edges - rate * time) / period
    mean = (np.cos(phase[0]) - np.cos(phase[1])) / (phase[1] - phase[0])
    np.testing.assert_allclose(row, 100.0 + 60.0 * mean, atol=0.5)


def test_yaw_shifts_the_surroundings_along_the_row():
    step = 5 * PITCH
    before, after = (np.asarray(stimuli.yaw(CAMERA, step, time))[MIDDLE] for time in (0.0, 1.0))
    assert np.ptp(before) > 20
    np.testing.assert_allclose(after[40:-40], before[35:-45], atol=2.0)


def test_roll_is_periodic_and_leaves_the_middle_unchanged():
    still, quarter, whole = (np.asarray(stimuli.roll(CAMERA, 0.1, 0.8, time)) for time in (0.0, 0.2, 0.8))
    np.testing.assert_allclose(whole, still, atol=1e-3)
    change = np.abs(quarter - still)
    middle = change[MIDDLE - 3 : MIDDLE + 3, CAMERA.width // 2 - 3 : CAMERA.width // 2 + 3]
    assert change.mean() > 5 * middle.mean() > 0


@pytest.mark.parametrize("l_over_v", [0.03, 0.1, 0.3])
def test_the_detector_prefers_a_collision_course(l_over_v):
    """By far over a translating square and a grating; in the sum slightly over the same square receding."""
    times = (jnp.arange(-60, 0) + 0.5) / 30
    images_at = {
        "approach": lambda time: stimuli.approach(CAMERA, l_over_v, jnp.minimum(time + 0.2, 0.0)),
        "recession": lambda time: stimuli.recession(CAMERA, l_over_v, jnp.maximum(time + 1.8, 0.0)),
        "translation": partial(stimuli.translation, CAMERA, 0.3, 0.5),
        "grating": partial(stimuli.grating, CAMERA, 0.5, 0.5),
    }
    responses = {name: excitation(jax.vmap(stimulus)(times))[2:] for name, stimulus in images_at.items()}
    for name in ("translation", "grating"):
        assert responses["approach"].max() > 2 * responses[name].max()
    assert responses["approach"].sum() > responses["recession"].sum() > 0


def test_runs_in_single_precision(float32):
    images = jax.jit(jax.vmap(partial(stimuli.yaw, CAMERA, 0.5)))(jnp.arange(3) / 30)
    assert images.dtype == jnp.float32 and np.isfinite(images).all()
