"""Short-horizon actor-critic on a point that slides along a line: values, derivative, ends of episodes, training."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import SPEED, Point

from lgmdjax.control import perceptron
from lgmdjax.learning import short_horizon
from lgmdjax.learning.short_horizon import Settings, Window

SETTINGS = Settings(
    robots=8, window=6, units=(8,), updates=60, actor_learning_rate=0.02, critic_epochs=2, minibatches=2, clip=10.0
)


def returns_by_hand(reward, next_value, terminated, truncated, discount, trace):
    """TD(lambda) as the mean of n-step returns with weights (1 - lambda) lambda^(n - 1), the last with the rest."""
    steps, values = len(reward), []
    for t in range(steps):
        ends = [k for k in range(t, steps) if terminated[k] or truncated[k] or k == steps - 1]
        n_steps = []
        for k in range(t, ends[0] + 1):
            gain = sum(discount ** (i - t) * reward[i] for i in range(t, k + 1))
            n_steps.append(gain + (0.0 if terminated[k] else discount ** (k + 1 - t) * next_value[k]))
        weights = [(1 - trace) * trace**n for n in range(len(n_steps) - 1)]
        values.append(np.dot([*weights, trace ** (len(n_steps) - 1)], n_steps))
    return np.asarray(values)


def test_values_are_means_of_n_step_returns():
    random = np.random.default_rng(0)
    reward, next_value = random.normal(size=(2, 3, 9))
    terminated, truncated = np.zeros((2, 3, 9), bool)
    terminated[0, 3] = truncated[1, 5] = terminated[2, 8] = truncated[2, 0] = True
    window = Window(
        inputs=jnp.zeros((3, 9, 1)),
        reward=jnp.asarray(reward),
        next_value=jnp.asarray(next_value),
        terminated=jnp.asarray(terminated),
        truncated=jnp.asarray(truncated),
        counts=jnp.ones((3, 9), bool),
    )
    found = short_horizon.td_lambda(window, 0.9, 0.8)
    expected = [
        returns_by_hand(*rows, 0.9, 0.8) for rows in zip(reward, next_value, terminated, truncated, strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def with_random_critic(state):
    """Return a state whose critics expect something, so that its derivative counts."""
    critic = jax.tree.map(lambda leaf: leaf + 0.3, state.params.critic)
    return replace(state, params=replace(state.params, critic=critic, target=critic))


@pytest.mark.parametrize("environment", [Point(), Point(limit=0.8), Point(steps=3)], ids=["long", "leaves", "short"])
def test_gradient_is_that_of_central_differences(environment):
    """Of every robot, with windows in which episodes end by themselves or when their time is up."""
    state = with_random_critic(short_horizon.init(jax.random.key(0), environment, SETTINGS))
    robots = state.robots

    def objective(shift):
        direction = jax.tree.map(lambda leaf: jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), state.params.actor)
        actor = jax.tree.map(lambda leaf, part: leaf + shift * part, state.params.actor, direction)
        params = replace(state.params, actor=actor)
        found = short_horizon.gradient(environment, params, robots, jax.random.key(1), settings=SETTINGS)
        slopes = jax.tree.map(lambda grad, part: jnp.sum(grad * part, axis=range(1, grad.ndim)), found.grad, direction)
        return found, sum(jax.tree.leaves(slopes))

    found, slope = objective(0.0)
    step = 1e-6
    expected = (objective(step)[0].objective - objective(-step)[0].objective) / (2 * step)
    np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-8)
    assert np.all(np.abs(expected) > 1e-4)
    ended = {3.0: 0, 0.8: 1}[environment.limit]
    assert int(found.window.terminated.sum()) >= ended
    if environment.steps == 3:
        np.testing.assert_array_equal(found.window.truncated[0], [0, 0, 1, 0, 0, 0])
        np.testing.assert_array_equal(found.window.counts[0], [1, 1, 1, 0, 1, 1])


def test_objective_of_a_constant_action_is_its_discounted_reward_and_value():
    """By hand, across the end of an episode; the value of the critic is a constant."""
    settings = replace(SETTINGS, log_std=-100.0)
    environment = Point(steps=3)
    state = short_horizon.init(jax.random.key(0), environment, settings)
    zero = jax.tree.map(jnp.zeros_like, state.params)
    actor = replace(zero.actor, layers=perceptron_with_bias(zero.actor.layers, 0.4), log_std=state.params.actor.log_std)
    params = replace(zero, actor=actor, target=perceptron_with_bias(zero.target, 2.0))
    found = short_horizon.gradient(environment, params, state.robots, jax.random.key(1), settings=settings)
    reward, a, gamma = np.asarray(found.window.reward), np.tanh(0.4), settings.discount
    first = reward[:, :3] @ gamma ** np.arange(3) + gamma**3 * 2.0
    second = reward[:, 4:] @ gamma ** np.arange(2) + gamma**2 * 2.0
    np.testing.assert_allclose(found.objective, first + second, rtol=1e-9)
    # dr_t/da = -2 x_t (t + 1) SPEED, with t since the start of the episode.
    x = np.concatenate([np.asarray(found.window.inputs)[:, :3, 0], np.asarray(found.window.inputs)[:, 4:, 0]], axis=1)
    times, powers = np.asarray([1, 2, 3, 1, 2]), gamma ** np.asarray([0, 1, 2, 0, 1])
    by_action = (-2 * (x + SPEED * a) * times * SPEED) @ powers
    np.testing.assert_allclose(found.grad.layers[-1].bias[:, 0], by_action * (1 - a**2), rtol=1e-9)


def perceptron_with_bias(layers: perceptron.Layers, bias: float) -> perceptron.Layers:
    return (*layers[:-1], replace(layers[-1], bias=jnp.full_like(layers[-1].bias, bias)))


def test_training_brings_the_point_to_the_origin():
    environment = Point(steps=20)
    state = short_horizon.init(jax.random.key(0), environment, SETTINGS)
    rewards = []
    for _ in range(SETTINGS.updates):
        state, summary = short_horizon.step(environment, state, SETTINGS)
        rewards.append(float(summary.reward))
    assert np.mean(rewards[-10:]) > 0.4 * np.mean(rewards[:10])  # both are negative
    assert np.isfinite(float(summary.critic_loss)) and int(summary.nonfinite) == 0
    noise = jnp.zeros(1)
    left, right = (float(short_horizon.act(state.params.actor, jnp.asarray([x]), noise)[0]) for x in (-0.8, 0.8))
    assert left > 0.2 and right < -0.2


def test_a_robot_without_finite_gradient_is_left_out():
    environment = Point()
    state = short_horizon.init(jax.random.key(0), environment, SETTINGS)
    broken = replace(state.robots.state, position=state.robots.state.position.at[2].set(jnp.nan))
    after, summary = short_horizon.step(
        environment, replace(state, robots=replace(state.robots, state=broken)), SETTINGS
    )
    assert int(summary.nonfinite) == 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.params.actor))
