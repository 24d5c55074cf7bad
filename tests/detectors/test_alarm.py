"""The alarm: its equations as weighted sums, and what raises it: growth, neither motion that goes on nor light."""

from functools import partial

import clips
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import alarm as reference

from lgmdjax.detectors import alarm, emd
from lgmdjax.errors import InputError

FRAMES = 60
SHAPE = (FRAMES, clips.CAMERA.height, clips.CAMERA.width)  # one for all tests, which share a program


@jax.jit
def _scan(params, frames, excitation):
    inputs = alarm.AlarmInput(frame=frames[1:], excitation=excitation[1:])
    return jax.lax.scan(partial(alarm.step, params), alarm.init(params, frames[0]), inputs)[1]


def respond(frames, excitation, **changes):
    assert frames.shape == SHAPE
    params = jax.tree.map(lambda x: jnp.asarray(x, float), alarm.Params(**changes))
    return _scan(params, jnp.asarray(frames, float), jnp.asarray(excitation, float))


def looming(frames):
    """Return the alarm's response to the correlators, which have seen no change in the first frame."""
    excitation = clips.respond(emd, emd.Params(), frames).excitation
    return respond(frames, np.concatenate([[0.0], excitation]))


@pytest.mark.parametrize("persistence", [0.0, 0.2])
def test_equals_weighted_sums_over_all_frames(strict, persistence):
    generator = np.random.default_rng(3)
    frames = clips.blobs(*SHAPE[:1], 40.0, *SHAPE[1:], seed=3) + 2.0 * np.arange(FRAMES)[:, None, None]
    frames[10:13] = frames[9]  # repeated frames
    excitation = 1.15 ** np.arange(FRAMES) * generator.uniform(0.3, 1, FRAMES)
    response = respond(frames, excitation, persistence=persistence)
    expected = reference.alarm(frames, excitation, persistence=persistence, block=2)
    clips.assert_equals_reference(response, expected, ("adapted", "whole_field", "alarm"), 1e-6)


def test_growth_raises_it_in_any_unit_and_what_goes_on_does_not():
    frames = clips.noise(*SHAPE)
    growing = 1.1 ** np.arange(FRAMES)
    reference_response = respond(frames, growing)
    assert reference_response.alarm[-1] == 1 and reference_response.alarm[:10].max() == 0
    for unit in (1e-6, 1e6):
        np.testing.assert_allclose(respond(frames, unit * growing).adapted, reference_response.adapted, rtol=1e-5)
    steady = respond(frames, np.full(FRAMES, 7.0))
    np.testing.assert_allclose(steady.adapted, 0.5, atol=0.1)  # the medians of noise differ by chance
    assert steady.alarm.max() == 0


def test_motion_after_stillness_has_no_scale_to_rise_above():
    """A stimulus that begins suddenly and goes on, and one that begins suddenly and fades."""
    frames = clips.noise(*SHAPE)
    frames[:20] = frames[0]
    begun = np.where(np.arange(FRAMES) < 20, 0.0, 5.0)
    assert respond(frames, begun).alarm.max() == 0
    assert respond(frames, begun * 0.9 ** np.arange(FRAMES)).alarm.max() == 0


def test_a_change_of_light_is_not_seen():
    light = np.where(np.arange(FRAMES) < 30, 40.0, 160.0)[:, None, None] * np.ones(SHAPE)
    response = respond(light, np.abs(np.diff(light.mean((1, 2)), prepend=40.0)))
    assert response.whole_field[30:].min() == 1 and response.alarm.max() == 0


def test_approach_raises_it_and_recession_does_not():
    approach = clips.approach(seconds=(FRAMES - 1) / 30)
    assert looming(approach).alarm[-1] == 1
    assert looming(approach[::-1]).alarm.max() == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"threshold": 0.5}, "0.5"), ({"threshold": float("nan")}, "nan"), ({"persistence": -1.0}, "-1.0")],
)
def test_constants_that_make_no_sense_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        alarm.check(alarm.Params(**changes))
