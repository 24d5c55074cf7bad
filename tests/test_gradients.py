"""Every part between the eyes and the servos has one derivative, by reverse mode, forward mode and differences.

The camera's stand in test_camera, the solver's in test_implicit, those of whole frames in test_imitation.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slopes import assert_three_ways_agree

from lgmdjax.body import hexapod
from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.locomotion import cpg, kinematics, shaping

RNG = np.random.default_rng(7)


def weighed(tree):
    """Sum with weights that are blind to nothing."""
    return sum(jnp.sum(leaf * jnp.cos(1 + jnp.arange(leaf.size)).reshape(leaf.shape)) for leaf in jax.tree.leaves(tree))


def test_lgmd():
    """Its smooth form, in parameters and pictures."""
    pictures = jnp.asarray(RNG.uniform(100, 130, (6, 12, 16)))
    params = lgmd.Params(threshold=5.0, suppression=12.0, smooth=True)

    def told(params, pictures):
        _, response = jax.lax.scan(
            lambda state, picture: lgmd.step(params, state, picture), lgmd.init(params, pictures[0]), pictures[1:]
        )
        return weighed(response)

    numbers = jax.tree.map(lambda x: jnp.asarray(x, float), params)
    assert_three_ways_agree(lambda both: told(*both), (numbers, pictures))


def test_cpg_over_three_cycles():
    params = jax.tree.map(lambda x: jnp.asarray(x, float), cpg.Params())
    steps = 180
    start = cpg.init(params, jax.random.key(1))

    def told(params):
        # Of the drive too, by which the start was scaled.
        _, rhythm = jax.lax.scan(lambda s, _: cpg.step(params, s, 3 * cpg.CYCLE_TIME / steps), start, length=steps)
        return weighed(rhythm)

    assert_three_ways_agree(told, params, rtol=1e-5)


def test_shaping():
    params, rhythm = shaping.taught(), jnp.asarray(RNG.normal(size=(6, 2)))
    both = (params, rhythm, jnp.asarray([1.1, 0.7]))
    assert_three_ways_agree(lambda both: weighed(shaping.shape(*both)), both)


@pytest.mark.parametrize("variant", navigator.VARIANTS)
def test_window_of_the_navigator(variant):
    params, u = navigator.create(jax.random.key(2), variant), jnp.asarray(RNG.uniform(0.5, 1.0, (60, 2)))

    def told(params, u):
        _, velocity = jax.lax.scan(lambda s, u: navigator.step(params, s, u), navigator.init(params), u)
        return weighed(velocity)

    assert_three_ways_agree(lambda both: told(*both), (params, u))


def test_kinematics_of_the_legs():
    geometry, angles = (
        kinematics.geometry(hexapod.load()),
        jnp.asarray(hexapod.stance() + RNG.uniform(-0.3, 0.3, (6, 3))),
    )
    assert_three_ways_agree(lambda angles: weighed(kinematics.forward(geometry, angles)), angles)
    feet = kinematics.forward(geometry, angles)
    assert_three_ways_agree(lambda feet: weighed(kinematics.inverse(geometry, feet)), feet)
