"""Short-horizon actor-critic (SHAC): an actor trained by the derivative of its reward through the simulation.

Robots act for a window of h steps. The objective of a robot is what it gets in the window, and what a critic expects
after it:

    J = sum_t g_t r_t + sum_e g_{e+1} V'(s_{e+1}),

where g_t = gamma^(t - t0) is discounted from the start t0 of the episode or of the window, and e are the last steps of
the window and of the episodes that end in it. V' is zero after a termination, but not after a truncation. Reverse mode
takes the derivative of J by the actor's weights through all h steps of the environment and through the critic. It is
cut where a window or an episode begins. The mean over robots is clipped to a norm, and Adam follows it.

Then the critic V is fitted to TD(lambda) values of the same window,

    G_t = r_t + gamma ((1 - lambda) V'(s_{t+1}) + lambda G_{t+1}),

with V'(s_{t+1}) alone where the window or an episode ends, and nothing after a termination. V' follows V slowly.

The actor is stochastic: a_t = tanh(f(o_t) + exp(l) e_t) with standard normal e_t and trained l. Its derivative passes
through a_t with e_t held constant. The critic may use more than the actor's observation o_t, since only training
needs it (`Environment.privileged`).

| symbol    | name                            | unit        |
| --------- | ------------------------------- | ----------- |
| h         | window                          | steps       |
| gamma     | discount                        | 1           |
| lambda    | trace                           | 1           |
| f         | actor                           | -           |
| l         | log_std                         | 1           |
| V, V'     | critic, target                  | reward      |
| J         | objective                       | reward      |
| G         | `td_lambda`                     | reward      |

Any environment with the interface of `Environment` can be used; `lgmdjax.environments.commands` is one. A robot whose
objective or derivative is not finite, or whose derivative is longer than `largest` times the median of all robots', is
left out of the mean or shortened to that length.

Source: Xu, Makoviychuk, Narang, Ramos, Matusik, Garg & Macklin 2022, "Accelerated policy learning with parallel
differentiable simulation", with tanh units instead of ELU, and the last two sentences ours.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from lgmdjax.control import perceptron
from lgmdjax.control.perceptron import Layers
from lgmdjax.simulation import sharding


@runtime_checkable
class Transition(Protocol):
    """What an environment's step returns."""

    @property
    def observation(self) -> Array: ...
    @property
    def state(self) -> PyTree: ...
    @property
    def reward(self) -> Array: ...
    @property
    def terminated(self) -> Array: ...
    @property
    def truncated(self) -> Array: ...


@runtime_checkable
class Environment(Protocol):
    """An environment of one robot, as a pytree; pure functions that have a derivative.

    The step after the end of an episode ignores its action, begins the next episode, and has no reward.
    """

    @property
    def observation_size(self) -> int:
        """Number of inputs of the actor."""
        ...

    @property
    def privileged_size(self) -> int:
        """Number of further inputs of the critic."""
        ...

    @property
    def action_size(self) -> int:
        """Number of actions, each -1..1."""
        ...

    def reset(self, key: Array) -> tuple[Array, PyTree]:
        """Return the first observation and state of an episode."""
        ...

    def step(self, key: Array, state: PyTree, action: Array) -> Transition:
        """Return the transition that an action causes."""
        ...

    def privileged(self, state: PyTree) -> Array:
        """Return what the critic observes besides the actor's observation."""
        ...


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of the training; steps are the environment's."""

    robots: int = 32
    window: int = 10  # steps
    discount: float = 0.99
    trace: float = 0.95

    units: tuple[int, ...] = (64, 64)
    log_std: float = -1.0  # at the start

    updates: int = 300  # windows, over which both learning rates decay linearly to zero
    actor_learning_rate: float = 2e-3
    critic_learning_rate: float = 2e-3
    clip: float = 1.0  # largest norm of the mean gradient
    largest: float = 10.0  # norm of one robot's gradient, relative to the median of all robots
    critic_epochs: int = 16
    minibatches: int = 4  # of an epoch
    target_rate: float = 0.6  # of the difference to the critic that the target loses with each window


@struct.dataclass(kw_only=True)
class Actor:
    """The policy: the mean before tanh, and the logarithm of its standard deviation."""

    layers: Layers
    log_std: Float[Array, " actions"]


@struct.dataclass(kw_only=True)
class Params:
    """All that is trained, and the target critic."""

    actor: Actor
    critic: Layers
    target: Layers


@struct.dataclass(kw_only=True)
class Robots:
    """A batch of robots between two windows."""

    state: PyTree
    observation: Float[Array, "robots inputs"]
    is_over: Bool[Array, " robots"]  # the next step begins an episode


@struct.dataclass(kw_only=True)
class State:
    """State of the training between two windows."""

    params: Params
    robots: PyTree  # of type `Robots`; None within an update
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    key: Array
    updates: Int[Array, ""]


@struct.dataclass(kw_only=True)
class Window:
    """What the critic is fitted to; values of steps that begin an episode do not count."""

    inputs: Float[Array, "robots steps features"]
    reward: Float[Array, "robots steps"]
    next_value: Float[Array, "robots steps"]  # of the target
    terminated: Bool[Array, "robots steps"]
    truncated: Bool[Array, "robots steps"]
    counts: Bool[Array, "robots steps"]


@struct.dataclass(kw_only=True)
class Summary:
    """Summary of a window."""

    reward: Float[Array, ""]  # of a step, mean
    objective: Float[Array, ""]  # mean of the robots whose gradient is finite
    ended: Int[Array, ""]  # episodes that were terminated
    median_norm: Float[Array, ""]  # of the robots' gradients
    max_norm: Float[Array, ""]
    nonfinite: Int[Array, ""]  # robots
    critic_loss: Float[Array, ""]  # of the last epoch


class Scan(NamedTuple):
    """What a robot carries from step to step within a window."""

    robot: Robots
    discount: Array
    objective: Array


def init(key: Array, environment: Environment, settings: Settings) -> State:
    """Return the state of a training that begins: random weights, and robots at the start of an episode."""
    actor_key, critic_key, robots_key, key = jax.random.split(key, 4)
    inputs, actions = environment.observation_size, environment.action_size
    actor = Actor(
        layers=perceptron.create(actor_key, (inputs, *settings.units, actions), 0.01),
        log_std=jnp.full(actions, settings.log_std, float),
    )
    critic = perceptron.create(critic_key, (inputs + environment.privileged_size, *settings.units, 1))
    weights: PyTree = actor, critic
    return State(
        params=Params(actor=actor, critic=critic, target=critic),
        robots=_reset(environment, robots_key, settings),
        actor_optimiser=_optimiser(settings.actor_learning_rate, settings).init(weights[0]),
        critic_optimiser=_optimiser(settings.critic_learning_rate, settings, _critic_steps(settings)).init(weights[1]),
        key=key,
        updates=jnp.asarray(0, jnp.int32),
    )


def step(environment: Environment, state: State, settings: Settings) -> tuple[State, Summary]:
    """Let the robots act for a window and train actor and critic; return the next state and a summary.

    Robots are sharded over the devices of this computer; not for use inside `jit`.
    """
    key, window_key, fit_key = jax.random.split(state.key, 3)
    found = gradient(environment, state.params, state.robots, window_key, settings=settings)
    # Through the host, since these are sharded over the robots' devices and parameters are not.
    gradients = jax.device_get(replace(found, robots=None))
    learnt, summary = _learn(replace(state, robots=None), gradients, fit_key, settings=settings)
    return replace(learnt, robots=found.robots, key=key), summary


@struct.dataclass(kw_only=True)
class Gradient:
    """The objective and its derivative by the actor's weights, for each robot, and where the window led."""

    objective: Float[Array, " robots"]
    grad: PyTree  # of `Actor`, with an axis of robots
    window: Window
    robots: PyTree  # of type `Robots`; None within an update


@partial(jax.jit, static_argnames="settings")
def gradient(environment: Environment, params: Params, robots: Robots, key: Array, *, settings: Settings) -> Gradient:
    """Let a batch of robots act for a window, and return each robot's gradient of its objective.

    Args:
        environment: of all robots.
        params: actor and critics.
        robots: as the last window left them; their derivative is cut.
        key: of all robots' noise and episodes.
        settings: of the training.
    """

    def work(robots: Robots, keys: Array) -> Gradient:
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(keys), *leaf.shape)), params.actor)

        def total(actors: PyTree) -> tuple[Array, tuple[Array, Window, Robots]]:
            found = jax.vmap(partial(_walk, environment, params, settings=settings))(actors, robots, keys)
            return jnp.sum(found[0]), found

        grad, (objective, window, after) = jax.grad(total, has_aux=True)(copies)
        return Gradient(objective=objective, grad=grad, window=window, robots=after)

    return sharding.shard_robots(work, robots, jax.random.split(key, len(robots.is_over)))


def act(
    actor: Actor, observation: Float[Array, " inputs"], noise: Float[Array, " actions"]
) -> Float[Array, " actions"]:
    """Return the action for standard normal noise; without noise it is the deterministic actor's."""
    return jnp.tanh(perceptron.apply(actor.layers, observation) + jnp.exp(actor.log_std) * noise)


def td_lambda(window: Window, discount: float, trace: float) -> Float[Array, "robots steps"]:
    """Return the TD(lambda) values G of a window; those of steps that do not count mean nothing."""
    ends = window.terminated | window.truncated
    after = jnp.where(window.terminated, 0.0, window.next_value)

    def backward(later: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, value, is_end = now
        mixed = jnp.where(is_end, value, (1 - trace) * value + trace * later)
        target = reward + discount * mixed
        return target, target

    series = jax.tree.map(lambda leaf: leaf.T, (window.reward, after, ends))
    return jax.lax.scan(backward, window.next_value[:, -1], series, reverse=True)[1].T


def _walk(
    environment: Environment, params: Params, actor: Actor, robot: Robots, key: Array, *, settings: Settings
) -> tuple[Array, Window, Robots]:
    """Let one robot act for a window; return its objective, what the critic is fitted to, and the robot after it."""

    def value(inputs: Array) -> Array:
        return perceptron.apply(params.target, inputs)[0]

    def features(robot: Robots) -> Array:
        return jnp.concatenate([robot.observation, environment.privileged(robot.state)])

    def frame(carry: Scan, now: tuple[Array, Array]) -> tuple[Scan, Window]:
        (robot, discount, objective), (key, is_last) = carry, now
        noise_key, key = jax.random.split(key)
        noise = jax.random.normal(noise_key, actor.log_std.shape, robot.observation.dtype)
        moved = environment.step(key, robot.state, act(actor, robot.observation, noise))
        ends = moved.terminated | moved.truncated
        after = Robots(state=moved.state, observation=moved.observation, is_over=ends)
        next_value = value(features(after))
        counts = ~robot.is_over
        expected = jnp.where((ends | is_last) & ~moved.terminated, settings.discount * next_value, 0.0)
        objective = objective + jnp.where(counts, discount * (moved.reward + expected), 0.0)
        window = Window(
            inputs=features(robot),
            reward=moved.reward,
            next_value=next_value,
            terminated=moved.terminated,
            truncated=moved.truncated,
            counts=counts,
        )
        discount = jnp.where(ends | ~counts, 1.0, settings.discount * discount)
        return Scan(after, discount, objective), jax.lax.stop_gradient(window)

    one, zero = jnp.ones_like(robot.observation, shape=()), jnp.zeros_like(robot.observation, shape=())
    is_last = jnp.arange(settings.window) == settings.window - 1
    series = jax.random.split(key, settings.window), is_last
    (after, _, objective), window = jax.lax.scan(frame, Scan(robot, one, zero), series)
    return objective, window, after


@partial(jax.jit, static_argnames="settings")
def _reset(environment: Environment, key: Array, settings: Settings) -> Robots:
    keys = jax.random.split(key, settings.robots)
    observation, state = sharding.shard_robots(jax.vmap(environment.reset), keys)
    return Robots(state=state, observation=observation, is_over=jnp.zeros(settings.robots, bool))


@partial(jax.jit, static_argnames="settings")
def _learn(state: State, found: Gradient, key: Array, *, settings: Settings) -> tuple[State, Summary]:
    """Update actor and critic with a window; return the state, but for its robots, and a summary."""
    params = state.params
    grad, norms, nonfinite = _mean(found, settings.largest)
    actor, actor_optimiser = _ascend(params.actor, state.actor_optimiser, grad, settings)
    critic, critic_optimiser, loss = _fit_critic(params.critic, state.critic_optimiser, found.window, key, settings)
    target = jax.tree.map(lambda new, old: old + settings.target_rate * (new - old), critic, params.target)
    kept = jnp.where(nonfinite, jnp.nan, norms)
    summary = Summary(
        reward=jnp.sum(found.window.reward) / jnp.maximum(jnp.sum(found.window.counts), 1),
        objective=jnp.mean(found.objective, where=~nonfinite),
        ended=jnp.sum(found.window.terminated),
        median_norm=jnp.nanmedian(kept),
        max_norm=jnp.nanmax(kept),
        nonfinite=jnp.sum(nonfinite),
        critic_loss=loss,
    )
    learnt = replace(
        state,
        params=Params(actor=actor, critic=critic, target=target),
        actor_optimiser=actor_optimiser,
        critic_optimiser=critic_optimiser,
        updates=state.updates + 1,
    )
    return learnt, summary


def _mean(found: Gradient, largest: float) -> tuple[PyTree, Float[Array, " robots"], Bool[Array, " robots"]]:
    """Return the mean gradient of the robots for which it is finite, all norms, and which robots are left out."""
    norms: Array = jax.vmap(optax.tree.norm)(found.grad)
    nonfinite = ~(jnp.isfinite(norms) & jnp.isfinite(found.objective))
    median = jnp.nan_to_num(jnp.nanmedian(jnp.where(nonfinite, jnp.nan, norms)))
    factors = jnp.minimum(1.0, largest * median / jnp.maximum(norms, 1e-30))
    weights = jnp.where(nonfinite, 0.0, factors) / jnp.maximum(jnp.sum(~nonfinite), 1)

    def mean(leaf: Array) -> Array:
        finite = jnp.where(nonfinite.reshape(-1, *[1] * (leaf.ndim - 1)), 0.0, leaf)
        return jnp.tensordot(weights.astype(leaf.dtype), finite, axes=1)

    return jax.tree.map(mean, found.grad), norms, nonfinite


def _ascend(actor: Actor, optimiser: optax.OptState, grad: PyTree, settings: Settings) -> tuple[Any, optax.OptState]:
    """Move the actor along the gradient of the objective."""
    down: PyTree = jax.tree.map(jnp.negative, grad)
    updates, optimiser = _optimiser(settings.actor_learning_rate, settings).update(down, optimiser)
    weights: PyTree = actor
    return optax.apply_updates(weights, updates), optimiser


def _fit_critic(
    critic: Layers, optimiser: optax.OptState, window: Window, key: Array, settings: Settings
) -> tuple[Any, optax.OptState, Float[Array, ""]]:
    """Fit the critic to the TD(lambda) values of a window; return it with the loss of the last epoch."""
    targets = td_lambda(window, settings.discount, settings.trace)
    data = window.inputs.reshape(-1, window.inputs.shape[-1]), targets.reshape(-1), window.counts.reshape(-1)
    size = len(data[1]) // settings.minibatches
    adam = _optimiser(settings.critic_learning_rate, settings, _critic_steps(settings))

    def loss(layers: PyTree, inputs: Array, target: Array, counts: Array) -> Array:
        error = perceptron.apply(layers, inputs)[:, 0] - target
        return jnp.sum(jnp.where(counts, error**2, 0.0)) / jnp.maximum(jnp.sum(counts), 1)

    def minibatch(carry: tuple[PyTree, PyTree], rows: Array) -> tuple[tuple[PyTree, PyTree], Array]:
        layers, optimiser = carry
        value, grad = jax.value_and_grad(loss)(layers, *(leaf[rows] for leaf in data))
        updates, optimiser = adam.update(grad, optimiser)
        return (optax.apply_updates(layers, updates), optimiser), value

    orders = jax.vmap(lambda key: jax.random.permutation(key, len(data[1])))(
        jax.random.split(key, settings.critic_epochs)
    )
    rows = orders[:, : size * settings.minibatches].reshape(-1, size)
    (critic, optimiser), losses = jax.lax.scan(minibatch, (critic, optimiser), rows)
    return critic, optimiser, jnp.mean(losses[-settings.minibatches :])


def _critic_steps(settings: Settings) -> int:
    """Return the steps of the critic's optimiser in each window."""
    return settings.critic_epochs * settings.minibatches


def _optimiser(rate: float, settings: Settings, steps: int = 1) -> optax.GradientTransformation:
    """Return Adam on a clipped gradient, with a rate that decays to zero in the training; `steps` a window."""
    schedule = optax.linear_schedule(rate, 0.0, settings.updates * steps)
    return optax.chain(optax.clip_by_global_norm(settings.clip), optax.adam(schedule, b1=0.7, b2=0.95))
