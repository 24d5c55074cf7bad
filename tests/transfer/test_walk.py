"""Walks in C MuJoCo: they are as fast as in MJX, the nervous system is the exported one, and touches are counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.deployment import nervous_system
from lgmdjax.evaluation import gait_test
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.simulation import assembly
from lgmdjax.simulation.closed_loop import SUBSTEPS, Room
from lgmdjax.transfer import faults, nervous_systems, robot_model, walk
from lgmdjax.world import arena
from lgmdjax.world.mujoco_world import PLAIN

SECONDS = 8.0


@pytest.mark.parametrize("v", [(1.2, 1.2), (0.6, 1.4)])
def test_speed_and_turning_in_an_empty_room_are_those_of_mjx(v):
    """Hard contacts of every geom, against the model whose walk MJX repeats to a millimetre (`test_walking`)."""
    own, other = hexapod.load(), robot_model.build(arena.empty_room(), PLAIN)
    steps = round(SECONDS / gait_test.TIME_STEP)
    velocity = jnp.asarray(v, float)
    targets = gait_test.servo_targets(cpg.Params(), shaping.load_pretrained(), velocity, steps=steps)
    ours, theirs = (
        gait_test.measure_gait(gait_test.simulate_mujoco(model, targets), cpg.CYCLE_TIME) for model in (own, other)
    )
    assert theirs.speed == pytest.approx(ours.speed, rel=0.05)
    assert theirs.yaw_rate == pytest.approx(ours.yaw_rate, rel=0.05, abs=0.003)


@pytest.fixture(scope="module")
def robot():
    with jax.enable_x64(False):
        return assembly.select_policy(assembly.load_robot(), policies.LEARNED)


def batch(leaf):
    return jax.tree.map(lambda value: jnp.asarray(value)[None], leaf)


@pytest.mark.usefixtures("float32")
def test_a_robot_without_faults_has_the_exported_nervous_system(robot):
    """Ten pictures, each followed by six set points, give what `nervous_system.step` gives."""
    none, exported = batch(faults.Faults()), nervous_system.from_robot(robot)
    rng, step = np.random.default_rng(0), jax.jit(nervous_system.step)
    state, single = nervous_systems.init_batch(robot, none, jax.random.key(0)[None]), nervous_system.init(exported)
    ranges = jnp.full((1, robot.laser.rays), robot.laser.max_range)
    smooth = np.cumsum(rng.normal(0, 4, (10, 2, robot.camera.height, robot.camera.width)), axis=3) + 120
    pictures = np.clip(np.round(smooth), 0, 255).astype(np.float32)
    responses = []
    for picture in pictures:
        state = nervous_systems.process_picture_batch(robot, none, state, picture[None], ranges)
        single, output = step(exported, single, picture.astype(np.uint8))
        responses.append(np.asarray(output.u))
        np.testing.assert_allclose(state.controller.velocity[0], output.velocity, atol=1e-5)
        for substep in range(SUBSTEPS):
            state, targets = nervous_systems.next_targets_batch(robot, none, state)
            np.testing.assert_allclose(targets[0], output.targets[substep], atol=1e-4)
    assert np.ptp(responses) > 0.01  # the pictures move the detectors


@pytest.mark.usefixtures("float32")
def test_a_touch_is_counted_and_the_robot_lifted(robot):
    """Blind, it walks into the wall that is a few centimetres before its feet, and is then at its second start."""
    start = np.array([[2.7, 0.0, 0.0], [-1.0, 0.5, np.pi]])
    rooms = Room(
        arena=batch(arena.empty_room()), starts=jnp.asarray(start, jnp.float32)[None], key=jax.random.key(1)[None]
    )
    record = walk.walk(robot, rooms, 2.5, "blind", walk.World(style=PLAIN))
    assert record.ok.all()
    assert record.contact.sum() == 1
    touch = int(record.contact[0].argmax())
    assert record.resets[0].tolist() == [0] * (touch + 1) + [1] * (len(record.time[0]) - touch - 1)
    assert np.flatnonzero(record.is_first[0]).tolist() == [0, touch + 1]
    np.testing.assert_allclose(record.position[0, touch + 1, :2], start[1, :2], atol=1e-6)
    assert 0.05 < record.clearance[0, 0] < 0.15
    assert np.all(np.diff(record.clearance[0, :touch:10]) < 0.01)
    np.testing.assert_allclose(record.distances[0, 0], 0.3, atol=0.02)  # the scanner is in the middle of the trunk
    np.testing.assert_allclose(record.distances[0, touch + 1], 2.0, atol=0.02)
