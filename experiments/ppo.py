"""PPO by Stable-Baselines3 on many robots of one compiled program: `VectorEnvironment`, and `train`.

Needs the extra `rl` (`pip install 'lgmdjax[rl]'`). `reinforcement_learning.py` compares it with SHAC.

The actor is a Gaussian whose sample tanh limits to -1..1, as SHAC's is. The network of the critic sees the privileged
observation too, as SHAC's does.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from gymnasium import spaces
from jaxtyping import Array, Bool, Float
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.policies import ActorCriticPolicy  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from lgmdjax.control.perceptron import Layer, Layers
from lgmdjax.environments.commands import Commands, State
from lgmdjax.simulation import sharding

LARGEST_ACTION = 4.0  # before tanh
RESETS = 8  # episodes that are begun at once
REWARD_SCALE = 0.2  # a touch then costs 2
WINDOW = 32  # commands of each robot between two updates
BATCH = 256  # commands
EPOCHS = 10
LEARNING_RATE = 1e-3  # decays linearly to zero


class VectorEnvironment(VecEnv):
    """Robots as an environment of Stable-Baselines3; an episode that ends begins again at once.

    An observation is the actor's followed by the privileged one.

    Args:
        environment: of one robot.
        robots: number of robots.
        seed: of all episodes.
    """

    def __init__(self, environment: Commands, robots: int, seed: int) -> None:
        size = environment.observation_size + environment.privileged_size
        super().__init__(
            robots,
            spaces.Box(-np.inf, np.inf, (size,), np.float32),
            spaces.Box(-LARGEST_ACTION, LARGEST_ACTION, (environment.action_size,), np.float32),
        )
        self.environment = environment
        self.key = jax.random.key(seed)
        self.rewards: list[np.ndarray] = []  # of every command, not scaled
        self.states: State | None = None
        self.actions = np.zeros((robots, environment.action_size), np.float32)

    def reset(self) -> np.ndarray:
        """Begin an episode of every robot; return the observations."""
        self.states, observations = _reset(self.environment, self._next_key(), robots=self.num_envs)
        return np.array(observations, np.float32)

    def warm_up(self) -> None:
        """Compile everything, and forget what happened."""
        self.reset()
        observations, *_ = self.step(self.actions)
        self._begin(np.arange(1), observations)
        self.step(self.actions)
        self.rewards = []

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Carry out the actions; return observations, scaled rewards, ends of episodes, and infos."""
        assert self.states is not None, "reset the environment before its first step"
        actions = jnp.asarray(self.actions, float)
        self.states, *found = _step(self.environment, self._next_key(), self.states, actions)
        observations, rewards, terminated, truncated = (np.array(leaf) for leaf in found)
        self.rewards.append(rewards)
        ends, infos = terminated | truncated, [{} for _ in range(self.num_envs)]
        for robot in np.flatnonzero(ends):
            infos[robot] = {
                "terminal_observation": observations[robot].astype(np.float32),
                "TimeLimit.truncated": bool(truncated[robot]),
            }
        self._begin(np.flatnonzero(ends), observations)
        return observations.astype(np.float32), REWARD_SCALE * rewards.astype(np.float32), ends, infos

    def close(self) -> None:
        """Do nothing."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return None for the render mode, of every robot."""
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise an error: robots have no attributes of their own."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Raise an error: robots have no methods of their own."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return that no robot is in a wrapper."""
        return [False] * self.num_envs

    def _begin(self, robots: np.ndarray, observations: np.ndarray) -> None:
        """Begin an episode of these robots, and put their observations in their places."""
        for first in range(0, len(robots), RESETS):
            chosen = robots[first : first + RESETS]
            rows = np.full(RESETS, self.num_envs, np.int32)  # beyond the last robot: dropped
            rows[: len(chosen)] = chosen
            states, fresh = _replace(self.environment, self._next_key(), self.states, rows)
            # On the devices where they were, or all would be compiled again for other ones.
            self.states = jax.tree.map(lambda new, old: jax.device_put(new, old.sharding), states, self.states)
            observations[chosen] = np.asarray(fresh)[: len(chosen)]

    def _next_key(self) -> Array:
        self.key, key = jax.random.split(self.key)
        return key


@partial(jax.jit, static_argnames="robots")
def _reset(environment: Commands, key: Array, *, robots: int) -> tuple[State, Float[Array, "robots features"]]:
    return sharding.shard_robots(jax.vmap(partial(_reset_one, environment)), jax.random.split(key, robots))


@jax.jit
def _step(
    environment: Commands, key: Array, states: State, actions: Float[Array, "robots actions"]
) -> tuple[State, Array, Array, Bool[Array, " robots"], Bool[Array, " robots"]]:
    def step(key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        moved = environment.step(key, state, jnp.tanh(action))
        observation = jnp.concatenate([moved.observation, environment.privileged(moved.state)])
        return moved.state, observation, moved.reward, moved.terminated, moved.truncated

    return sharding.shard_robots(jax.vmap(step), jax.random.split(key, len(actions)), states, actions)


@jax.jit
def _replace(
    environment: Commands, key: Array, states: State, rows: np.ndarray
) -> tuple[State, Float[Array, "resets features"]]:
    """Return the states with new episodes in some rows, and the first observations of these."""
    fresh, observations = jax.vmap(partial(_reset_one, environment))(jax.random.split(key, len(rows)))
    return jax.tree.map(lambda leaf, new: leaf.at[rows].set(new, mode="drop"), states, fresh), observations


def _reset_one(environment: Commands, key: Array) -> tuple[State, Array]:
    observation, state = environment.reset(key)
    return state, jnp.concatenate([observation, environment.privileged(state)])


class _Networks(torch.nn.Module):
    """Layers of tanh units of actor and critic; the actor sees the first `observed` features, the critic all."""

    def __init__(self, observed: int, features: int, units: Sequence[int]) -> None:
        super().__init__()
        self.observed = observed
        self.latent_dim_pi = self.latent_dim_vf = units[-1]
        self.actor, self.critic = _layers(observed, units), _layers(features, units)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return self.actor(features[:, : self.observed])

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        return self.critic(features)


def _layers(inputs: int, units: Sequence[int]) -> torch.nn.Sequential:
    sizes = [inputs, *units]
    layers = [torch.nn.Linear(*sizes[k : k + 2]) for k in range(len(units))]
    return torch.nn.Sequential(*(part for layer in layers for part in (layer, torch.nn.Tanh())))


class _Policy(ActorCriticPolicy):
    """Stable-Baselines3's policy with `_Networks`."""

    def __init__(self, *args: Any, observed: int, units: Sequence[int], **kwargs: Any) -> None:
        self.observed, self.units = observed, tuple(units)
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _Networks(self.observed, self.features_dim, self.units)


class _Reports(BaseCallback):
    def __init__(self, report: Callable[[int], None]) -> None:
        super().__init__()
        self.report = report

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.report(self.num_timesteps)


def train(
    environment: VectorEnvironment,
    *,
    commands: int,
    seed: int,
    discount: float,
    trace: float,
    units: Sequence[int],
    log_std: float,
    report: Callable[[int], None],
) -> Layers:
    """Train with PPO; return the layers of the actor, whose output is the action before tanh.

    Args:
        environment: of all robots.
        commands: of all robots together.
        seed: of weights and noise.
        discount: gamma, of a command.
        trace: lambda of the generalised advantage estimate.
        units: of the hidden layers of actor and critic.
        log_std: logarithm of the actor's standard deviation at the start.
        report: called with the number of commands so far before every update.
    """
    torch.set_num_threads(1)  # faster for small networks
    learner = PPO(
        _Policy,
        environment,
        learning_rate=lambda remaining: LEARNING_RATE * remaining,
        n_steps=WINDOW,
        batch_size=BATCH,
        n_epochs=EPOCHS,
        gamma=discount,
        gae_lambda=trace,
        seed=seed,
        device="cpu",
        policy_kwargs={
            "observed": environment.environment.observation_size,
            "units": tuple(units),
            "log_std_init": log_std,
        },
    )
    learner.learn(commands, callback=_Reports(report))
    network = learner.policy
    linear = [part for part in network.mlp_extractor.actor if isinstance(part, torch.nn.Linear)]
    return tuple(_to_layer(layer) for layer in (*linear, network.action_net))


def _to_layer(linear: torch.nn.Linear) -> Layer:
    kernel, bias = (jnp.asarray(part.detach().numpy(), float) for part in (linear.weight.T, linear.bias))
    return Layer(kernel=kernel, bias=bias)
