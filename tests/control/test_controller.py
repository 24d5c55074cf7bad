"""Any looming detector in both eyes of the controller, and the interface that it must have."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from lgmdjax.control import controller, policies
from lgmdjax.detectors import emd, eta, lgmd, lgmd1_onoff, protocol
from lgmdjax.errors import InputError
from lgmdjax.locomotion import cpg, shaping

PICTURES = np.random.default_rng(1).uniform(60, 190, (5, 2, 12, 16))  # of the left and the right eye


def make(model, params) -> controller.Params:
    return controller.Params(
        detector=params,
        policy=policies.BlindParams(velocity=jnp.ones(2)),
        cpg=cpg.Params(),
        shaping=shaping.init(jax.random.key(0)),
        detector_model=model,
    )


def respond(params: controller.Params, pictures: np.ndarray) -> list[controller.Response]:
    state = controller.init(params, jnp.asarray(pictures[0]), policies.BLIND, jax.random.key(0))
    responses, detect = [], jax.jit(controller.detect)
    for frames in jnp.asarray(pictures[1:]):
        state, response = detect(params, state, frames)
        responses.append(response)
    return responses


@pytest.mark.parametrize(
    ("model", "params"),
    [(emd, emd.Params()), (lgmd1_onoff, lgmd1_onoff.Params(threshold=5.0, suppression=1e3)), (lgmd, lgmd.Params())],
    ids=lambda value: protocol.name(value) if value in (emd, lgmd1_onoff, lgmd) else "",
)
def test_each_eye_has_its_own_detector_and_the_right_one_sees_the_mirror_image(model, params):
    responses = respond(make(model, params), PICTURES)
    for eye, view in enumerate((PICTURES[:, 0], PICTURES[:, 1, :, ::-1])):
        state = model.init(params, jnp.asarray(view[0]))
        for frame, response in zip(view[1:], responses, strict=True):
            state, alone = jax.jit(model.step)(params, state, jnp.asarray(frame))
            np.testing.assert_allclose(response.u[eye], alone.u, rtol=1e-9)
            np.testing.assert_allclose(response.excitation[eye], alone.excitation, rtol=1e-9)
            np.testing.assert_allclose(response.feed_forward[eye], getattr(alone, "feed_forward", 0.0), rtol=1e-9)


@struct.dataclass
class Response:
    u: jax.Array
    excitation: jax.Array


class Fine:
    """A detector as an object."""

    Params = lgmd.Params

    @staticmethod
    def init(params, frame):
        return frame

    @staticmethod
    def step(params, state, frame):
        change = jnp.mean(jnp.abs(frame - state))
        return frame, Response(u=jax.nn.sigmoid(change), excitation=change)


class Louder(Fine):
    """The same parameters and state, another response."""

    @staticmethod
    def step(params, state, frame):
        change = 2.0 * jnp.mean(jnp.abs(frame - state))
        return frame, Response(u=jax.nn.sigmoid(change), excitation=change)


def test_a_program_for_one_detector_does_not_serve_another():
    respond_once = jax.jit(lambda params: respond(params, PICTURES[:2])[0].excitation)
    one, two = (respond_once(make(model, lgmd.Params())) for model in (Fine, Louder))
    np.testing.assert_allclose(two, 2 * one)


class Integers(Fine):
    @staticmethod
    def init(params, frame):
        return frame.astype(int)


class Maps(Fine):
    @staticmethod
    def step(params, state, frame):
        return frame, Response(u=frame, excitation=frame)


class Silent(Fine):
    @staticmethod
    def step(params, state, frame):
        return frame, jnp.mean(frame)


FRAME = jax.ShapeDtypeStruct((12, 16), jnp.dtype("float64"))


def test_an_object_with_the_interface_is_a_detector():
    protocol.check(Fine(), lgmd.Params(), FRAME)
    assert isinstance(Fine(), protocol.Detector) and isinstance(emd, protocol.Detector)
    assert protocol.name(Fine()) == "Fine" and protocol.identify(emd) == "emd"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (Integers(), "detector Integers: expected a state like .* after a step, got .*; keep shapes and types"),
        (Maps(), r"detector Maps: expected one u and one excitation a frame, got shapes .*\(12, 16\)"),
        (Silent(), "detector Silent: expected init and step for a frame of float64 .*, got .*attribute u"),
        (eta, "detector eta: expected init and step for a frame"),
        (SimpleNamespace(Params=lgmd.Params, init=Fine.init, step=Fine.step), "detector SimpleNamespace: .*unhashable"),
    ],
)
def test_what_cannot_be_scanned_is_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        protocol.check(wrong, lgmd.Params(), FRAME)


def test_own_constants_are_checked_by_the_detector():
    with pytest.raises(InputError, match="lgmd threshold"):
        protocol.check(lgmd, lgmd.Params(threshold=-1.0), FRAME)


def test_what_needs_the_lgmd_says_so():
    with pytest.raises(InputError, match="expected a robot with the detector lgmd for a purpose, got one with emd"):
        controller.require_lgmd(make(emd, emd.Params()), "a purpose")
