"""Faults of servos: delay against interpolation, backlash against a loop, and the faulty body."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from lgmdjax.body import hexapod, servo_faults

INTERVAL = 1 / 180
TIMES = np.arange(200) * INTERVAL
TARGETS = 0.3 * np.sin(2 * np.pi * TIMES[:, None, None] + np.arange(18).reshape(6, 3))


@jax.jit
def run(params: servo_faults.Params) -> jax.Array:
    def step(state: servo_faults.State, targets: jax.Array) -> tuple[servo_faults.State, jax.Array]:
        return servo_faults.step(params, state, targets, INTERVAL)

    targets = jnp.asarray(TARGETS)
    return jax.lax.scan(step, servo_faults.init(params, targets[0]), targets)[1]


def test_without_faults_set_points_arrive_as_they_are():
    np.testing.assert_allclose(run(servo_faults.Params(backlash=0.0, delay=0.0)), TARGETS, rtol=1e-6)


@pytest.mark.parametrize("delay", [0.02, INTERVAL, 0.001])
def test_delay_is_in_seconds(delay):
    arrived = np.asarray(run(servo_faults.Params(backlash=0.0, delay=delay)))
    expected = np.interp(TIMES - delay, TIMES, TARGETS[:, 2, 1])
    np.testing.assert_allclose(arrived[:, 2, 1], expected, atol=1e-9)


def test_backlash_is_a_play():
    width = np.deg2rad(1.0)
    arrived = np.asarray(run(servo_faults.Params(backlash=width, delay=0.0)))[:, 0, 0]
    output, expected = TARGETS[0, 0, 0], []
    for target in TARGETS[:, 0, 0]:
        if target - output > width / 2:
            output = target - width / 2
        elif output - target > width / 2:
            output = target + width / 2
        expected.append(output)
    np.testing.assert_allclose(arrived, expected, atol=1e-9)
    assert (np.diff(arrived) == 0).sum() > 10  # at each turn it stands


def test_the_faulty_body_is_heavier_weaker_and_slips():
    body = servo_faults.BodyFaults(gain=jnp.full((6, 3), 0.9), friction=0.5, payload=0.3)
    model = hexapod.load()
    faulty = servo_faults.apply_to_model(model, body)
    assert faulty.body_subtreemass[0] == pytest.approx(model.body_subtreemass[0] + 0.3)
    np.testing.assert_allclose(faulty.actuator_gainprm[:, 0], 0.9 * model.actuator_gainprm[:, 0])
    np.testing.assert_allclose(faulty.actuator_biasprm[:, 2], model.actuator_biasprm[:, 2])
    np.testing.assert_allclose(faulty.geom_friction[:, 0], 0.5 * model.geom_friction[:, 0])
    data, heavier = mujoco.MjData(model), mujoco.MjData(faulty)
    for each, own in ((model, data), (faulty, heavier)):
        own.qpos[:] = each.key("stance").qpos
        own.ctrl[:] = own.qpos[7:]
        mujoco.mj_step(each, own, 360)
    weight = heavier.qfrc_constraint[2] - data.qfrc_constraint[2]  # what the floor carries, N
    assert weight == pytest.approx(0.3 * 9.81, rel=0.02)
