"""Fits of detectors by gradient, against correlations, ranks and differences that NumPy computes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from flax import struct
from scipy import ndimage

from lgmdjax.detectors import emd, lgmd, lgmd2, lplc2, scaled
from lgmdjax.errors import InputError
from lgmdjax.evaluation import stimulus_clips, stimulus_scores
from lgmdjax.evaluation.settings import STIMULUS_SCALES
from lgmdjax.learning import detector_fit, detector_objectives
from lgmdjax.learning.detector_objectives import Stimuli, Walks
from lgmdjax.learning.settings import DetectorFitSettings
from lgmdjax.simulation import assembly

SETTINGS = DetectorFitSettings(steps=12, eval_every=3, learning_rate=0.1)


def fitted(model, **constants):
    return scaled.Params(model=model, detector=model.Params(**constants))


def test_constants_are_numbers_that_do_something():
    names = set(detector_fit.constants(fitted(lgmd, suppression=jnp.inf)))
    assert names == {"contrast", "gain", "detector.threshold", "detector.inhibition", "detector.kernel"}
    own = set(detector_fit.constants(fitted(lgmd2, joint_weight=0.0)))
    assert "detector.joint_weight" not in own and "detector.on_kernel" in own  # zero switches a mechanism off


@pytest.mark.parametrize("model", [lgmd, lplc2])
def test_constants_keep_their_signs(model):
    start = fitted(model)
    before, rng = detector_fit.constants(start), np.random.default_rng(0)
    factors = {name: jnp.asarray(rng.normal(size=value.shape)) for name, value in before.items()}
    after = detector_fit.constants(detector_fit.move(start, factors))
    for name, value in before.items():
        if value.all():
            np.testing.assert_allclose(after[name], value * np.exp(factors[name]))
        else:
            moved = value + np.sqrt(np.mean(value**2)) * factors[name]
            np.testing.assert_allclose(after[name], np.maximum(moved, 0), atol=1e-12)
    same = detector_fit.move(start, {name: jnp.zeros(value.shape) for name, value in before.items()})
    jax.tree.map(np.testing.assert_allclose, same, start)


def test_thresholds_are_smooth_during_the_fit_alone():
    smooth = detector_fit.smooth(fitted(lgmd2, threshold_width=3.0), 0.5).detector
    assert smooth.smooth and smooth.threshold_width == 1.5 and not fitted(lgmd2).detector.smooth
    assert detector_fit.smooth(fitted(emd), 0.5) == fitted(emd)  # has no thresholds


@pytest.fixture(scope="module")
def stimuli():
    clips = stimulus_clips.selection(STIMULUS_SCALES["smoke"])
    return Stimuli(frames=clips.frames, approaches=np.array([name.startswith("approach") for name in clips.names]))


def test_the_loss_of_stimuli_compares_all_pairs_of_peaks(stimuli):
    params = fitted(emd)
    peaks = np.asarray(detector_objectives.peaks(params, jnp.asarray(stimuli.frames)))
    largest = np.array([largest_response(clip) for clip in stimuli.frames])
    np.testing.assert_allclose(peaks, np.log(largest / (1 - largest)), rtol=1e-9, atol=1e-9)
    z = (peaks - peaks.mean()) / peaks.std()
    losses = [np.log1p(np.exp(-(a - o) / 0.3)) for a in z[stimuli.approaches] for o in z[~stimuli.approaches]]
    assert float(stimuli.loss(params, jnp.asarray(stimuli.frames))) == pytest.approx(np.mean(losses), rel=1e-6)
    above = [(a > o) + 0.5 * (a == o) for a in peaks[stimuli.approaches] for o in peaks[~stimuli.approaches]]
    assert stimuli.score(params) == pytest.approx(np.mean(above))
    assert float(stimuli.loss(replace(params, gain=3.0), jnp.asarray(stimuli.frames))) == pytest.approx(np.mean(losses))


def largest_response(clip):
    state, found = emd.init(emd.Params(), jnp.asarray(clip[0])), []
    for frame in clip[1:]:
        state, response = jax.jit(emd.step)(emd.Params(), state, jnp.asarray(frame))
        found.append(float(response.u))
    return max(found[stimulus_scores.FIRST :])


@pytest.fixture(scope="module")
def walks():
    rng, frames = np.random.default_rng(0), 150
    pictures = ndimage.gaussian_filter(rng.uniform(0, 255, (4, frames, 2, 12, 16)), (0, 1, 0, 1, 1))
    near = 1 + rng.uniform(0, 2, (4, frames, 2))
    record = synthetic.walk(4, frames, distances=near, contact=np.zeros((4, frames), bool))
    record.contact[1, 40] = True
    return Walks(robot=assembly.load_robot().controller, record=record, pictures=pictures)


def test_windows_are_stretches_without_contact(walks):
    robots, firsts = walks.starts
    ends = firsts + detector_objectives.FRAMES
    assert {0, 2, 3} <= set(robots.tolist()) and ends.max() == 150
    assert not np.any((robots == 1) & (firsts <= 40) & (ends > 40))
    windows = walks.sample(3, np.random.default_rng(1))
    assert windows.pictures.shape == (3, detector_objectives.FRAMES, 2, 12, 16)
    with pytest.raises(InputError, match=r"expected 3\.8 s or more of walking at a stretch, got none"):
        _ = replace(walks, record=jax.tree.map(lambda leaf: leaf[:, :100], walks.record)).starts


def test_the_loss_of_walks_is_one_minus_a_correlation(walks):
    params, rng = fitted(emd), np.random.default_rng(1)
    windows = walks.sample(2, rng)
    eyes = replace(walks.robot, detector=params, detector_model=scaled)
    pairs = []
    for pictures, proximity in zip(np.asarray(windows.pictures), np.asarray(windows.proximity), strict=True):
        u = np.array(detector_objectives._respond_stereo(eyes, jnp.asarray(pictures)))[detector_objectives.SETTLE - 1 :]
        difference = u[:, 0] - u[:, 1]
        averaged = [difference[k : k + 24].mean() for k in range(len(difference) - 23)]
        pairs.append((averaged, proximity[:, 0] - proximity[:, 1]))
    averaged, proximity = (np.concatenate(part) for part in zip(*pairs, strict=True))
    r = np.corrcoef(averaged, proximity)[0, 1]
    assert float(walks.loss(params, windows)) == pytest.approx(1 - r, abs=1e-6)


def test_the_average_is_compared_with_proximity_in_its_middle(walks):
    """A detector that saw proximity itself would have a correlation near that of the average with its middle."""
    ramp = np.broadcast_to(np.arange(150.0)[:, None], (4, 150, 2)) * [1, -1]
    record = replace(walks.record, distances=1 / (400 + ramp), contact=np.zeros((4, 150), bool))
    windows = replace(walks, record=record).sample(2, np.random.default_rng(0))
    first = np.asarray(windows.proximity)[:, 0, 0] - 400
    _, firsts = replace(walks, record=record).starts
    chosen = firsts[np.random.default_rng(0).choice(len(firsts), 2)]
    np.testing.assert_allclose(first, chosen + detector_objectives.SETTLE + 12)


@pytest.mark.parametrize("data", ["stimuli", "walks"])
def test_derivatives_are_those_of_differences(data, request):
    objective, start = request.getfixturevalue(data), fitted(emd, gain=300.0)
    batch = (
        objective.sample(2, np.random.default_rng(0)) if data == "walks" else objective.sample(np.random.default_rng(0))
    )

    @jax.jit
    def loss(x):
        factors = {"detector.delay": x[0], "detector.gain": x[1], "contrast": x[2]}
        return objective.loss(detector_fit.move(start, factors), batch)

    slope, step = jax.grad(loss)(jnp.zeros(3)), 1e-5
    differences = [(loss(step * e) - loss(-step * e)) / (2 * step) for e in jnp.eye(3)]
    np.testing.assert_allclose(slope, differences, rtol=1e-4, atol=1e-7)


def test_a_fit_finds_a_constant_that_had_been_spoilt(stimuli):
    spoilt = fitted(emd, delay=2.0, adaptation_time=0.004, gain=300.0)
    found, curve = detector_fit.fit(
        spoilt, stimuli.loss, stimuli.sample, stimuli.score, SETTINGS, seed=0, label="spoilt"
    )
    assert [row["step"] for row in curve] == [0, 3, 6, 9, 12]
    assert curve[-1]["loss"] < curve[1]["loss"]
    assert stimuli.score(found) == max(row["score"] for row in curve) >= stimuli.score(spoilt)


@struct.dataclass(kw_only=True)
class Params:
    gain: float = 1.0


@struct.dataclass(kw_only=True)
class Response:
    u: jax.Array
    excitation: jax.Array


class Root:
    """A detector whose derivative is infinite, since the root of zero is taken."""

    Params = Params

    def init(self, params, frame):
        return frame

    def step(self, params, state, frame):
        change = jnp.sqrt(params.gain * jnp.mean(jnp.abs(frame - state)) * 0)
        return frame, Response(u=jax.nn.sigmoid(change), excitation=change)


def test_an_infinite_derivative_is_refused(stimuli):
    with pytest.raises(InputError, match=r"bad: expected a finite loss and derivative, got .* nan"):
        detector_fit.fit(
            scaled.Params(model=Root(), detector=Params()),
            stimuli.loss,
            stimuli.sample,
            stimuli.score,
            SETTINGS,
            seed=0,
            label="bad",
        )
