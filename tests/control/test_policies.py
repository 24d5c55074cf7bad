"""The five policies: their names, their order, and the switch between them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.control import policies
from lgmdjax.control.names import POLICY_NAMES
from lgmdjax.errors import InputError
from lgmdjax.simulation import assembly


def test_policies_are_in_the_order_of_their_names():
    assert tuple(policy.name for policy in policies.POLICIES) == POLICY_NAMES
    assert [policies.get_policy(name) for name in POLICY_NAMES] == list(policies.POLICIES)


def test_an_unknown_policy_is_refused():
    with pytest.raises(InputError, match=r"policy: expected one of teacher, learned, .*, got 'greedy'"):
        policies.get_policy("greedy")


def test_policies_that_use_the_camera_say_so():
    """Velocities of the others do not depend on the outputs of the LGMDs."""
    params = assembly.make_policies(direct_gain=1.0)

    def velocity(policy: policies.Policy, own, u: float) -> np.ndarray:
        both = jnp.full(2, u)
        observation = policies.Observation(
            u=both, feed_forward=both, excitation=both, distances=jnp.ones(2), corridor=jnp.asarray([1.0, 2.0])
        )
        return np.asarray(policy.step(own, policy.init(own, jax.random.key(0)), observation)[1])

    for policy, own in zip(policies.POLICIES, params.policies, strict=True):
        changed = np.any(velocity(policy, own, 0.5) != velocity(policy, own, 0.9))
        assert changed == policy.uses_camera, policy.name


def test_the_switch_returns_the_velocity_of_the_active_policy():
    params = assembly.make_policies(direct_gain=1.0, replay_velocities=np.full((4096, 2), 0.7))
    zeros, ahead = jnp.zeros(2), jnp.asarray([1.0, 0.7])
    observation = policies.Observation(
        u=jnp.asarray([0.6, 0.8]), feed_forward=zeros, excitation=zeros, distances=zeros, corridor=ahead
    )
    key = jax.random.key(0)
    for index, policy in enumerate(policies.POLICIES):
        own = params.policies[index]
        _, expected = policy.step(own, policy.init(own, key), observation)
        active = params.replace(active=jnp.asarray(index))  # pyright: ignore[reportAttributeAccessIssue]
        _, velocity = policies.SWITCH.step(active, policies.SWITCH.init(active, key), observation)
        np.testing.assert_array_equal(velocity, expected, err_msg=policy.name)
