"""SHAC, the short-horizon actor-critic: a navigator trained by its reward alone, by the simulator's derivative.

In a window of T frames a batch of robots walks in an environment (`lgmdjax.environments.functional`). A robot's loss

    L = -1/T sum_t g_t (r_t + gamma b_t V(x_{t+1}))

is differentiated by the navigator's weights through the navigator's memory, servos, body, laser and reward. b_t is 1 in
the window's last frame and where an episode is truncated, 0 where it is terminated; g_t = gamma^(t - s), where s is the
first frame of the window or of the episode. Beyond the window stands the critic V. It is fitted to

    R_t = r_t + gamma ((1 - lambda) V'(x_{t+1}) + lambda R_{t+1}),

with V' a slow average of V. Between windows the walks go on without their derivative. Every `windows` windows all
robots begin new episodes.

| symbol | name     | unit   | what                                                                                    |
| ------ | -------- | ------ | --------------------------------------------------------------------------------------- |
| r_t    | reward   | cells  | of a frame (`lgmdjax.environments.rewards`)                                             |
| x_t    | features | 1/m, 1 | of the critic: nearness of the nearest and of what is in the way, either side; velocity |
| u      | sensed.u | 1      | all that the navigator sees                                                             |
| gamma  | discount | 1      | a frame                                                                                 |

The critic sees distances that the navigator does not: only training needs it, and V's derivative by the pose is then
that of the laser instead of the pictures'. No derivative passes through the pictures (`vision_gradient`).

The network is the paper's (`navigator`, variant lstm), so it is saved, loaded and evaluated like one that imitates.

Source: Xu et al. 2022, Accelerated policy learning with parallel differentiable simulation.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from lgmdjax.control import braitenberg, navigator, policies
from lgmdjax.environments import functional
from lgmdjax.environments.functional import Environment
from lgmdjax.learning import critic, rollout_gradient
from lgmdjax.learning.checkpoints import Checkpoints, resumable
from lgmdjax.learning.critic import Sample, Weights
from lgmdjax.simulation import rollout, sharding


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How to train; hashable. The frames simulated are robots x frames x windows x rounds."""

    robots: int = 16
    frames: int = 24  # T, of a window: one gait cycle
    windows: int = 40  # in a round; then all robots begin new episodes
    rounds: int = 4
    units: int = navigator.UNITS  # of the navigator
    critic_units: int = 64
    discount: float = 0.99  # gamma
    trace: float = 0.95  # lambda
    noise: float = 0.3  # nominal; standard deviation of what is added to a robot's velocities for a window
    learning_rate: float = 3e-3  # of the navigator; decays to zero along half a cosine
    critic_rate: float = 2e-3
    critic_steps: int = 16  # in a window
    critic_average: float = 0.2  # how much of V goes into V' after a window
    clip: float = 3.0  # largest norm of one robot's gradient, relative to the median of all robots


class WindowStats(NamedTuple):
    """Statistics of a window."""

    reward: float  # mean of all robots, a minute
    ends: float  # touches and falls
    loss: float  # of the navigator
    signal: float  # norm of the mean gradient
    noise: float  # its standard error: the norm expected by chance if the true gradient is zero
    nonfinite: float  # robots whose gradient was not finite
    critic_error: float  # root mean square of V - R, cells


@struct.dataclass(kw_only=True)
class Learner:
    """Weights and optimisers."""

    actor: navigator.Params
    critic: Weights
    target: Weights  # of V'
    actor_memory: optax.OptState
    critic_memory: optax.OptState


@struct.dataclass(kw_only=True)
class Walk:
    """A robot that walks: its environment and its navigator's memory."""

    environment: functional.State
    memory: navigator.State


@struct.dataclass(kw_only=True)
class Progress:
    """The state of a training run between two rounds."""

    learner: Learner
    rounds: Int[Array, ""]
    rows: Float[Array, "windows columns"]  # `WindowStats` of all windows; nan for those to come


def train(
    environment: Environment,
    settings: Settings,
    seed: int,
    *,
    checkpoints: Checkpoints | None = None,
    on_window: Callable[[WindowStats], None] = lambda stats: None,
) -> tuple[navigator.Params, list[WindowStats]]:
    """Train a navigator from random weights; return it and the statistics of all windows.

    Args:
        environment: with observation lgmd, action velocity, a reward that has a derivative, and no `vision_gradient`.
        settings: of the training.
        seed: of weights, rooms and noise.
        checkpoints: where progress is saved after every round and resumed from; the result is the same, bit for bit.
        on_window: called with the statistics of every window.
    """
    key = jax.random.key(seed)

    def work(progress: Progress, number: int, _: int) -> Progress:
        learner, rows = progress.learner, []
        begin_key, *keys = jax.random.split(jax.random.fold_in(key, number), settings.windows + 1)
        walks = begin_walks(environment, learner.actor, begin_key, settings=settings)
        for window_key in keys:
            gradient, walks, samples = window(environment, learner, walks, window_key, settings=settings)
            learner, error = learn(learner, jax.device_get((gradient.grad, samples)), settings=settings)
            rows.append(_summarise(gradient, samples, error))
            on_window(rows[-1])
        first = number * settings.windows
        filled = progress.rows.at[first : first + len(rows)].set(jnp.asarray(rows, float))
        return Progress(learner=learner, rounds=progress.rounds + 1, rows=filled)

    rows = jnp.full((settings.rounds * settings.windows, len(WindowStats._fields)), jnp.nan)
    initial = Progress(learner=create(key, settings), rounds=jnp.asarray(0, jnp.int32), rows=rows)
    *_, (_, progress) = resumable(work, initial, checkpoints, total=settings.rounds)
    return progress.learner.actor, [WindowStats(*row) for row in np.asarray(progress.rows).tolist()]


def create(key: Array, settings: Settings) -> Learner:
    """Return untrained networks and their optimisers; the navigator's outputs cover the gait's range."""
    gait = policies.GAIT_RANGE
    middle, half = (gait.max_velocity + gait.min_velocity) / 2, (gait.max_velocity - gait.min_velocity) / 2
    actor = navigator.create(jax.random.fold_in(key, 1), "lstm", settings.units)
    actor = replace(actor, output_mean=jnp.full(2, float(middle)), output_scale=jnp.full(2, float(half)))
    weights = critic.create(jax.random.fold_in(key, 2), settings.critic_units)
    actor_optimiser, critic_optimiser = _optimisers(settings)
    return Learner(
        actor=actor,
        critic=weights,
        target=weights,
        actor_memory=actor_optimiser.init(actor.weights),
        critic_memory=critic_optimiser.init(weights),
    )


@partial(jax.jit, static_argnames="settings")
def begin_walks(environment: Environment, actor: navigator.Params, key: Array, *, settings: Settings) -> Walk:
    """Return a batch of walks whose next frame begins an episode."""
    keys = jax.random.split(key, settings.robots)
    memory = rollout_gradient.broadcast_params(navigator.init(actor), settings.robots)
    return Walk(environment=jax.vmap(environment.ended)(keys), memory=memory)


@partial(jax.jit, static_argnames="settings")
def window(
    environment: Environment, learner: Learner, walks: Walk, key: Array, *, settings: Settings
) -> tuple[rollout_gradient.Gradient, Walk, Sample]:
    """Walk for a window, on all devices; return the gradient by the navigator's weights, the walks and the samples."""
    noise_key, frame_key = jax.random.split(key)
    noise = settings.noise * jax.random.normal(noise_key, (settings.robots, 2), float)
    keys = jax.random.split(frame_key, (settings.robots, settings.frames))

    def work(walks: Walk, noise: Array, keys: Array) -> PyTree:
        copies = rollout_gradient.broadcast_params(learner.actor.weights, len(noise))

        def losses(weights: Weights) -> tuple[Float[Array, " robots"], tuple[Walk, Sample]]:
            return _losses(weights, environment, learner, walks, (noise, keys), settings)

        return rollout_gradient.per_robot_grad(losses, copies)

    (values, (walks, samples)), grads = sharding.shard_robots(work, walks, noise, keys)
    return rollout_gradient.average(values, grads, settings.clip), walks, samples


def _losses(
    weights: Weights,
    environment: Environment,
    learner: Learner,
    walks: Walk,
    randomness: tuple[Float[Array, "robots 2"], Array],
    settings: Settings,
) -> tuple[Float[Array, " robots"], tuple[Walk, Sample]]:
    """Return L of each robot; weights have an axis of robots."""
    noise, keys = randomness

    def frame(inputs: tuple[Weights, Array], walk: Walk, key: Array) -> tuple[Walk, Sample]:
        return _frame(environment, replace(learner.actor, weights=inputs[0]), inputs[1], walk, key)

    # The recomputed frame is inside a loop, where XLA cannot merge it with the first one.
    step = jax.checkpoint(frame, prevent_cse=False)
    walks, samples = rollout.scan_batch(step, (weights, noise), walks, keys)
    following = critic.value(learner.target, samples.following)
    return jax.vmap(partial(_loss, settings))(samples, following), (walks, samples)


def _frame(
    environment: Environment, actor: navigator.Params, noise: Float[Array, "2"], walk: Walk, key: Array
) -> tuple[Walk, Sample]:
    """Walk for a frame; at an episode's beginning the navigator's memory is empty, as after a reset of a rollout."""
    before = walk.environment
    memory, output = navigator.step(actor, walk.memory, before.sensed.u)
    velocity = braitenberg.limit(policies.GAIT_RANGE, output + noise)
    transition = environment.step(key, before, velocity)
    empty = navigator.init(actor)
    memory = jax.tree.map(partial(jnp.where, before.done), empty, replace(memory, velocity=velocity))
    sample = Sample(
        features=critic.features(before, walk.memory.velocity),
        following=critic.features(transition.state, velocity),
        reward=transition.reward,
        terminated=transition.terminated,
        truncated=transition.truncated,
        begins=before.done,
    )
    return Walk(environment=transition.state, memory=memory), sample


def _loss(settings: Settings, samples: Sample, following: Float[Array, " frames"]) -> Float[Array, ""]:
    """Return L of one robot."""
    is_last = jnp.arange(settings.frames) == settings.frames - 1
    bootstraps = (is_last | samples.truncated) & ~samples.terminated

    def frame(discount: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
        reward, beyond, begins, bootstraps = now
        gain = reward + settings.discount * jnp.where(bootstraps, beyond, 0.0)
        after = jnp.where(begins, 1.0, settings.discount * discount)
        return after, jnp.where(begins, 0.0, discount * gain)

    inputs = samples.reward, following, samples.begins, bootstraps
    return -jnp.mean(jax.lax.scan(frame, jnp.ones((), following.dtype), inputs)[1])


@partial(jax.jit, static_argnames="settings")
def learn(learner: Learner, found: tuple[Weights, Sample], *, settings: Settings) -> tuple[Learner, Float[Array, ""]]:
    """Update navigator and critic after a window; return the learner and the critic's error before its update.

    Args:
        learner: of the window.
        found: the gradient, and the samples with axes (robot, frame).
        settings: of the training.
    """
    grad, samples = found
    actor_optimiser, critic_optimiser = _optimisers(settings)
    updates, actor_memory = actor_optimiser.update(grad, learner.actor_memory)
    actor = replace(learner.actor, weights=optax.apply_updates(learner.actor.weights, updates))
    expected = partial(critic.returns, discount=settings.discount, trace=settings.trace)
    returns = jax.vmap(expected)(samples, critic.value(learner.target, samples.following))
    counts = ~samples.begins

    def error(weights: Weights) -> Float[Array, ""]:
        squares = (critic.value(weights, samples.features) - returns) ** 2
        return jnp.sum(jnp.where(counts, squares, 0.0)) / jnp.maximum(jnp.sum(counts), 1)

    def fit(carry: tuple[PyTree, optax.OptState], _: None) -> tuple[tuple[PyTree, optax.OptState], Array]:
        weights, memory = carry
        before, slope = jax.value_and_grad(error)(weights)
        updates, memory = critic_optimiser.update(slope, memory)
        return (optax.apply_updates(weights, updates), memory), before

    carry = learner.critic, learner.critic_memory
    (weights, critic_memory), errors = jax.lax.scan(fit, carry, length=settings.critic_steps)
    target: PyTree = optax.incremental_update(weights, learner.target, settings.critic_average)
    memories = {"actor_memory": actor_memory, "critic_memory": critic_memory}
    return Learner(actor=actor, critic=weights, target=target, **memories), jnp.sqrt(errors[0])


def _optimisers(settings: Settings) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    schedule = optax.cosine_decay_schedule(settings.learning_rate, settings.windows * settings.rounds)
    # Adam's epsilon must be small beside every derivative.
    return optax.adam(schedule, b1=0.7, b2=0.95, eps=1e-12), optax.adam(settings.critic_rate)


def _summarise(gradient: rollout_gradient.Gradient, samples: Sample, error: Float[Array, ""]) -> WindowStats:
    counts = ~np.asarray(samples.begins)
    return WindowStats(
        reward=float(np.asarray(samples.reward)[counts].mean()) * 60 * functional.FRAME_RATE,
        ends=int(np.asarray(samples.terminated).sum()),
        loss=float(gradient.loss),
        signal=float(optax.tree.norm(gradient.grad)),
        noise=float(gradient.standard_error),
        nonfinite=int(gradient.nonfinite.sum()),
        critic_error=float(error),
    )
