"""Robots from files: their policies, camera and fingerprint."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.control import navigator, policies
from lgmdjax.control.names import POLICY_NAMES
from lgmdjax.errors import InputError
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


def test_with_policy_replaces_the_policy_of_that_name_alone(robot):
    untrained = navigator.create(jax.random.key(1), units=3)
    before, after = (
        one.controller.policy.policies for one in (robot, assembly.with_policy(robot, "learned", untrained))
    )
    for index, name in enumerate(POLICY_NAMES):
        assert (after[index] is untrained) if name == "learned" else (after[index] is before[index])


def test_select_policy_activates_it(robot):
    for index, policy in enumerate(policies.POLICIES):
        assert int(assembly.select_policy(robot, policy).controller.policy.active) == index


def test_with_camera_changes_camera_and_pooling(robot):
    other = assembly.with_camera(robot, CameraSettings(width=80, height=60, overlap=0.7, pooling=3))
    assert (other.camera.width, other.camera.height, other.camera.overlap) == (80, 60, 0.7)
    assert other.controller.lgmd.pooling == 3
    assert other.controller.lgmd.threshold == robot.controller.lgmd.threshold


def test_fingerprint_depends_on_every_number_and_on_the_camera(robot):
    same = assembly.load_robot()
    assert assembly.fingerprint(robot) == assembly.fingerprint(same)
    others = (
        assembly.select_policy(robot, policies.BLIND),
        assembly.with_camera(robot, CameraSettings(width=80, height=60)),
        assembly.with_policy(robot, "blind", policies.BlindParams(velocity=jnp.asarray([1.0, 1.0]))),
        replace(robot, head_sway=jnp.asarray(1.0)),
    )
    assert len({assembly.fingerprint(one) for one in (robot, *others)}) == 5


def test_placeholders_walk_straight():
    """What is not given: the teacher's base velocity for policies blind and random."""
    switch = assembly.make_policies()
    np.testing.assert_allclose(switch.policies[2].velocity, 1.3)
    np.testing.assert_allclose(switch.policies[4].velocities, np.full((assembly.REPLAY_LENGTH, 2), 1.3))


def test_a_folder_without_the_files_of_its_stage_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected"):
        assembly.load_robot(train_folder=tmp_path)
    with pytest.raises(InputError, match="expected"):
        assembly.load_robot(gait_folder=tmp_path)
