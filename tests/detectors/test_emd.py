"""Correlation detectors: each cell by cell; tuning of the EMD; what regressive and what outward motion is."""

from dataclasses import replace
from functools import partial

import clips
import jax.numpy as jnp
import numpy as np
import pytest
from reference import emd as reference

from lgmdjax.detectors import emd, grm, lplc2
from lgmdjax.errors import InputError
from lgmdjax.sensors import stimuli

FRAMES = clips.blobs(7, 100.0, 9, 12)


def test_emd_equals_the_equations_cell_by_cell(strict):
    response = clips.respond(emd, emd.Params(), FRAMES)
    names = ("u", "excitation", "rightward", "upward")
    clips.assert_equals_reference(response, reference.emd(FRAMES), names, 1e-6)


def test_grm_equals_the_equations_cell_by_cell(strict):
    for frames in (FRAMES, FRAMES[:, :, :-1]):  # with a middle column of detectors, and without
        response = clips.respond(grm, grm.Params(), frames)
        clips.assert_equals_reference(response, reference.grm(frames), ("u", "excitation", "left", "right"), 1e-6)


def test_grm_of_a_hemifield_takes_all_motion_to_the_right(strict):
    response = clips.respond(grm, grm.Params(hemifield=True), FRAMES)
    rightward = [np.maximum(reference.motion(H, D)[0], 0).mean() for H, D in reference.signals(FRAMES)]
    np.testing.assert_allclose(response.excitation, rightward, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(response.left, response.excitation)


def test_lplc2_equals_the_equations_cell_by_cell(strict):
    response = clips.respond(lplc2, replace(lplc2.create(5), intercept=-0.1), FRAMES)
    clips.assert_equals_reference(response, reference.lplc2(FRAMES, b_e=-0.1), ("u", "excitation"), 1e-6)


def grating_response(wavelength, frequency, rate=1000, cells=24):
    """Return the mean motion to the right, for a grating that moves to the right, over its last period."""
    times = np.arange(3 * rate) / rate
    x = np.arange(cells)
    phase = 2 * np.pi * (x[None, None] / wavelength - frequency * times[:, None, None])
    frames = 127.5 + 127.5 * 0.1 * np.sin(phase) * np.ones((1, 2, 1))
    params = emd.Params(frame_time=1 / rate, adaptation_time=1.0)
    return np.asarray(clips.respond(emd, params, frames).rightward)[-round(rate / frequency) :].mean()


@pytest.mark.parametrize(("wavelength", "frequency"), [(8.0, 3.0), (4.8, 1.0), (1.6, 3.0), (-8.0, 3.0)])
def test_emd_has_the_tuning_of_reichardt(wavelength, frequency):
    """The closed form: direction, aliasing of gratings finer than two cells, and the optimum at w tau = 1."""
    w, tau = 2 * np.pi * frequency, 0.05
    passed = (w * 1.0) ** 2 / (1 + (w * 1.0) ** 2)
    expected = 0.05**2 * passed * np.sin(2 * np.pi / wavelength) * w * tau / (1 + (w * tau) ** 2)
    assert grating_response(wavelength, frequency) == pytest.approx(expected, rel=0.06)


def test_grm_answers_to_motion_toward_the_front_alone():
    """A square that circles to the left moves to the front while it is on the right, and to the back afterwards."""
    response = clips.respond(grm, grm.Params(), clips.translation(1.0, half_angle=0.2, seconds=2.0))
    right, excitation = np.asarray(response.right), np.asarray(response.excitation)
    assert right[5:20].min() > 20 * excitation[45:].max()
    ahead = clips.respond(grm, grm.Params(), clips.approach()).excitation.max()
    assert ahead < 1e-3 * excitation.max()


def test_lplc2_prefers_outward_motion():
    """Klapoetke et al.: expansion, neither contraction nor motion of the whole field, and little of one bar."""
    turn = clips.movie(partial(stimuli.yaw, clips.CAMERA, 0.5), np.arange(30) / 30)
    grating = clips.movie(partial(stimuli.grating, clips.CAMERA, 0.5, 0.5), np.arange(30) / 30)
    params = lplc2.Params()

    def peak(frames):
        return float(clips.respond(lplc2, params, frames).excitation.max())

    approach = peak(clips.approach())
    assert approach > 0.1
    assert peak(clips.inverted(clips.approach())) == pytest.approx(approach, rel=0.02)  # of either contrast
    assert peak(clips.approach()[::-1]) < 0.3 * approach
    assert peak(clips.translation(1.0)) < 0.1 * approach
    assert peak(turn) == peak(grating) == 0


def test_lplc2_adds_up_four_directions_more_than_in_proportion():
    """A bar that grows in two directions excites less than half as much as a square that grows in four."""
    square = np.full((12, 24, 32), 160.0)
    bar = square.copy()
    for k in range(12):
        square[k, 11 - k : 13 + k, 15 - k : 17 + k] = 40.0
        bar[k, 10:14, 15 - k : 17 + k] = 40.0
    middle = [np.asarray(clips.respond(lplc2, lplc2.Params(), f).units)[:, 5:7, 7:9].max() for f in (square, bar)]
    assert 0 <= 2 * middle[1] < middle[0]


@pytest.mark.usefixtures("unchecked")
def test_unsuitable_frames_and_sizes_are_refused():
    state = emd.init(emd.Params(), jnp.zeros((6, 8)))
    with pytest.raises(InputError, match=r"8 x 6 cells as before, got 8 x 5"):
        emd.step(emd.Params(), state, jnp.zeros((5, 8)))
    with pytest.raises(InputError, match=r"expected an odd number.*got 4"):
        lplc2.create(4)
