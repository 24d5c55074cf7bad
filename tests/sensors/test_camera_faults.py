"""Faults of cameras, one at a time: against closed forms, and JPEG against libjpeg."""

import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from lgmdjax.sensors import camera_faults
from lgmdjax.sensors.camera_faults import Params

HEIGHT, WIDTH = 24, 36  # no multiple of eight
step = jax.jit(camera_faults.step)


@pytest.fixture(scope="module")
def pictures() -> np.ndarray:
    """Return eight stereo pictures with structure at all scales, in whole grey levels."""
    rng = np.random.default_rng(0)
    walks = np.cumsum(np.cumsum(rng.normal(0, 3, (8, 2, HEIGHT, WIDTH)), axis=2), axis=3)
    return np.round(np.clip(walks - walks.mean(axis=(2, 3), keepdims=True) + 120, 20, 230))


def run(params: Params, pictures: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return what arrives in each frame, and whether anything does."""
    params = jax.tree.map(jnp.asarray, params)
    state = camera_faults.init(params, jnp.asarray(pictures[0]), jax.random.key(seed))
    delivered = []
    for picture in pictures:
        state, delivery = step(params, state, jnp.asarray(picture))
        delivered.append(jax.tree.map(np.asarray, delivery))
    return np.stack([each.pictures for each in delivered]), np.stack([each.arrived for each in delivered])


def test_without_faults_pictures_arrive_as_they_are(pictures):
    delivered, arrived = run(Params(), pictures)
    np.testing.assert_allclose(delivered, pictures)
    assert arrived.all()


def test_photon_noise_has_the_variance_of_its_electrons():
    grey, electrons, read = 100.0, 20.0, 10.0
    flat = np.full((40, 2, HEIGHT, WIDTH), grey)
    delivered, _ = run(Params(noise=1.0, electrons=electrons, read=read), flat)
    expected = grey / electrons + (read / electrons) ** 2 + 1 / 12  # and that of rounding
    assert delivered.mean() == pytest.approx(grey, abs=0.05)
    assert delivered.var() == pytest.approx(expected, rel=0.03)
    assert abs(np.corrcoef(delivered[0].ravel(), delivered[1].ravel())[0, 1]) < 0.08
    np.testing.assert_array_equal(delivered, run(Params(noise=1.0, electrons=electrons, read=read), flat)[0])
    assert (delivered != run(Params(noise=1.0), flat, seed=1)[0]).any()


def test_a_small_picture_has_the_noise_of_the_sensors_picture_averaged():
    flat, faults = np.full((40, 2, HEIGHT, WIDTH), 100.3), Params(noise=1.0)
    sensor, _ = run(faults, flat.repeat(4, axis=2).repeat(4, axis=3))
    averaged = sensor.reshape(40, 2, HEIGHT, 4, WIDTH, 4).mean(axis=(3, 5))
    small, _ = run(camera_faults.average(faults, camera_faults.SENSOR_WIDTH // 4), flat)
    assert small.mean() == pytest.approx(averaged.mean(), abs=0.02)
    assert small.std() == pytest.approx(averaged.std(), rel=0.03)
    assert camera_faults.average(faults, 2 * camera_faults.SENSOR_WIDTH).averaged == 1


def test_gamma_and_vignetting():
    flat = np.full((1, 2, HEIGHT, WIDTH), 64.0)
    assert run(Params(gamma=2.0), flat)[0].flat[0] == round(255 * (64 / 255) ** 2)
    dark = run(Params(vignetting=0.5), flat)[0][0, 0]
    assert dark[HEIGHT // 2, 0] == pytest.approx(
        64 * (1 - 0.5 * ((WIDTH / 2 - 0.5) ** 2 + 0.25) / (WIDTH / 2) ** 2), abs=0.6
    )
    assert dark[HEIGHT // 2, WIDTH // 2] == 64


def test_motion_blur_is_the_mean_of_a_linear_change(pictures):
    delivered, _ = run(Params(blur=0.5), pictures)
    times = np.linspace(0.5, 1.0, 101)[:, None, None, None]
    expected = (pictures[2] + times * (pictures[3] - pictures[2])).mean(axis=0)
    np.testing.assert_allclose(delivered[3], expected, atol=0.5 + 1e-4)


def test_exposure_brings_every_picture_to_one_mean_and_drifts():
    for grey in (40.0, 200.0):
        steady, _ = run(Params(auto_exposure=1.0), np.full((150, 2, HEIGHT, WIDTH), grey))
        assert steady[-1].mean() == pytest.approx(camera_faults.MEAN_GREY, rel=0.02)
        assert 0 < abs(steady[1].mean() - grey) < 0.15 * grey  # slowly
    drifting, _ = run(Params(auto_exposure=1.0, drift=0.2), np.full((300, 2, HEIGHT, WIDTH), 118.0))
    assert 5 < np.ptp(drifting[:, 0, 0, 0]) < 120


@pytest.mark.parametrize("quality", [20, 50, 90])
def test_jpeg_is_libjpegs(pictures, quality):
    ours = np.asarray(camera_faults.compress(jnp.asarray(pictures[0]), float(quality)))
    for mine, picture in zip(ours, pictures[0], strict=True):
        file = io.BytesIO()
        Image.fromarray(picture.astype(np.uint8)).save(file, "JPEG", quality=quality)
        theirs = np.asarray(Image.open(file), float)
        loss = np.abs(theirs - picture).mean()
        assert (
            np.abs(mine - theirs).mean() < 0.25 * loss
        )  # libjpeg's transform is of whole numbers: some round otherwise
        assert np.abs(mine - theirs).max() <= 8


@pytest.mark.parametrize("latency", [1, 3])
def test_latency_is_in_frames(pictures, latency):
    delivered, arrived = run(Params(latency=latency), pictures)
    assert arrived.tolist() == [False] * latency + [True] * (len(pictures) - latency)
    np.testing.assert_allclose(delivered[latency:], pictures[:-latency])


def test_a_share_of_the_pictures_is_lost():
    _, arrived = run(Params(dropped=0.05), np.zeros((600, 2, 1, 8)))
    assert (~arrived).sum() in range(15, 47)  # 99.9 % of binomial counts


def test_warp_moves_an_edge_outward_or_inward():
    """A ramp whose middle is at column 30.5 of 40, by a lens that is off by 10 %: the picture shrinks."""
    picture = jnp.asarray(np.tile(200 * np.clip((np.arange(40) - 27) / 7, 0, 1), (20, 1)))
    warped = np.asarray(camera_faults.warp(picture, 0.1))[10]
    place = np.interp(100.0, warped, np.arange(40)) - 19.5
    u = np.linspace(0, 20, 20001)
    expected = u[np.argmin(np.abs(u * (1 + 0.1 * (u / 20) ** 2) - 11.0))]
    assert place == pytest.approx(expected, abs=0.1)
