"""The step that is differentiated at the solver's solution: MJX's own forward, C MuJoCo's derivative backward."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from slopes import QUICKLY_COMPILED, assert_three_ways_agree

from lgmdjax.body import hexapod, implicit_step
from lgmdjax.errors import InputError

STEPS = 25


@pytest.fixture(scope="module")
def model():
    return hexapod.build()


@pytest.fixture(scope="module")
def targets():
    """Set points that stray from the stance at random: feet slip, come off the floor and meet it again."""
    strays = 0.03 * np.random.default_rng(0).normal(size=(STEPS, 6, 3)).cumsum(axis=0)
    return jnp.asarray(hexapod.stance() + strays)


def walked(model, targets, step=implicit_step.step):
    """Stand a robot on the floor and step; what all steps leave behind."""

    def forward(data, wanted):
        with jax.numpy_dtype_promotion("standard"):
            data = step(model, data.replace(ctrl=wanted.reshape(18).astype(data.ctrl.dtype)))
        return data, (data.qpos, data.qvel, data.qacc, data.qfrc_constraint, data._impl.efc_force)

    return jax.lax.scan(forward, hexapod.reset(model, jnp.zeros(3)), targets)[1]


@pytest.mark.usefixtures("float32")
def test_walks_as_the_stock_solver_to_the_last_bit(targets):
    """In single precision, as users walk."""
    model, wanted = hexapod.build(), jnp.asarray(targets, dtype=float)
    ours, theirs = (
        jax.jit(lambda wanted, step=step: walked(model, wanted, step))(wanted)
        for step in (implicit_step.step, mjx.step)
    )
    assert np.abs(theirs[1]).max() > 1  # it does move
    assert np.any(theirs[4][:, -1] != theirs[4][0, -1])
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


@pytest.mark.slow
def test_25_steps_on_soft_contacts_have_one_derivative_by_three_routes(model, targets):
    """That of acceleration and forces, too, which are the solver's own."""
    model = hexapod.softened(model)

    def told(wanted):
        return sum(jnp.sum(jnp.cos(rows)) for rows in walked(model, wanted)[:4])

    assert_three_ways_agree(told, targets, step=1e-7, rtol=1e-5)


def test_one_step_has_the_derivative_that_c_mujoco_finds_by_differences(model, targets):
    """Of the velocity after a step by the set points, feet on the floor and slipping: `mjd_transitionFD`."""
    body = hexapod.load()
    body.opt.iterations, body.opt.tolerance = 100, 1e-12
    there = mujoco.MjData(body)
    mujoco.mj_resetDataKeyframe(body, there, body.key("stance").id)
    for wanted in targets[:10]:
        there.ctrl[:] = np.asarray(wanted).ravel()
        mujoco.mj_step(body, there)
    assert there.ncon >= 3
    by_control = np.zeros((2 * body.nv, body.nu))
    mujoco.mjd_transitionFD(body, there, 1e-6, True, None, by_control, None, None)

    here = hexapod.reset(model, jnp.zeros(3))
    here = here.replace(qpos=jnp.asarray(there.qpos), qvel=jnp.asarray(there.qvel))

    def velocity(wanted):
        return hexapod.substep(model, here, wanted).qvel

    ours = jax.jit(jax.jacrev(velocity), compiler_options=QUICKLY_COMPILED)(jnp.asarray(there.ctrl).reshape(6, 3))
    theirs = by_control[body.nv :]
    assert np.abs(theirs).max() > 0.1
    np.testing.assert_allclose(ours.reshape(theirs.shape), theirs, rtol=1e-4, atol=1e-5 * np.abs(theirs).max())


def test_a_version_or_an_integrator_that_it_does_not_know_is_refused(model, monkeypatch):
    with pytest.raises(InputError, match=re.escape('integrator="Euler", got RK4')):
        implicit_step.check(model.replace(opt=model.opt.replace(integrator=mjx.IntegratorType.RK4)))
    monkeypatch.setattr(implicit_step, "version", lambda package: "3.99.1")
    with pytest.raises(InputError, match=re.escape("expected mujoco-mjx 3.17, whose solver")):
        jax.eval_shape(implicit_step.step, model, hexapod.reset(model, jnp.zeros(3)))
