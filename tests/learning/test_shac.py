"""SHAC: returns and losses by hand, and a window whose gradient is that of central differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.environments import functional
from lgmdjax.learning import critic, shac
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop, room_batches
from lgmdjax.world import arena

SETTINGS = shac.Settings(
    robots=2, frames=3, windows=2, rounds=1, units=4, critic_units=8, clip=float("inf"), critic_steps=400
)
LONG = replace(SETTINGS, frames=7)


def samples(**changes):
    """Seven frames: an episode that is terminated in the third one, a beginning, and three of the next."""
    frames, none = LONG.frames, np.zeros(LONG.frames, bool)
    fields = {
        "features": jnp.zeros((frames, critic.FEATURES)),
        "following": jnp.zeros((frames, critic.FEATURES)),
        "reward": jnp.asarray([1.0, 2.0, -5.0, 0.0, 1.0, 1.0, 3.0]),
        "terminated": jnp.asarray([0, 0, 1, 0, 0, 0, 0], bool),
        "truncated": jnp.asarray(none),
        "begins": jnp.asarray([0, 0, 0, 1, 0, 0, 0], bool),
    }
    return critic.Sample(**(fields | changes))


VALUES = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0])  # V of what follows each frame


def test_loss_sums_discounted_rewards_and_the_critic_beyond_the_window():
    g = LONG.discount
    first = 1 + 2 * g - 5 * g**2
    second = 1 + g + (3 + g * 70) * g**2
    np.testing.assert_allclose(shac._loss(LONG, samples(), jnp.asarray(VALUES)), -(first + second) / 7)


def test_loss_of_a_truncated_episode_goes_on_with_the_critic():
    g = LONG.discount
    truncated = samples(terminated=jnp.zeros(7, bool), truncated=jnp.asarray([0, 0, 1, 0, 0, 0, 0], bool))
    first = 1 + 2 * g + (-5 + g * 30) * g**2
    second = 1 + g + (3 + g * 70) * g**2
    np.testing.assert_allclose(shac._loss(LONG, truncated, jnp.asarray(VALUES)), -(first + second) / 7)


@pytest.mark.parametrize("trace", [0.0, 0.6, 1.0])
def test_returns_are_mixtures_of_all_n_step_returns(trace):
    """By their definition: (1 - lambda) sum of lambda^(n-1) times the n-step return."""
    g = LONG.discount
    reward = np.asarray(samples().reward)

    def n_step(frame, n, end, terminated):
        """n rewards, and the critic beyond them unless the episode was terminated."""
        last = min(frame + n, end) - 1
        rewards = sum(g ** (k - frame) * reward[k] for k in range(frame, last + 1))
        return rewards + (0 if terminated and last == end - 1 else g ** (last + 1 - frame) * VALUES[last])

    def mixture(frame, end, terminated):
        longest = end - frame
        weights = [(1 - trace) * trace ** (n - 1) for n in range(1, longest)] + [trace ** (longest - 1)]
        return sum(w * n_step(frame, n, end, terminated) for n, w in zip(range(1, longest + 1), weights, strict=True))

    found = critic.returns(samples(), jnp.asarray(VALUES), discount=g, trace=trace)
    expected = [mixture(k, 3, True) for k in range(3)] + [mixture(k, 7, False) for k in (4, 5, 6)]
    np.testing.assert_allclose(np.asarray(found)[[0, 1, 2, 4, 5, 6]], expected)


def test_the_critic_learns_the_returns_and_the_navigator_follows_its_gradient():
    learner = shac.create(jax.random.key(0), SETTINGS)
    features = jax.random.normal(jax.random.key(1), (2, 3, critic.FEATURES))
    ends = jnp.ones((2, 3), bool)  # each frame's return is its reward
    found = critic.Sample(
        features=features,
        following=features,
        reward=jnp.arange(6.0).reshape(2, 3),
        terminated=ends,
        truncated=~ends,
        begins=~ends,
    )
    grad = jax.tree.map(jnp.ones_like, learner.actor.weights)
    after, error = shac.learn(learner, (grad, found), settings=SETTINGS)
    assert error > 1
    np.testing.assert_allclose(critic.value(after.critic, features), found.reward, atol=0.1)
    before, now = (one.actor.weights["head"]["kernel"] for one in (learner, after))
    np.testing.assert_allclose(now - before, -SETTINGS.learning_rate, rtol=1e-3)


@pytest.fixture(scope="module")
def environment():
    """One small room with a box on the left, two starts, and small eyes."""
    boxes = arena.make_prisms([[0.75, 0.4]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    scene = arena.empty_room((5.0, 4.0), boxes=boxes)
    starts = jnp.asarray([[0.25, 0.3, 0.0], [-1.0, -1.0, 2.0]])
    rooms = room_batches.stack_rooms([closed_loop.Room(arena=scene, starts=starts, key=jax.random.key(0))])
    robot = closed_loop.assemble(
        None,
        lgmd_params=lgmd.Params(threshold=0.5, suppression=30.0),
        camera_params=camera.Params(width=16, height=12),
    )
    return functional.make(robot=robot, room=rooms, reward="floor", vision_gradient=False)


@pytest.mark.slow
def test_gradient_of_a_window_is_that_of_central_differences(environment):
    """Of both robots' mean loss by the bias of the navigator's outputs: through memory, physics, laser and critic."""
    learner = shac.create(jax.random.key(3), SETTINGS)
    begun = shac.begin_walks(environment, learner.actor, jax.random.key(4), settings=SETTINGS)

    def walk(bias):
        weights = {**learner.actor.weights, "head": {**learner.actor.weights["head"], "bias": bias}}
        moved = replace(learner, actor=replace(learner.actor, weights=weights))
        return shac.window(environment, moved, begun, jax.random.key(5), settings=SETTINGS)

    bias, direction, step = learner.actor.weights["head"]["bias"], jnp.asarray([1.0, 0.5]), 1e-5
    gradient, walks, samples = walk(bias)
    high, low = (walk(bias + sign * step * direction)[0].loss for sign in (1, -1))
    derivative = gradient.grad["head"]["bias"] @ direction
    np.testing.assert_allclose(derivative, (high - low) / (2 * step), rtol=2e-3)
    assert abs(float(derivative)) > 1e-6
    assert not gradient.nonfinite.any()
    assert samples.begins.tolist() == [[True, False, False]] * 2
    assert walks.environment.robot.frame.tolist() == [2, 2]
    assert np.abs(np.asarray(samples.features[:, 1:] - samples.following[:, :-1])).max() < 1e-9
    assert isinstance(learner.actor, navigator.Params)
