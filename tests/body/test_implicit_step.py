"""The implicitly differentiated step: its values equal those of MJX, its derivatives those of C MuJoCo."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from derivatives import FAST_COMPILE, assert_derivatives_agree
from mujoco import mjx

from lgmdjax.body import hexapod, implicit_step
from lgmdjax.errors import InputError

pytestmark = pytest.mark.optimised

STEPS = 25


@pytest.fixture(scope="module")
def model():
    return hexapod.build()


@pytest.fixture(scope="module")
def targets():
    """Sample set points that deviate from the stance at random: feet slip, leave the floor and touch it again."""
    deviations = 0.03 * np.random.default_rng(0).normal(size=(STEPS, 6, 3)).cumsum(axis=0)
    return jnp.asarray(hexapod.stance() + deviations)


def simulate(model, targets, step=implicit_step.step):
    """Simulate a robot from its stance; return positions, velocities, accelerations and forces of all steps."""

    def forward(data, target):
        with jax.numpy_dtype_promotion("standard"):
            data = step(model, data.replace(ctrl=target.reshape(18).astype(data.ctrl.dtype)))
        return data, (data.qpos, data.qvel, data.qacc, data.qfrc_constraint, data._impl.efc_force)

    return jax.lax.scan(forward, hexapod.init(model, jnp.zeros(3)), targets)[1]


@pytest.mark.usefixtures("float32")
def test_equals_mjx_to_the_last_bit(targets):
    """In single precision, JAX's default."""
    model, targets = hexapod.build(), jnp.asarray(targets, dtype=float)
    ours, theirs = (
        jax.jit(lambda targets, step=step: simulate(model, targets, step))(targets)
        for step in (implicit_step.step, mjx.step)
    )
    assert np.abs(theirs[1]).max() > 1  # the robot moves
    assert np.any(theirs[4][:, -1] != theirs[4][0, -1])
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


@pytest.mark.extended
@pytest.mark.slow
def test_derivatives_of_25_steps_with_soft_contacts_agree(model, targets):
    """Those of acceleration and forces too, whose values are the solver's own."""
    model = hexapod.soften_contacts(model)

    def loss(targets):
        return sum(jnp.sum(jnp.cos(rows)) for rows in simulate(model, targets)[:4])

    assert_derivatives_agree(loss, targets, step=1e-7, rtol=1e-5)


def test_derivative_of_one_step_equals_c_mujocos_finite_difference(model, targets):
    """Of the velocity after a step with respect to the set points, with slipping feet (`mjd_transitionFD`)."""
    body = hexapod.load()
    body.opt.iterations, body.opt.tolerance = 100, 1e-12
    data_c = mujoco.MjData(body)
    mujoco.mj_resetDataKeyframe(body, data_c, body.key("stance").id)
    for target in targets[:10]:
        data_c.ctrl[:] = np.asarray(target).ravel()
        mujoco.mj_step(body, data_c)
    assert data_c.ncon >= 3
    by_control = np.zeros((2 * body.nv, body.nu))
    mujoco.mjd_transitionFD(body, data_c, 1e-6, True, None, by_control, None, None)

    data = hexapod.init(model, jnp.zeros(3))
    data = data.replace(qpos=jnp.asarray(data_c.qpos), qvel=jnp.asarray(data_c.qvel))

    def velocity(targets):
        return hexapod.substep(model, data, targets).qvel

    ours = jax.jit(jax.jacrev(velocity), compiler_options=FAST_COMPILE)(jnp.asarray(data_c.ctrl).reshape(6, 3))
    theirs = by_control[body.nv :]
    assert np.abs(theirs).max() > 0.1
    np.testing.assert_allclose(ours.reshape(theirs.shape), theirs, rtol=1e-4, atol=1e-5 * np.abs(theirs).max())


def test_unsupported_versions_and_integrators_are_rejected(model, monkeypatch):
    with pytest.raises(InputError, match=re.escape("got RK4")):
        implicit_step.check_supported(model.replace(opt=model.opt.replace(integrator=mjx.IntegratorType.RK4)))
    monkeypatch.setattr(implicit_step, "version", lambda package: "3.99.1")
    with pytest.raises(InputError, match=re.escape("expected mujoco-mjx 3.17, whose solver")):
        jax.eval_shape(implicit_step.step, model, hexapod.init(model, jnp.zeros(3)))
