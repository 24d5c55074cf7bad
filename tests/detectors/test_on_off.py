"""LGMD1 with ON and OFF channels, and LGMD2: the programs cell by cell, selectivity to motion and to contrast."""

import clips
import jax.numpy as jnp
import numpy as np
import pytest
from reference import on_off as reference

from lgmdjax.detectors import lgmd1_onoff, lgmd2, on_off
from lgmdjax.errors import InputError

WEAK, STRONG = clips.blobs(5, 12.0), clips.blobs(5, 70.0, seed=1)


def test_lgmd1_equals_the_program_cell_by_cell(strict):
    """With changes that T_FFI suppresses and others that it does not."""
    frames = np.concatenate([STRONG, WEAK])
    expected = reference.lgmd1_onoff(frames, 5.0, 25.0, 0.01)
    params = lgmd1_onoff.Params(threshold=5.0, suppression=25.0, joint_weight=0.01)
    response = clips.respond(lgmd1_onoff, params, frames)
    clips.assert_equals_reference(response, expected, ("u", "potential", "excitation", "feed_forward"))
    assert {frame["feed_forward"] >= 25 for frame in expected} == {True, False}


def test_lgmd2_equals_the_program_cell_by_cell(strict):
    """Below and above the change at which mediation raises inhibition."""
    frames = np.concatenate([WEAK, STRONG, WEAK])
    expected = reference.lgmd2(frames)
    response = clips.respond(lgmd2, lgmd2.Params(), frames)
    clips.assert_equals_reference(response, expected, ("u", "potential", "excitation", "mediation"))
    assert {frame["mediation"] > 8 for frame in expected} == {True, False}


@pytest.mark.parametrize("l_over_v", [0.05, 0.3])
def test_lgmd1_responds_to_approach_of_either_contrast_and_not_to_translation(l_over_v):
    params, approach, translation = lgmd1_onoff.Params(), clips.approach(l_over_v), clips.translation(1.0)
    for frames in (approach, clips.inverted(approach)):
        assert clips.respond(lgmd1_onoff, params, frames).u.max() > 0.8
    for frames in (translation, clips.inverted(translation)):
        assert clips.respond(lgmd1_onoff, params, frames).u.max() < 0.55


@pytest.mark.parametrize("l_over_v", [0.05, 0.1, 0.3])
def test_lgmd2_responds_to_dark_approach_alone(l_over_v):
    """Neither to a bright approach nor to a dark recession, in which everything brightens: the paper's selectivity."""
    dark, bright = clips.approach(l_over_v), clips.inverted(clips.approach(l_over_v))
    assert clips.respond(lgmd2, lgmd2.Params(), dark).u.max() > 0.9
    for frames in (bright, dark[::-1]):
        np.testing.assert_array_equal(clips.respond(lgmd2, lgmd2.Params(), frames).u, 0.5)


def test_the_response_to_steady_motion_adapts_and_that_to_accelerating_motion_does_not():
    """A potential that jumps and stays decays with the time constant; one that keeps rising is followed."""
    kept = 0.8 / (0.8 + 1 / 30)

    def adapted(potentials):
        state, u = on_off.rest(jnp.zeros((1, 1))), []
        for potential in potentials:
            state = on_off.adapt(state, jnp.asarray(potential), 1 / 30, 0.8, 0.003)
            u.append(float(state.adapted))
        return np.asarray(u)

    np.testing.assert_allclose(adapted(np.full(20, 0.9)), np.maximum(0.9 * kept ** np.arange(1, 21), 0.5))
    rising = np.linspace(0.6, 0.9, 20)
    np.testing.assert_allclose(adapted(rising), kept * rising)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("detector", [lgmd1_onoff, lgmd2])
def test_unsuitable_frames_are_refused(detector):
    state = detector.init(detector.Params(), jnp.zeros((6, 8)))
    with pytest.raises(InputError, match=r"8 x 6 cells as before, got 8 x 5"):
        detector.step(detector.Params(), state, jnp.zeros((5, 8)))
    with pytest.raises(InputError, match=r"uint8"):
        detector.init(detector.Params(), jnp.zeros((6, 8), jnp.uint8))
