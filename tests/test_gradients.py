"""Derivatives of every component between eyes and servos: reverse mode, forward mode and central differences agree.

Those of the camera are tested in `sensors/test_camera.py`, of the contact solver in `body/test_implicit_step.py`, and
of whole frames in `learning/test_rollout_gradient.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_derivatives_agree

from lgmdjax.body import hexapod
from lgmdjax.control import names, navigator
from lgmdjax.detectors import lgmd
from lgmdjax.locomotion import cpg, kinematics, shaping

RNG = np.random.default_rng(7)


def weighted_sum(tree):
    """Return the sum of all elements with a different weight for each."""
    return sum(jnp.sum(leaf * jnp.cos(1 + jnp.arange(leaf.size)).reshape(leaf.shape)) for leaf in jax.tree.leaves(tree))


def test_lgmd():
    """With smooth thresholds, with respect to parameters and pictures."""
    pictures = jnp.asarray(RNG.uniform(100, 130, (6, 12, 16)))
    params = lgmd.Params(threshold=5.0, suppression=12.0, smooth=True)

    def loss(inputs):
        params, pictures = inputs
        _, response = jax.lax.scan(
            lambda state, picture: lgmd.step(params, state, picture), lgmd.init(params, pictures[0]), pictures[1:]
        )
        return weighted_sum(response)

    assert_derivatives_agree(loss, (jax.tree.map(lambda x: jnp.asarray(x, float), params), pictures))


def test_cpg_over_three_cycles():
    params = jax.tree.map(lambda x: jnp.asarray(x, float), cpg.Params())
    steps = 180
    start = cpg.init(params, jax.random.key(1))

    def loss(params):
        # With respect to the drive too, although the start was scaled by it.
        _, rhythm = jax.lax.scan(lambda s, _: cpg.step(params, s, 3 * cpg.CYCLE_TIME / steps), start, length=steps)
        return weighted_sum(rhythm)

    assert_derivatives_agree(loss, params, rtol=1e-5)


def test_shaping():
    params, rhythm = shaping.load_pretrained(), jnp.asarray(RNG.normal(size=(6, 2)))
    inputs = (params, rhythm, jnp.asarray([1.1, 0.7]))
    assert_derivatives_agree(lambda inputs: weighted_sum(shaping.apply(*inputs)), inputs)


@pytest.mark.parametrize("variant", names.VARIANTS)
def test_navigator_over_a_window(variant):
    params, u = navigator.create(jax.random.key(2), variant), jnp.asarray(RNG.uniform(0.5, 1.0, (60, 2)))

    def loss(inputs):
        params, u = inputs
        _, velocity = jax.lax.scan(lambda s, u: navigator.step(params, s, u), navigator.init(params), u)
        return weighted_sum(velocity)

    assert_derivatives_agree(loss, (params, u))


def test_kinematics_of_the_legs():
    geometry = kinematics.read_geometry(hexapod.load())
    angles = jnp.asarray(hexapod.stance() + RNG.uniform(-0.3, 0.3, (6, 3)))
    assert_derivatives_agree(lambda angles: weighted_sum(kinematics.forward(geometry, angles)), angles)
    feet = kinematics.forward(geometry, angles)
    assert_derivatives_agree(lambda feet: weighted_sum(kinematics.inverse(geometry, feet)), feet)
