"""Reinforcement learning without a teacher: PPO and SHAC on the same number of simulated frames.

    python experiments/reinforcement_learning.py [--methods ppo shac] [--seeds 0 1 2] [--frames 150000] [--out FOLDER]

Both train the same actor (`lgmdjax.control.actor`) in the same environment (`lgmdjax.environments.commands`): the last
u of both LGMDs as observation, velocities as actions, new floor less touches as reward (`rewards.floor`).

| method | how                                                                                               |
| ------ | ------------------------------------------------------------------------------------------------- |
| ppo    | Stable-Baselines3 (`experiments/ppo.py`), from sampled actions alone                              |
| shac   | `lgmdjax.learning.short_horizon`: the derivative through 30 frames of the simulation, and a critic |

Their critics see the same privileged observation. Each trained actor then drives the robot in rooms of the trial
`unseen`, without noise, beside the teacher, the pretrained navigator, and a robot that sees nothing.

The folder holds a subfolder for each method and seed, results.json and returns.png. After an interruption the same
command continues with the method and seed that it was at, from their start; finished ones are not repeated. Several
processes may each run some methods and seeds in one folder; the last command that runs writes the results of all.

| file                       | content                                                                             |
| -------------------------- | ----------------------------------------------------------------------------------- |
| METHOD-SEED/actor.npz      | weights of the actor                                                                |
| METHOD-SEED/training.json  | settings; frames, seconds and reward of a robot-minute in the course of the training |
| METHOD-SEED/score.json     | `metrics.score`                                                                     |
| POLICY/score.json          | the same for the teacher and the others                                             |
"""

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

from lgmdjax.cli.main import exit_code
from lgmdjax.control import actor, policies
from lgmdjax.control.perceptron import Layer, Layers
from lgmdjax.control.policies import Policy
from lgmdjax.environments import commands, functional
from lgmdjax.environments.commands import Commands
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, trials
from lgmdjax.learning import short_horizon
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, rollout
from lgmdjax.simulation.closed_loop import FRAME_RATE

if HAS_PPO := find_spec("stable_baselines3") is not None:
    import ppo

Method = Literal["ppo", "shac"]
BASELINES = (policies.TEACHER, policies.LEARNED, policies.BLIND)
COLOURS = {"ppo": style.LEFT_COLOUR, "shac": style.RIGHT_COLOUR}
SMOOTHED = 15_000  # frames, over which curves are averaged
CHUNK_SECONDS = 5.0  # of the rollouts that are scored
ROLLOUT_SEED = 8119  # of the rooms in which the actors are scored; not used for any choice


@dataclass(frozen=True, kw_only=True)
class Training:
    """What both methods share."""

    frames: int
    robots: int
    discount: float  # of a command
    trace: float  # lambda, of PPO's advantages and of SHAC's values
    units: tuple[int, ...]  # of the hidden layers of actor and critic
    log_std: float  # of the actor at the start, before tanh
    window: int  # commands that SHAC differentiates through
    vision_gradient: bool  # of SHAC

    def updates(self) -> int:
        """Return the number of SHAC's windows."""
        return max(self.frames // (self.robots * self.window * actor.HOLD), 1)


class Curve:
    """The course of a training: frames, seconds and reward of a robot-minute."""

    def __init__(self, label: str) -> None:
        self.label = label
        self.rows: list[dict[str, float]] = []
        self.start = time.perf_counter()

    def add(self, frames: int, reward: float, **more: float) -> None:
        """Add a row and print it; `reward` is that of a command, mean over robots."""
        per_minute = reward * 60 * FRAME_RATE / actor.HOLD
        seconds = time.perf_counter() - self.start
        self.rows.append({"frames": frames, "seconds": seconds, "reward": per_minute, **more})
        told = "".join(f", {name} {value:.3g}" for name, value in more.items())
        print(f"{self.label}: {frames} frames, {seconds:.0f} s, {per_minute:.2f} a minute{told}", flush=True)


def train_ppo(environment: Commands, training: Training, seed: int, curve: Curve) -> Layers:
    """Train with PPO; return the layers of the actor."""
    robots = ppo.VectorEnvironment(environment, training.robots, seed)  # pyright: ignore[reportPossiblyUnboundVariable]
    robots.warm_up()
    curve.start = time.perf_counter()

    def report(steps: int) -> None:
        rewards, robots.rewards = robots.rewards, []
        curve.add(steps * actor.HOLD, float(np.mean(rewards)))

    return ppo.train(  # pyright: ignore[reportPossiblyUnboundVariable]
        robots,
        commands=training.frames // actor.HOLD,
        seed=seed,
        discount=training.discount,
        trace=training.trace,
        units=training.units,
        log_std=training.log_std,
        report=report,
    )


def train_shac(environment: Commands, training: Training, seed: int, curve: Curve) -> Layers:
    """Train with SHAC; return the layers of the actor."""
    settings = short_horizon.Settings(
        robots=training.robots,
        window=training.window,
        discount=training.discount,
        trace=training.trace,
        units=training.units,
        log_std=training.log_std,
        updates=training.updates(),
    )
    state = short_horizon.init(jax.random.key(seed), environment, settings)
    short_horizon.step(environment, state, settings)  # compiles
    curve.start = time.perf_counter()
    for update in range(settings.updates):
        state, summary = short_horizon.step(environment, state, settings)
        shown = {
            name: float(getattr(summary, name)) for name in ("median_norm", "max_norm", "nonfinite", "critic_loss")
        }
        frames = (update + 1) * training.robots * training.window * actor.HOLD
        curve.add(frames, float(summary.reward), **shown)
    return state.params.actor.layers


def train(folder: Path, method: Method, training: Training, seed: int) -> None:
    """Train an actor into a folder, unless it holds one of the same settings."""
    path, settings = folder / "training.json", json.loads(json.dumps(asdict(training)))
    if path.exists():
        found = storage.read_json(path)["settings"]
        if found != settings:
            raise InputError(f"expected {path} of the settings {settings}, got {found}; choose another --out")
        return
    # PPO has no use for a derivative, and SHAC only for one through the pictures.
    vision = training.vision_gradient and method == "shac"
    environment = commands.make(functional.make(reward="floor", vision_gradient=vision))
    curve = Curve(folder.name)
    layers = (train_ppo if method == "ppo" else train_shac)(environment, training, seed, curve)
    folder.mkdir(parents=True, exist_ok=True)
    storage.write_arrays(folder / "actor.npz", to_arrays(layers))
    storage.write_json(path, {"settings": settings, "rows": curve.rows})


def to_arrays(layers: Layers) -> dict[str, np.ndarray]:
    """Return the weights by name."""
    named = {f"{name}-{k}": value for k, layer in enumerate(layers) for name, value in vars(layer).items()}
    return {name: np.asarray(value) for name, value in named.items()}


def read_layers(path: Path) -> Layers:
    """Return the layers that `to_arrays` named."""
    arrays = {name: jnp.asarray(value, float) for name, value in storage.read_arrays(path).items()}
    return tuple(Layer(kernel=arrays[f"kernel-{k}"], bias=arrays[f"bias-{k}"]) for k in range(len(arrays) // 2))


def score(
    path: Path, robot: closed_loop.Params, policy: Policy, rooms: int, seconds: float, *, render: bool = True
) -> None:
    """Let a robot walk in held-out rooms and write its score, unless the file exists; `render` if it needs pictures."""
    if path.exists():
        return
    print(f"{path.parent.name}: {rooms} rooms, {seconds:g} s each", flush=True)
    batch = trials.sample_rooms("unseen", rooms, ROLLOUT_SEED)
    model = closed_loop.build_model(robot)
    chunks = rollout.rollout_chunks(robot, model, batch, policy, seconds, render=render, chunk_seconds=CHUNK_SECONDS)
    found = metrics.score(rollout.concatenate_time(list(chunks)))
    path.parent.mkdir(parents=True, exist_ok=True)
    storage.write_json(path, asdict(found))


def with_actor(robot: closed_loop.Params, layers: Layers) -> closed_loop.Params:
    """Return the robot with an actor as its policy (`actor.POLICY`)."""
    return replace(robot, controller=replace(robot.controller, policy=actor.Params(layers=layers)))


def summarise(out: Path) -> JsonObject:
    """Return the scores of all folders, and those of each method over its seeds, by name."""
    scores = {path.parent.name: storage.read_json(path) for path in sorted(out.glob("*/score.json"))}
    pooled = {}
    for method in COLOURS:
        own = [found for name, found in scores.items() if name.startswith(f"{method}-")]
        if own:
            pooled[method] = pool(own)
    return {"scores": scores, "methods": pooled}


def pool(scores: Sequence[Any]) -> JsonObject:
    """Return the collisions of all seeds together, and the other measures with Student's interval over seeds."""
    distance, collisions = sum(found["distance"] for found in scores), sum(found["collisions"] for found in scores)
    progress = [found["progress"] for found in scores]
    return {
        "seeds": len(scores),
        "collisions": collisions,
        "distance": distance,
        "per_100_m": asdict(metrics.poisson_rate(collisions, distance / 100)),
        "per_100_m_of_seeds": [found["per_100_m"]["value"] for found in scores],
        "coverage": asdict(metrics.student_mean([found["coverage"]["value"] for found in progress])),
        "hard_turning": asdict(metrics.student_mean([found["hard_turning"]["value"] for found in progress])),
        "longest_rotation": max(found["longest_rotation"] for found in progress),
    }


def print_table(results: JsonObject) -> None:
    """Print a line for each driver."""
    print("driver          collisions per 100 m    new cells a minute      turning hard  longest rotation")
    for name, found in {**results["scores"], **results["methods"]}.items():
        progress = found.get("progress", found)
        rate, cells = (
            metrics.Estimate(**{key: float(value) for key, value in estimate.items()})
            for estimate in (found["per_100_m"], progress["coverage"])
        )
        turning, rotation = progress["hard_turning"]["value"], progress["longest_rotation"]
        print(f"{name:14s}  {rate!s:22s}  {cells!s:22s}  {100 * turning:10.1f} %  {rotation:10.1f}")


@style.styled
def plot(out: Path) -> Figure:
    """Plot the reward of a robot-minute against simulated frames and against time, a line for each seed."""
    figure = Figure(figsize=(style.WIDTH, 2.8))
    by_frames, by_time = figure.subplots(1, 2, sharey=True)
    named: set[str] = set()
    for path in sorted(out.glob("*/training.json")):
        method, rows = path.parent.name.split("-")[0], storage.read_json(path)["rows"]
        frames, seconds, reward = (np.asarray([row[name] for row in rows]) for name in ("frames", "seconds", "reward"))
        smooth = moving_average(reward, max(round(SMOOTHED / frames[0]), 1))
        label = None if method in named else {"ppo": "PPO", "shac": "SHAC"}[method]
        named.add(method)
        by_frames.plot(frames / 1000, smooth, color=COLOURS[method], label=label)
        by_time.plot(seconds / 60, smooth, color=COLOURS[method])
    by_frames.set(xlabel="simulated frames [1000]", ylabel="reward of a robot-minute")
    by_time.set(xlabel="time on this machine [min]")
    by_frames.legend()
    return figure


def moving_average(values: np.ndarray, length: int) -> np.ndarray:
    """Return the mean of the last `length` values, of fewer at the start."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - length, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def main(
    *,
    methods: tuple[Method, ...] = ("ppo", "shac"),
    seeds: tuple[int, ...] = (0, 1, 2),
    frames: int = 150_000,
    robots: int = 32,
    discount: float = 0.99,
    trace: float = 0.95,
    units: tuple[int, ...] = (64, 64),
    log_std: float = -1.0,
    window: int = 10,
    vision_gradient: bool = False,
    rooms: int = 16,
    seconds: float = 90.0,
    out: Path = Path("runs/reinforcement_learning"),
) -> None:
    """Train with every method and seed, score all drivers, and write results.json and returns.png.

    Args:
        methods: to train with
        seeds: of weights, noise and episodes
        frames: simulated in each training
        robots: that are simulated at once
        discount: gamma, of a command of three frames
        trace: lambda of the values
        units: of the hidden layers of actor and critic
        log_std: logarithm of the actor's standard deviation at the start, before tanh
        window: commands that SHAC differentiates through
        vision_gradient: whether SHAC's derivative passes through the pictures
        rooms: held-out rooms in which drivers are scored; 0 for none
        seconds: of robot time in each of them
        out: folder with the results
    """
    if "ppo" in methods and not HAS_PPO:
        raise InputError("expected stable-baselines3 for PPO, got none; pip install 'lgmdjax[rl]', or --methods shac")
    training = Training(
        frames=frames,
        robots=robots,
        discount=discount,
        trace=trace,
        units=units,
        log_std=log_std,
        window=window,
        vision_gradient=vision_gradient,
    )
    for seed in seeds:
        for method in methods:
            train(out / f"{method}-{seed}", method, training, seed)
    if rooms:
        robot = assembly.load_robot()
        for policy in BASELINES:
            chosen = assembly.select_policy(robot, policy)
            path = out / policy.name / "score.json"
            score(path, chosen, policies.SWITCH, rooms, seconds, render=policy.uses_camera)
        for path in sorted(out.glob("*-*/actor.npz")):
            driven = with_actor(robot, read_layers(path))
            score(path.parent / "score.json", driven, actor.POLICY, rooms, seconds)
        results = summarise(out)
        storage.write_json(out / "results.json", results)
        print_table(results)
    (out / "returns.png").write_bytes(style.to_png(plot(out)))


def run(command: Callable[[], None]) -> int:
    """Run on all cores, unless `JAX_NUM_CPU_DEVICES` says otherwise; return an exit code."""
    if "JAX_NUM_CPU_DEVICES" not in os.environ:
        jax.config.update("jax_num_cpu_devices", os.cpu_count())
    return exit_code(command)


if __name__ == "__main__":
    sys.exit(run(lambda: tyro.cli(main)))
