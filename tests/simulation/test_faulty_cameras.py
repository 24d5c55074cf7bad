"""Cameras with faults in the closed loop: what the detectors get, and when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.sensors import camera_faults
from lgmdjax.simulation import faulty_cameras

PICTURES = np.random.default_rng(2).integers(0, 256, (9, 2, 12, 16)).astype(float)
RESET = 5  # frame in which the robot starts again


def see(faults: camera_faults.Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pictures that arrive in each frame, whether any do, and whether none did before."""

    def frame(state, inputs):
        state, pictures = faulty_cameras.step(faults, state, *inputs)
        return state, (pictures, state.arrived, state.is_waiting)

    is_first = jnp.isin(jnp.arange(len(PICTURES)), jnp.asarray([0, RESET]))
    start = faulty_cameras.init(faults, jnp.zeros_like(jnp.asarray(PICTURES[0])), jax.random.key(0))
    outputs = jax.lax.scan(frame, start, (jnp.asarray(PICTURES), is_first))[1]
    pictures, arrived, is_waiting = (np.asarray(output) for output in outputs)
    return pictures, arrived, is_waiting


def test_without_a_fault_every_picture_arrives_as_it_is():
    pictures, arrived, is_waiting = see(camera_faults.Params())
    np.testing.assert_allclose(pictures, PICTURES, atol=1e-9)
    assert arrived.all()
    np.testing.assert_array_equal(np.flatnonzero(is_waiting), [0, RESET])


def test_a_late_picture_is_waited_for_after_every_start():
    pictures, arrived, is_waiting = see(camera_faults.Params(latency=2))
    np.testing.assert_array_equal(np.flatnonzero(~arrived), [0, 1, RESET, RESET + 1])
    np.testing.assert_array_equal(np.flatnonzero(is_waiting), [0, 1, 2, RESET, RESET + 1, RESET + 2])
    np.testing.assert_allclose(pictures[arrived], PICTURES[[0, 1, 2, RESET, RESET + 1]], atol=1e-9)


def test_lost_pictures_do_not_arrive_at_their_rate():
    frames = 4000

    def frame(state, picture):
        state, _ = faulty_cameras.step(camera_faults.Params(dropped=0.2), state, picture, jnp.asarray(False))
        return state, state.arrived

    start = faulty_cameras.init(camera_faults.Params(), jnp.zeros((2, 1, 1)), jax.random.key(3))
    arrived = np.asarray(jax.lax.scan(frame, start, jnp.zeros((frames, 2, 1, 1)))[1])
    assert arrived.mean() == pytest.approx(0.8, abs=4 * np.sqrt(0.8 * 0.2 / frames))


def test_both_eyes_have_noise_of_their_own_and_go_on_after_a_reset():
    pictures, _, _ = see(camera_faults.Params(noise=1.0))
    noise = pictures - PICTURES
    middle = (PICTURES > 40) & (PICTURES < 215)  # not clipped
    both = middle[:, 0] & middle[:, 1]
    assert abs(np.corrcoef(noise[:, 0][both], noise[:, 1][both])[0, 1]) < 0.1
    assert np.std(noise[middle]) == pytest.approx(np.sqrt(128 / 20 + 0.25), rel=0.1)
    assert abs(np.corrcoef(noise[0][middle[0] & middle[RESET]], noise[RESET][middle[0] & middle[RESET]])[0, 1]) < 0.2


def test_what_needs_the_whole_picture_is_refused():
    with pytest.raises(InputError, match="expected no vignetting in the closed loop"):
        faulty_cameras.check(camera_faults.Params(vignetting=jnp.asarray([0.0, 0.5])))
    with pytest.raises(InputError, match="latency: expected up to 3 frames, got 4"):
        faulty_cameras.check(camera_faults.Params(latency=4))
    faulty_cameras.check(camera_faults.Params(noise=1.0, latency=3))
