"""The robot in a room as an environment of reinforcement learning, for use from JAX: `reset` and `step`.

```python
import jax
from lgmdjax.environments import functional

environment = functional.make(observation="lgmd", action="velocity")
observation, state = environment.reset(jax.random.key(0))
transition = jax.jit(functional.Environment.step)(environment, jax.random.key(1), state, action)
```

Both are pure functions; `jit`, `vmap`, `scan` and derivatives are the caller's. A step is one camera frame, 1/30 s: the
action is carried out, and the observation is made from the robot's new pose. A rollout (`lgmdjax.simulation`) in the
same room walks the same if its policy chooses the same actions.

An episode begins at a start of a room, both drawn with the key. It is terminated by a touch of an obstacle or a wall
and by a fall, and truncated when its time is up. The next step ignores its action, draws a new room and start with its
key, and has no reward (Gymnasium's `AutoresetMode.NEXT_STEP`); so no step renders twice.

| observation | shape              | unit           | what                                                    |
| ----------- | ------------------ | -------------- | ------------------------------------------------------- |
| lgmd        | (2,)               | 1, 0.5 to 1    | u of the left and the right LGMD                        |
| pixels      | (2, rows, columns) | grey, 0 to 255 | what either eye's LGMD receives                         |
| laser       | (341,)             | m, 0 to 5      | ranges from the rightmost ray (-85 deg) to the leftmost |

| action   | shape | unit                       | what                                                               |
| -------- | ----- | -------------------------- | ------------------------------------------------------------------ |
| velocity | (2,)  | nominal, 0.05 m/s: -1 to 2 | of the left and the right legs; CPG and shaping networks move them |
| joints   | (18,) | rad                        | servo set points, leg by leg (`hexapod.LEGS`): coxa, femur, tibia  |

Velocities beyond the gait's range are limited as for all policies (`braitenberg.limit`), set points by the servos'
limits.

Gradient: by action, state and the robot's parameters, through all that reward and observation depend on, except the
choice of a room and the end of an episode.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, policies
from lgmdjax.control.policies import BLIND, BlindParams
from lgmdjax.environments import coverage
from lgmdjax.environments.rewards import Outcome, Reward, RewardName, get_reward
from lgmdjax.errors import InputError
from lgmdjax.evaluation import trials
from lgmdjax.evaluation.settings import TrialName
from lgmdjax.runtime.mjx import mjx
from lgmdjax.simulation import assembly, closed_loop, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE, Room
from lgmdjax.world import arena

ObservationName = Literal["lgmd", "pixels", "laser"]
ActionName = Literal["velocity", "joints"]
RoomName = Literal["random", TrialName]
ROOM_COUNT = 64  # random rooms, each with 32 starts
Tree = TypeVar("Tree")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Observation, action and reward; hashable, so that equal settings share one compiled program."""

    observation: ObservationName
    action: ActionName
    reward: Reward

    vision_gradient: bool  # through the pictures

    @property
    def uses_camera(self) -> bool:
        """Whether pictures have to be rendered."""
        return self.observation != "laser"


@struct.dataclass(kw_only=True)
class State:
    """State of one robot within its episode."""

    robot: closed_loop.State
    sensed: policies.Observation  # at the present pose; a critic may use more of it than the actor
    floor: coverage.State
    room: Int[Array, ""]  # number of the room
    start: Int[Array, ""]  # number of the room's start
    done: Bool[Array, ""]  # the episode has ended


class Transition(NamedTuple):
    """What a step returns."""

    observation: Array
    state: State
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]  # touched something, or fell
    truncated: Bool[Array, ""]  # the time is up
    outcome: Outcome


@struct.dataclass(kw_only=True)
class Environment:
    """A robot and the rooms of its episodes, as a pytree; from `make`."""

    params: closed_loop.Params
    model: mjx.Model
    rooms: Room  # a batch
    frames: Int[Array, ""]  # after which an episode is truncated
    settings: Settings = struct.field(pytree_node=False)

    def reset(self, key: Array) -> tuple[Array, State]:
        """Return the observation and the state at a start of a room, both drawn with the key."""
        return self._observe(self._begin(key))

    def ended(self, key: Array) -> State:
        """Return the state of an episode that has ended, so that the next step does what `reset` does.

        A loop that begins with it needs one program instead of two, which halves the time of compilation.
        """
        return replace(self._begin(key), done=jnp.asarray(True))

    def step(self, key: Array, state: State, action: Float[Array, " action"]) -> Transition:
        """Return the transition that an action causes in one frame; after the end of an episode, the start of the next.

        Args:
            key: draws the next episode's room and start, if the last one has ended.
            state: from `reset`, or from the last step.
            action: as in the module's table.
        """
        moved, outcome = self._move(state, action)
        ends = outcome.touched | outcome.fell
        terminated = ends & ~state.done
        truncated = (moved.robot.frame >= self.frames) & ~ends & ~state.done
        moved = replace(moved, done=terminated | truncated)
        reward = jnp.where(state.done, 0.0, self.settings.reward(outcome))
        observation, after = self._observe(choose(state.done, self._begin(key), moved))
        return Transition(observation, after, reward, terminated, truncated, outcome)

    def room_of(self, state: State) -> Room:
        """Return the room of the present episode, whose first start is the episode's; for `rollout`."""
        room = jax.tree.map(lambda leaf: leaf[state.room], self.rooms)
        return replace(room, starts=jnp.roll(room.starts, -state.start, axis=0))

    def _begin(self, key: Array) -> State:
        """Return the state at a start of a room, before its first observation."""
        room_key, start_key = jax.random.split(key)
        count, starts, _ = self.rooms.starts.shape
        room, start = (
            jax.random.randint(one, (), 0, size, jnp.int32) for one, size in ((room_key, count), (start_key, starts))
        )
        place = jax.tree.map(lambda leaf: leaf[room], self.rooms)
        place = replace(place, starts=place.starts[start][None])
        robot = closed_loop.init(self.params, self.model, place, BLIND)
        return State(
            robot=robot,
            sensed=_sense_nothing(),
            floor=coverage.init(hexapod.pose(robot.data).position[:2]),
            room=room,
            start=start,
            done=jnp.asarray(False),
        )

    def _move(self, state: State, action: Float[Array, " action"]) -> tuple[State, Outcome]:
        """Carry out an action; return the state, not yet observed, and the outcome of the frame."""
        targets, velocity = None, jnp.zeros(2)
        if self.settings.action == "velocity":
            velocity = braitenberg.limit(policies.GAIT_RANGE, action)
        else:
            targets = action.reshape(6, 3)
        before = replace(state.robot, controller=replace(state.robot.controller, velocity=velocity))
        after, clearance = closed_loop.move(self.params, self.model, self._scene(state), before, targets)
        after = closed_loop.freeze_unhealthy(self.model, before, after)
        pose = hexapod.pose(after.data)
        floor, (new_cells, new_floor) = coverage.step(state.floor, pose.position[:2])
        outcome = Outcome(
            position=pose.position,
            quaternion=pose.quaternion,
            velocity=velocity,
            clearance=clearance,
            new_cells=new_cells,
            new_floor=new_floor,
            touched=clearance <= 0,
            fell=~after.ok,
        )
        return replace(state, robot=after, floor=floor), outcome

    def _observe(self, state: State) -> tuple[Array, State]:
        """Return what the robot observes from where it is, and the state after that."""
        frames, ranges = closed_loop.sense(self.params, self._scene(state), state.robot, self.settings.uses_camera)
        frames = frames if self.settings.vision_gradient else jax.lax.stop_gradient(frames)
        robot, sensed = closed_loop.respond(self.params, state.robot, frames, ranges)
        observation = {"lgmd": sensed.u, "pixels": frames, "laser": ranges}[self.settings.observation]
        return observation, replace(state, robot=robot, sensed=sensed)

    def _scene(self, state: State) -> arena.Arena:
        """Return the room with its obstacles where they are now."""
        room = jax.tree.map(lambda leaf: leaf[state.room], self.rooms.arena)
        return arena.at_time(room, state.robot.frame / FRAME_RATE)


def make(
    *,
    observation: ObservationName = "lgmd",
    action: ActionName = "velocity",
    room: RoomName | Room = "random",
    reward: RewardName | Reward = "cells",
    robot: closed_loop.Params | None = None,
    seconds: float = 60.0,
    vision_gradient: bool = True,
) -> Environment:
    """Return an environment.

    Args:
        observation: what the robot observes (module's table).
        action: what it commands (module's table).
        room: "random" for random rooms; the name of a trial for its rooms (`trials.TRIALS`), from the trial's start;
            or a batch of your own rooms (`lgmdjax.simulation.room_batches`), from any of their starts.
        reward: its name, or a function of the outcome (`lgmdjax.environments.rewards`).
        robot: its body, gait, camera and LGMDs are used, not its policies; the pretrained robot by default.
        seconds: of robot time after which an episode is truncated.
        vision_gradient: whether derivatives pass through the pictures, which costs twice as much as all the rest.

    Raises InputError for an unknown name, a room that is too large, and an impossible number of seconds.
    """
    for what, name, names in (("observation", observation, ObservationName), ("action", action, ActionName)):
        if name not in get_args(names):
            raise InputError(f"{what}: expected one of {', '.join(get_args(names))}, got {name!r}; choose one of these")
    if not 1 / FRAME_RATE <= seconds < math.inf:
        raise InputError(f"seconds: expected at least one frame of 1/30 s, and finitely many, got {seconds}")
    params = assembly.load_robot() if robot is None else robot
    settings = Settings(
        observation=observation,
        action=action,
        reward=get_reward(reward),
        vision_gradient=vision_gradient,
    )
    blind = BlindParams(velocity=jnp.zeros(2))  # the action takes the place of the policy
    params = replace(params, controller=replace(params.controller, policy=blind))
    frames = jnp.asarray(round(seconds * FRAME_RATE), jnp.int32)
    model = closed_loop.build_model(params)
    return Environment(params=params, model=model, rooms=_make_rooms(room), frames=frames, settings=settings)


def _make_rooms(room: RoomName | Room) -> Room:
    """Return a batch of rooms, from a name or as it is."""
    if not isinstance(room, str):
        _check_rooms(room)
        return room
    if room == "random":
        return room_batches.random_rooms(jax.random.key(0), ROOM_COUNT)
    if room not in trials.TRIALS:
        raise InputError(
            f"room: expected random, a batch of rooms, or one of {', '.join(trials.TRIALS)}, got {room!r}; "
            "choose one of these"
        )
    rooms = trials.sample_rooms(room, trials.TRIALS[room].seeds, 0)
    return replace(rooms, starts=rooms.starts[:, :1])


def _check_rooms(rooms: Room) -> None:
    if np.ndim(rooms.starts) != 3:
        raise InputError(
            f"room: expected a batch of rooms, with starts of shape (rooms, starts, 3), got {np.shape(rooms.starts)}; "
            "put a single one into room_batches.stack_rooms([room])"
        )
    if rooms.faults is not None:
        raise InputError("room: expected rooms without camera faults, got some with; leave Room.faults out")
    x_min, x_max, y_min, y_max = np.moveaxis(np.asarray(rooms.arena.bounds), -1, 0)
    largest = float(max(np.max(x_max - x_min), np.max(y_max - y_min)))
    if largest > coverage.MAX_SIZE:
        raise InputError(f"room: expected sides up to {coverage.MAX_SIZE:g} m, got {largest:g} m; take a smaller room")


def _sense_nothing() -> policies.Observation:
    zeros = jnp.zeros(2)
    return policies.Observation(u=zeros, feed_forward=zeros, excitation=zeros, distances=zeros, corridor=zeros)


def choose(condition: Bool[Array, ""], chosen: Tree, otherwise: Tree) -> Tree:
    """Return one of two pytrees of the same structure."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), chosen, otherwise)
