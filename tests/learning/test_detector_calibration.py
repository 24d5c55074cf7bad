"""Responses of detectors to recorded walks, and the constants that are chosen on them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from flax import struct

from lgmdjax.control import controller
from lgmdjax.control.policies import SWITCH
from lgmdjax.detectors import emd, lgmd, scaled
from lgmdjax.errors import InputError
from lgmdjax.learning import detector_calibration, detector_responses
from lgmdjax.simulation import assembly
from lgmdjax.simulation.episodes import Walk

ROBOTS, FRAMES, SHAPE = 2, 400, (30, 40)


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


@struct.dataclass
class Response:
    u: jax.Array
    excitation: jax.Array
    feed_forward: jax.Array


class Brightness:
    """A detector whose excitation is the grey level above a threshold, in hundredths, unless it is suppressed."""

    @struct.dataclass
    class Params:
        threshold: float = 100.0
        suppression: float = 0.01

    @staticmethod
    def init(params, frame):
        return ()

    @staticmethod
    def step(params, state, frame):
        level = jnp.mean(frame)
        excitation = jnp.maximum(level - params.threshold, 0.0) / 100.0
        shown = jnp.where(level > params.suppression, 0.0, excitation)
        return (), Response(u=jax.nn.sigmoid(shown), excitation=excitation, feed_forward=level)


@pytest.fixture(scope="module")
def walks():
    """Walks whose pictures are as bright on each side, in grey levels, as ten times its proximity."""
    rng = np.random.default_rng(0)
    proximity = 0.5 + np.repeat(rng.uniform(0, 2, (ROBOTS, FRAMES // 50, 2)), 50, axis=1)
    record = synthetic.walk(ROBOTS, FRAMES, distances=1 / proximity)
    pictures = np.broadcast_to(10.0 * proximity[..., None, None], (*proximity.shape, *SHAPE))
    return record, pictures


def test_responses_are_those_of_one_step_after_the_other(robot):
    """With a reset in frame 3 of the second robot."""
    pictures = np.random.default_rng(1).uniform(90, 110, (2, 6, 2, 12, 16))
    is_first = np.zeros((2, 6), bool)
    is_first[:, 0] = is_first[1, 3] = True
    params = replace(robot.controller, detector=lgmd.Params(threshold=2.0), detector_model=lgmd)
    found = detector_responses.respond(params, pictures, is_first)
    detect = jax.jit(controller.detect_or_start)
    for k in range(2):
        state = controller.init(params, jnp.zeros((2, 12, 16)), SWITCH, jax.random.key(0))
        for frame in range(6):
            state, response = detect(params, state, jnp.asarray(pictures[k, frame]), jnp.asarray(is_first[k, frame]))
            np.testing.assert_allclose(found.u[k, frame], response.u, rtol=1e-9)
    assert found.u[1, 3, 0] == 0.5 != found.u[0, 3, 0]


def test_walks_get_the_responses_of_other_detectors(robot):
    record = synthetic.walk(2, 8)
    own = [
        Walk(**{name: value[k] for name, value in vars(record).items()}, episode=0, robot=k, room=k, seed=0)
        for k in range(2)
    ]
    pictures = np.random.default_rng(2).uniform(90, 110, (2, 8, 2, 12, 16))
    params = replace(robot.controller, detector=emd.Params(), detector_model=emd)
    walked = detector_responses.with_responses(own, params, pictures)
    responses = detector_responses.respond(params, pictures, record.is_first)
    for k, walk in enumerate(walked):
        np.testing.assert_allclose(walk.u, responses.u[k])
        np.testing.assert_array_equal(walk.position, own[k].position)
    assert np.all(walked[0].feed_forward == 0) and np.ptp(walked[0].u) > 0


def test_a_detector_of_brightness_is_fitted_to_dim_pictures(robot, walks):
    """Its threshold of 100 grey is passed with a contrast of 8 or more; cells make no difference."""
    record, pictures = walks
    fitted, rows = detector_calibration.calibrate(robot, Brightness, Brightness.Params(), record, pictures)
    detector = fitted.controller.detector
    assert fitted.controller.detector_model is scaled and detector.model is Brightness
    assert len(rows) == len(detector_calibration.POOLINGS) * len(detector_calibration.CONTRASTS)
    (chosen,) = [row for row in rows if row["chosen"]]
    assert chosen["score"] == max(row["score"] for row in rows) > 0.9
    assert all(row["score"] == detector_calibration.NO_RESPONSE for row in rows if row["contrast"] < 4)
    assert float(detector.contrast) == chosen["contrast"] >= 8
    brightest = 10.0 * (1 / record.distances).max()
    steady = slice(60, -60)  # the rest is too near to the ends to be averaged
    largest = chosen["contrast"] * 10.0 * (1 / record.distances[:, steady]).max()
    assert float(detector.detector.suppression) == pytest.approx(1.25 * largest, rel=0.1)
    assert largest <= chosen["contrast"] * brightest
    u = detector_responses.respond(fitted.controller, pictures, record.is_first).u[:, steady]
    assert np.quantile(u, 0.9) == pytest.approx(0.9, abs=0.01)


def test_what_cannot_be_calibrated_is_refused(robot, walks):
    record, pictures = walks
    with pytest.raises(InputError, match=r"expected 10 s or more of walking, got 0\.0 s"):
        short = jax.tree.map(lambda leaf: leaf[:, :40], record)
        detector_calibration.calibrate(robot, Brightness, Brightness.Params(), short, pictures[:, :40])
    with pytest.raises(InputError, match="detector Brightness: expected a response in a tenth of the frames for some"):
        blind = Brightness.Params(threshold=1e9)
        detector_calibration.calibrate(robot, Brightness, blind, record, pictures)
