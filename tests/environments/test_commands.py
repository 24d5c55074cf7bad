"""Commands of several frames, on a stand-in for the robot's environment whose u counts the frames of an episode."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.control.policies import Observation
from lgmdjax.environments import commands, coverage, functional, rewards
from lgmdjax.errors import InputError

START = 0.5


def counted_state(u, done):
    nothing: Any = None
    zero = jnp.zeros(2)
    sensed = Observation(u=u, feed_forward=zero, excitation=zero, distances=zero, corridor=zero)
    return functional.State(robot=nothing, sensed=sensed, floor=nothing, room=nothing, start=nothing, done=done)


class Counted:
    """u grows by 0.01 a frame; the reward is the left velocity; the episode is terminated after five frames."""

    settings = SimpleNamespace(vision_gradient=False)

    def reset(self, key):
        u = jnp.full(2, START)
        return u, counted_state(u, jnp.asarray(False))

    def step(self, key, state, action):
        u = START + (state.sensed.u + 0.01 - START) * ~state.done
        ends = (u[0] > START + 0.045) & ~state.done
        outcome: Any = None
        reward = action[0] * ~state.done
        return functional.Transition(u, counted_state(u, ends), reward, ends, jnp.asarray(False), outcome)


def test_a_command_adds_rewards_and_ends_with_its_episode():
    """Five frames are a command of three, and one of two; the third begins an episode, and does nothing else."""
    environment = commands.Commands(environment=Counted(), depth=2, hold=3)  # pyright: ignore[reportArgumentType]
    key, action = jax.random.key(0), jnp.asarray([1.0, 1.0])  # 2, the fastest velocity
    observation, state = environment.reset(key)
    np.testing.assert_allclose(observation, 0.0, atol=1e-9)
    gains, ends, seen = [], [], []
    for _ in range(4):
        moved = environment.step(key, state, action)
        state = moved.state
        gains.append(float(moved.reward))
        ends.append(bool(moved.terminated))
        seen.append(np.asarray(moved.observation)[::2] * 0.1)
    np.testing.assert_allclose(gains, [6.0, 4.0, 0.0, 6.0])
    assert ends == [False, True, False, False]
    np.testing.assert_allclose(seen, [[0.0, 0.03], [0.03, 0.05], [0.0, 0.0], [0.0, 0.03]], atol=1e-9)


def test_covered_floor_is_interpolated_and_has_the_derivative_of_central_differences():
    state = coverage.init(jnp.asarray([0.125, 0.125]))  # the centre of a cell
    np.testing.assert_allclose(coverage.covered_at(state, jnp.asarray([0.125, 0.125])), 1.0)
    np.testing.assert_allclose(coverage.covered_at(state, jnp.asarray([0.25, 0.125])), 0.5)
    here, step = jnp.asarray([0.2, 0.3]), 1e-6
    found = jax.grad(lambda position: coverage.covered_at(state, position))(here)
    expected = [
        (coverage.covered_at(state, here + step * e) - coverage.covered_at(state, here - step * e)) / (2 * step)
        for e in jnp.eye(2)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_other_observations_are_refused():
    settings = functional.Settings(observation="laser", action="velocity", reward=rewards.floor, vision_gradient=False)
    nothing: Any = None
    environment = functional.Environment(
        params=nothing, model=nothing, rooms=nothing, frames=nothing, settings=settings
    )
    with pytest.raises(InputError, match="lgmd"):
        commands.make(environment)
