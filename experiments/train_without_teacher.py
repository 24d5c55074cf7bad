"""Train the navigator by its reward alone, with PPO and with SHAC, and score both beside imitation.

    python experiments/train_without_teacher.py shac --seed 0
    python experiments/train_without_teacher.py ppo --seed 0   # extra ppo, in an environment of its own
    python experiments/train_without_teacher.py score

| learner | gradient                                                                  | program                     |
| ------- | ------------------------------------------------------------------------- | --------------------------- |
| shac    | of the reward of 24 frames, through the simulator, and of a critic beyond | `lgmdjax.learning.shac`     |
| ppo     | of the probability of its actions (score function)                        | RecurrentPPO of sb3-contrib |

Both train the paper's network (an LSTM of 32 units on the two u, nothing else) from random weights, in the same rooms,
for the same simulated frames and the same reward: floor covered, less touches (`rewards.floor`). Neither sees the
teacher. PPO's critic is an LSTM on the same u; that of SHAC sees the laser's distances.

Each run writes controller.safetensors and curve.json into a folder of its own. SHAC resumes after an interruption, PPO
begins again. `score` lets every navigator in the folder walk in held-out random rooms, with the metrics of the drivers'
table (`lgmdjax.evaluation.metrics`), beside the teacher, imitation (the pretrained robot), blind and random.
"""

import sys
import time
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from lgmdjax.cli.main import exit_code
from lgmdjax.control import navigator, policies
from lgmdjax.control.names import PolicyName
from lgmdjax.environments import functional, gym_env
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.learning import shac as shac_learning
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.runtime.storage import JsonObject, write_json
from lgmdjax.simulation import assembly, closed_loop, recording, room_batches
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.settings import BenchmarkRooms

if HAS_PPO := find_spec("sb3_contrib") is not None:
    import torch  # pyright: ignore[reportMissingImports]
    from sb3_contrib import RecurrentPPO  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
else:
    BaseCallback = VecEnv = object

OUT = Path("runs/without-teacher")
ROBOTS = 16
ROOMS_SEED, ROOMS = 17, 64  # of the rooms to train in
SECONDS = 32.0  # of an episode
SCORE_SEED = 2028  # of the rooms to score in
U_MEAN, U_SCALE = 0.5, 0.1  # PPO's input is standardised as `navigator.create` does
FILE = "controller.safetensors"


def make_environment() -> functional.Environment:
    """Return the environment that both train in."""
    rooms = room_batches.training_rooms(ROOMS_SEED, 0, ROOMS)
    return functional.make(room=rooms, reward="floor", seconds=SECONDS, vision_gradient=False)


def shac(seed: int = 0, frames: int = 61_440, out: Path = OUT) -> None:
    """Train by the derivative of the simulator.

    Args:
        seed: of weights, rooms and noise
        frames: simulated frames of all robots together; rounded to whole rounds of 15360
        out: the folder that gets a folder for this run
    """
    base = shac_learning.Settings(robots=ROBOTS)
    settings = replace(base, rounds=max(1, round(frames / (ROBOTS * base.frames * base.windows))))
    folder, began, curve = out / f"shac-{seed}", time.monotonic(), []

    def on_window(stats: shac_learning.WindowStats) -> None:
        curve.append({"seconds": time.monotonic() - began, **stats._asdict()})
        _tell(len(curve) * ROBOTS * settings.frames, stats.reward, stats.ends, began)

    checkpoints = Checkpoints(folder / "checkpoints", {"settings": asdict(settings), "seed": seed})
    actor, rows = shac_learning.train(make_environment(), settings, seed, checkpoints=checkpoints, on_window=on_window)
    seconds = [row["seconds"] for row in curve]
    frames_each = ROBOTS * settings.frames
    table = [{"frames": (n + 1) * frames_each, **row._asdict()} for n, row in enumerate(rows)]
    _write(
        folder, actor, {"settings": asdict(settings), "seed": seed, "seconds": seconds[-1] if seconds else 0.0}, table
    )


def ppo(seed: int = 0, frames: int = 61_440, out: Path = OUT) -> None:
    """Train by the score function.

    Args:
        seed: of weights, rooms and actions
        frames: simulated frames of all robots together
        out: the folder that gets a folder for this run
    """
    if not HAS_PPO:
        raise InputError("expected sb3-contrib, got an environment without it; pip install 'lgmdjax[ppo]'")
    torch.set_num_threads(1)  # pyright: ignore[reportPossiblyUnboundVariable]
    settings = {
        "n_steps": 128, "batch_size": 512, "n_epochs": 5, "learning_rate": 1e-3, "gamma": 0.99, "gae_lambda": 0.95,
        "use_sde": True, "sde_sample_freq": 24,  # noise that lasts for a gait cycle
    }  # fmt: skip
    network = {"net_arch": [], "lstm_hidden_size": navigator.UNITS}
    model: Any = RecurrentPPO(  # pyright: ignore[reportPossiblyUnboundVariable]
        "MlpLstmPolicy", _Robots(make_environment(), seed), policy_kwargs=network, seed=seed, device="cpu", **settings
    )
    curve = _Curve()
    model.learn(frames, callback=curve)
    seconds, actor = time.monotonic() - curve.began, to_navigator(model.policy)
    require_same(model, actor)
    _write(
        out / f"ppo-{seed}",
        actor,
        {"settings": settings, "seed": seed, "seconds": seconds},
        curve.rows,
    )


def to_navigator(policy: Any) -> navigator.Params:
    """Return a navigator that computes the mean action of a recurrent policy of sb3-contrib, in units of velocity."""
    gates, head = policy.lstm_actor, policy.action_net
    numbers = {
        name: jnp.asarray(value.detach().numpy(), float)
        for name, value in (*gates.named_parameters(), *head.named_parameters())
    }
    cell = {
        "dense_i": {"kernel": numbers["weight_ih_l0"].T},
        "dense_h": {"kernel": numbers["weight_hh_l0"].T, "bias": numbers["bias_ih_l0"] + numbers["bias_hh_l0"]},
    }
    weights = {"cell": cell, "head": {"kernel": numbers["weight"].T, "bias": numbers["bias"]}}
    middle, half = _velocity_range()
    created = navigator.create(jax.random.key(0), "lstm", gates.hidden_size)
    return replace(created, weights=weights, output_mean=jnp.full(2, middle), output_scale=jnp.full(2, half))


def require_same(model: Any, actor: navigator.Params, frames: int = 30) -> None:
    """Raise InputError unless the navigator commands what the model of sb3-contrib does, within 1e-4 nominal."""
    middle, half = _velocity_range()
    state, memory = None, navigator.init(actor)
    for frame, u in enumerate(np.random.default_rng(0).uniform(0.5, 0.8, (frames, 2))):
        first = np.array([frame == 0])
        action, state = model.predict(_standardise(u)[None], state=state, episode_start=first, deterministic=True)
        memory, velocity = navigator.step(actor, memory, jnp.asarray(u, float))
        difference = np.abs(np.clip(velocity, middle - half, middle + half) - (middle + half * action[0])).max()
        if difference > 1e-4:
            raise InputError(
                f"expected the same velocity from sb3-contrib and navigator, got {difference:.2g} of difference"
            )


def score(out: Path = OUT, robots: int = 16, seconds: float = 60.0) -> None:
    """Score every navigator in the folder, and write score.json.

    Args:
        out: the folder with the runs
        robots: one in each held-out random room
        seconds: of robot time
    """
    robot = assembly.load_robot()
    benchmark = BenchmarkRooms(eyes=assembly.camera_settings(robot), robots=robots, seconds=seconds)
    rooms = room_batches.benchmark_rooms(benchmark, SCORE_SEED)
    baselines: dict[str, PolicyName] = {
        "teacher": "teacher",
        "imitation": "learned",
        "blind": "blind",
        "random": "random",
    }
    drivers: dict[str, tuple[closed_loop.Params, PolicyName]] = {
        name: (robot, policy) for name, policy in baselines.items()
    }
    for path in sorted(out.glob(f"*/{FILE}")):
        drivers[path.parent.name] = assembly.with_policy(robot, "learned", navigator.load(path)[0]), "learned"
    rows: list[JsonObject] = []
    for name, (one, policy) in drivers.items():
        found = metrics.score(recording.rollout(one, rooms, seconds=seconds, policy=policy))
        rows.append({"driver": name, "robots": robots, "seconds": seconds, "seed": SCORE_SEED, **asdict(found)})
        print(f"{name:12s} {found.per_100_m!s:24s} {found.progress.coverage!s:24s} {found.speed:.3f} m/s", flush=True)
    write_json(out / "score.json", rows)


class _Robots(VecEnv):  # pyright: ignore[reportGeneralTypeIssues]
    """The environment for Stable-Baselines3, which wants an ended episode's successor in the same step.

    The step that begins it is taken at once, with all robots, and kept for those whose episode has ended.
    """

    def __init__(self, environment: functional.Environment, seed: int) -> None:
        self.environment, self.key = environment, jax.random.key(seed)
        unit = gym_env.spaces.Box(-1.0, 1.0, (2,), np.float32)
        inputs = gym_env.spaces.Box(0.0, 0.5 / U_SCALE, (2,), np.float32)
        super().__init__(ROBOTS, inputs, unit)  # pyright: ignore[reportCallIssue]

    def reset(self) -> np.ndarray:
        before = gym_env.ended_batch(self.environment, self.key, robots=ROBOTS)
        begun, self.key = gym_env.step_batch(self.environment, self.key, before, jnp.zeros((ROBOTS, 2)))
        self.states = begun.state
        return _standardise(begun.observation)

    def step_async(self, actions: np.ndarray) -> None:
        middle, half = _velocity_range()
        self.velocities = jnp.asarray(middle + half * actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        found, self.key = gym_env.step_batch(self.environment, self.key, self.states, self.velocities)
        self.states, seen = found.state, _standardise(found.observation)
        truncated, infos = np.asarray(found.truncated), [{} for _ in range(ROBOTS)]
        done = np.asarray(found.terminated) | truncated
        if done.any():
            begun, self.key = gym_env.step_batch(self.environment, self.key, self.states, self.velocities)
            self.states = _choose(jnp.asarray(done), begun.state, self.states)
            for robot in np.flatnonzero(done):
                infos[robot] = {"terminal_observation": seen[robot], "TimeLimit.truncated": bool(truncated[robot])}
            seen = np.where(done[:, None], _standardise(begun.observation), seen)
        return seen, np.asarray(found.reward), done, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: object = None) -> list[None]:
        return [None] * ROBOTS

    def set_attr(self, attr_name: str, value: object, indices: object = None) -> None: ...

    def env_method(self, method_name: str, *args: object, indices: object = None, **kwargs: object) -> list[None]:
        return [None] * ROBOTS

    def env_is_wrapped(self, wrapper_class: object, indices: object = None) -> list[bool]:
        return [False] * ROBOTS


class _Curve(BaseCallback):  # pyright: ignore[reportGeneralTypeIssues]
    """Keeps the mean reward and the number of ends of each of PPO's rollouts."""

    def __init__(self) -> None:
        super().__init__()
        self.rows, self.began = [], time.monotonic()
        self.ends = 0

    def _on_step(self) -> bool:
        self.ends += int(np.sum(self.locals["dones"]))
        return True

    def _on_rollout_end(self) -> None:
        reward = float(self.model.rollout_buffer.rewards.mean()) * 60 * FRAME_RATE
        self.rows.append({"frames": self.num_timesteps, "reward": reward, "ends": self.ends})
        _tell(self.num_timesteps, reward, self.ends, self.began)
        self.ends = 0


@jax.jit
def _choose(condition: jax.Array, chosen: functional.State, otherwise: functional.State) -> functional.State:
    """Choose between the states of two batches, robot by robot."""
    return jax.vmap(lambda one, a, b: jax.tree.map(lambda x, y: jnp.where(one, x, y), a, b))(
        condition, chosen, otherwise
    )


def _standardise(u: jax.Array | np.ndarray) -> np.ndarray:
    return np.asarray((u - U_MEAN) / U_SCALE, np.float32)


def _velocity_range() -> tuple[float, float]:
    """Return middle and half of the gait's range of velocities."""
    low, high = float(policies.GAIT_RANGE.min_velocity), float(policies.GAIT_RANGE.max_velocity)
    return (high + low) / 2, (high - low) / 2


def _write(folder: Path, actor: navigator.Params, facts: JsonObject, curve: list[JsonObject]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    navigator.save(folder / FILE, actor, {"trained": "without a teacher"})
    write_json(folder / "curve.json", {**facts, "curve": curve})
    print(f"{folder}: {curve[-1]['frames']} frames in {facts['seconds']:.0f} s")


def _tell(frames: int, reward: float, ends: float, began: float) -> None:
    print(
        f"{frames:8d} frames  {reward:8.2f} a minute  {ends:3.0f} ends  {time.monotonic() - began:6.0f} s", flush=True
    )


if __name__ == "__main__":
    commands = {"shac": shac, "ppo": ppo, "score": score}
    sys.exit(exit_code(lambda: tyro.extras.subcommand_cli_from_dict(commands)))
