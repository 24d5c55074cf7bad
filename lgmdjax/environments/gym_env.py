"""Gymnasium's interface of the environment (`lgmdjax.environments.functional`), which the extra `gym` installs.

```python
import gymnasium
import lgmdjax.environments  # registers lgmdjax/Hexapod-v0

environment = gymnasium.make("lgmdjax/Hexapod-v0", observation="laser", action="velocity", render_mode="rgb_array")
many = gymnasium.make_vec("lgmdjax/Hexapod-v0", num_envs=16)
```

`gymnasium.make("lgmdjax.environments:lgmdjax/Hexapod-v0")` does both at once; Gymnasium has no entry point for plugins.

| interface        | arrays                  | robots                                              |
| ---------------- | ----------------------- | --------------------------------------------------- |
| HexapodEnv       | NumPy                   | one                                                 |
| HexapodVectorEnv | JAX (`metadata["jax"]`) | many: one compiled program, spread over JAX's devices |

Spaces are those of the tables in `functional`, with their units, but pictures are integers of 8 bits, as a camera's
are. An action of another shape, or one that is not finite, raises `InputError`. Each `info` holds the outcome of the
frame (`rewards.Outcome`) under the names of its fields.

In the vector environment, a robot whose episode has ended starts the next one in the next step
(`AutoresetMode.NEXT_STEP`).
"""

from functools import partial
from importlib.util import find_spec
from typing import Any, ClassVar, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.environments import functional, rendering
from lgmdjax.environments.functional import ActionName, Environment, ObservationName, RoomName, State, Transition
from lgmdjax.environments.rewards import Reward, RewardName
from lgmdjax.errors import InputError
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop, sharding
from lgmdjax.simulation.closed_loop import FRAME_RATE, Room

if find_spec("gymnasium") is None:
    raise InputError("expected gymnasium for this interface, got an environment without it; pip install 'lgmdjax[gym]'")

import gymnasium
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

RENDER_MODES = ("rgb_array",)
Info: TypeAlias = dict[str, Any]  # as Gymnasium has it


def observation_space(environment: Environment) -> spaces.Box:
    """Return the space of one observation; units and order as in the table of `functional`."""
    laser = environment.params.laser
    if environment.settings.observation == "lgmd":
        return spaces.Box(0.5, 1.0, (2,), np.float32)  # u of the left and the right LGMD
    if environment.settings.observation == "pixels":
        return spaces.Box(0, 255, camera.image_shape(environment.params.camera), np.uint8)  # grey
    return spaces.Box(0.0, float(laser.max_range), (laser.rays,), np.float32)  # m


def action_space(environment: Environment) -> spaces.Box:
    """Return the space of one action; units and order as in the table of `functional`."""
    if environment.settings.action == "velocity":
        gait = policies.GAIT_RANGE
        return spaces.Box(float(gait.min_velocity), float(gait.max_velocity), (2,), np.float32)  # nominal, 0.05 m/s
    low, high = hexapod.target_limits(environment.params.body).reshape(2, 18).astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)  # rad


class HexapodEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot in rooms, with NumPy arrays; arguments as in `functional.make`, and Gymnasium's `render_mode`."""

    metadata: ClassVar[Info] = {"render_modes": [*RENDER_MODES], "render_fps": round(FRAME_RATE)}  # pyright: ignore

    def __init__(
        self,
        *,
        render_mode: str | None = None,
        observation: ObservationName = "lgmd",
        action: ActionName = "velocity",
        room: RoomName | Room = "random",
        reward: RewardName | Reward = "cells",
        robot: closed_loop.Params | None = None,
        seconds: float = 60.0,
    ) -> None:
        self.functional = functional.make(
            observation=observation, action=action, room=room, reward=reward, robot=robot, seconds=seconds
        )
        self.render_mode = _check_render_mode(render_mode)
        self._observed, self._commanded = observation_space(self.functional), action_space(self.functional)
        self.observation_space, self.action_space = self._observed, self._commanded
        self.state: State | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """Begin an episode; return its first observation and an empty info.

        Args:
            seed: of this episode's room and start, and of all that follow.
            options: not used.
        """
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        begun = _step(self.functional, key, _ended(self.functional, key), self._no_action)
        self.state = begun.state
        return self._to_numpy(begun.observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Carry out an action for one frame, 1/30 s; return observation, reward, terminated, truncated and info."""
        state = _require_state(self.state)
        checked = _check_action(action, self._commanded.shape)
        transition = _step(self.functional, jax.random.key(0), state, checked)
        self.state = transition.state
        return (
            self._to_numpy(transition.observation),
            float(transition.reward),
            bool(transition.terminated),
            bool(transition.truncated),
            {name: np.asarray(value)[()] for name, value in vars(transition.outcome).items()},
        )

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture of the robot in its room (`rendering.render`) in mode rgb_array, else None."""
        return rendering.render(self.functional, _require_state(self.state)) if self.render_mode else None

    @property
    def _no_action(self) -> Array:
        return jnp.zeros(self._commanded.shape, float)

    def _to_numpy(self, observation: Array) -> np.ndarray:
        return np.asarray(_to_space(observation, self._observed))


class HexapodVectorEnv(VectorEnv[Array, Array, Array]):
    """Robots in rooms, with JAX arrays and one compiled program; arguments as in `functional.make`."""

    metadata: ClassVar[Info] = {  # pyright: ignore
        "render_modes": [*RENDER_MODES],
        "render_fps": round(FRAME_RATE),
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "jax": True,
    }

    def __init__(
        self,
        num_envs: int,
        *,
        render_mode: str | None = None,
        observation: ObservationName = "lgmd",
        action: ActionName = "velocity",
        room: RoomName | Room = "random",
        reward: RewardName | Reward = "cells",
        robot: closed_loop.Params | None = None,
        seconds: float = 60.0,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs: expected one or more, got {num_envs}; choose how many robots there are")
        self.functional = functional.make(
            observation=observation, action=action, room=room, reward=reward, robot=robot, seconds=seconds
        )
        self.num_envs = num_envs
        self.render_mode = _check_render_mode(render_mode)
        self._observed, self._commanded = observation_space(self.functional), action_space(self.functional)
        self.single_observation_space, self.single_action_space = self._observed, self._commanded
        self.observation_space = batch_space(self._observed, num_envs)
        self.action_space = batch_space(self._commanded, num_envs)
        self.state: State | None = None
        self.key = jax.random.key(0)

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Array, Info]:
        """Begin an episode of every robot; return their first observations and an empty info.

        Args:
            seed: of these episodes' rooms and starts, and of all that follow.
            options: not used.
        """
        super().reset(seed=seed)
        self.key = jax.random.key(int(self.np_random.integers(2**31)))
        before = ended_batch(self.functional, self.key, robots=self.num_envs)
        begun, self.key = step_batch(
            self.functional, self.key, before, jnp.zeros((self.num_envs, *self._commanded.shape), float)
        )
        self.state = begun.state
        return _to_space(begun.observation, self._observed), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        """Carry out an action of each robot for one frame, 1/30 s; return what `HexapodEnv.step` does, batched."""
        state = _require_state(self.state)
        checked = _check_action(actions, (self.num_envs, *self._commanded.shape))
        transition, self.key = step_batch(self.functional, self.key, state, checked)
        self.state = transition.state
        observation = _to_space(transition.observation, self._observed)
        ended = transition.terminated, transition.truncated
        return observation, transition.reward, *ended, dict(vars(transition.outcome))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture of each robot in its room in mode rgb_array, else None."""
        if not self.render_mode:
            return None
        states = _require_state(self.state)
        one_by_one = (jax.tree.map(lambda leaf, n=n: leaf[n], states) for n in range(self.num_envs))
        return tuple(rendering.render(self.functional, state) for state in one_by_one)


@partial(jax.jit, static_argnames="robots")
def ended_batch(environment: Environment, key: Array, *, robots: int) -> State:
    """Return the states of a batch of robots whose next step begins their episodes (`Environment.ended`)."""
    return jax.vmap(environment.ended)(jax.random.split(key, robots))


@jax.jit
def step_batch(
    environment: Environment, key: Array, states: State, actions: Float[Array, "robots action"]
) -> tuple[Transition, Array]:
    """Step a batch of robots, spread over devices; return their transitions, and the next key."""
    keys = jax.random.split(key, len(actions) + 1)
    return sharding.shard_robots(jax.vmap(environment.step), keys[1:], states, actions), keys[0]


_ended, _step = jax.jit(Environment.ended), jax.jit(Environment.step)


def _to_space(observation: Array, space: spaces.Box) -> Array:
    """Return observations in the range and dtype of their space; grey levels are rounded."""
    exact = jnp.round(observation) if space.dtype == np.uint8 else observation
    return jnp.clip(exact, float(space.low.min()), float(space.high.max())).astype(space.dtype)


def _check_action(action: np.ndarray | Array, shape: tuple[int, ...]) -> Float[Array, "*shape"]:
    array = jnp.asarray(action, float)
    if array.shape != shape or not bool(jnp.all(jnp.isfinite(array))):
        raise InputError(f"action: expected {shape} finite numbers, got {array.tolist()}; see the action space")
    return array


def _check_render_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, *RENDER_MODES):
        raise InputError(f"render_mode: expected None or {' or '.join(RENDER_MODES)}, got {render_mode!r}")
    return render_mode


def _require_state(state: State | None) -> State:
    if state is None:
        raise InputError("expected reset() before step() or render(), got an environment without an episode; reset it")
    return state
