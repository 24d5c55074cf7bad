"""Can the gait be fitted through the physics? Shaping networks and CPG, by gradient through the simulated body.

The kinematic fit (`lgmdjax.locomotion.gait_fit`) moves the feet as in the regular gait, but it does not model the
body: feet slip, servos sag, the trunk sways. Here robots walk on an empty floor, each at a commanded velocity. The
loss of a window (`lgmdjax.learning.gait_objective`) is

    L = mean over robots of ((s - s*) / 5 mm/s)^2 + ((w - w*) / 0.05 rad/s)^2 + 0.5 (a / a_0)^2 + 0.1 (e / e_0)^2,

and Adam follows its gradient through every contact of the window. Each window begins where the last one ended. For
comparison, an evolution strategy estimates the gradient from differences of the same loss; it uses the same optimiser
with its own learning rate, the same initial parameters, and the same number of simulated steps.

| symbol   | name   | unit  | meaning                                                                              |
| -------- | ------ | ----- | ------------------------------------------------------------------------------------ |
| s, s*    | speed  | m/s   | forward; commanded: the mean of both sides' velocity times 0.05 m/s                  |
| w, w*    | turn   | rad/s | of the heading; target: zero for equal sides, else the value before the fit          |
| a, a_0   | sway   | rad   | of pitch and roll; a_0 before the fit                                                |
| e, e_0   | effort | N m   | of the servos; e_0 before the fit                                                    |

The fitted parameters are the networks of the left legs (the right ones are their mirror image), the cycle time, and the
coupling within and across the tripods. The gait is evaluated in C MuJoCo, with the contacts of the XML, before and
after.

Writes gait_gradient.json (a row for each method and seed), and shaping-<method>-<repeat>.safetensors.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, PyTree
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.learning import gait_objective
from lgmdjax.learning.gait_objective import GaitParams, GaitState, GaitSummary
from lgmdjax.locomotion import shaping, tripod_gait
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage, tracking
from lgmdjax.runtime.mjx import mjx
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop, sharding
from lgmdjax.studies.settings import GaitGradientSettings

STRAIGHT = (-1.0, 0.5, 1.0, 1.5, 2.0)
COMMANDS = (*((v, v) for v in STRAIGHT), (-1.0, 1.0), (1.0, -1.0), (0.4, 1.6), (1.6, 0.4))  # v left, right
ROBOTS_PER_COMMAND = 2
NOMINAL_SPEED = float(tripod_gait.Gait().nominal_velocity)  # m/s
SPEED_TOLERANCE, TURN_TOLERANCE = 0.005, 0.05  # m/s, rad/s; errors with a loss of 1
SWAY_WEIGHT, EFFORT_WEIGHT = 0.5, 0.1

P = TypeVar("P")
T = TypeVar("T")
E = TypeVar("E")
Loss = Callable[[P, T], tuple[Array, E]]  # (parameters, task of one robot) -> its loss, its final state
Gradient = Callable[[P, T, Array], tuple[Array, P, E]]  # (parameters, tasks, key) -> mean loss, gradient, final states


@struct.dataclass(kw_only=True)
class RobotTask:
    """The state and the command of one robot, and the summary of its first window with the kinematic fit."""

    state: GaitState
    velocity: Float[Array, "2"]
    first: GaitSummary


def run(folder: Path, inputs: Mapping[str, Path], settings: GaitGradientSettings, seed: int) -> None:
    """Fit the gait by both methods with every random seed, and evaluate the results."""
    robot = assembly.load_robot(inputs["fit-gait"], inputs["train"])
    params, model = gait_objective.from_shaping(robot.controller.shaping), closed_loop.build_model(robot)
    rows = [{"method": "initial", "repeat": 0, "curve": []} | measure_gait(params, body=robot.body)]
    window = round(settings.window / gait_test.TIME_STEP)
    tasks = [initial_tasks(params, model, jax.random.key(seed + repeat), window) for repeat in range(settings.seeds)]
    for method in METHODS:
        optimisation = prepare_optimisation(params, model, settings, method)
        for repeat, initial in enumerate(tasks):
            fitted, curve, seconds = fit(params, optimisation, initial, seed + repeat)
            path = folder / f"shaping-{method}-{repeat}.safetensors"
            numbers = {name: float(getattr(fitted, name)) for name in ("cycle_time", "within", "across")}
            shaping.save(path, gait_objective.unpack(fitted)[1], numbers | {"seed": seed + repeat})
            row = {"method": method, "repeat": repeat, "curve": curve, "seconds": seconds}
            rows.append(row | numbers | measure_gait(fitted, body=robot.body))
    storage.write_json(folder / "gait_gradient.json", rows)


def window_loss(summary: GaitSummary, velocity: Float[Array, "2"], first: GaitSummary) -> Float[Array, ""]:
    """Return the loss of one robot's window, given its command and its first window with the kinematic fit."""
    turn = jnp.where(velocity[0] == velocity[1], 0.0, first.yaw_rate)
    return (
        ((summary.speed - NOMINAL_SPEED * jnp.mean(velocity)) / SPEED_TOLERANCE) ** 2
        + ((summary.yaw_rate - turn) / TURN_TOLERANCE) ** 2
        + SWAY_WEIGHT * (summary.sway / first.sway) ** 2
        + EFFORT_WEIGHT * (summary.effort / first.effort) ** 2
    )


@dataclass(frozen=True, kw_only=True)
class Optimisation:
    """A method, compiled once for all random seeds."""

    label: str
    robot_seconds: float  # simulated time of one step, all robots together [s]
    steps: int
    param_scales: GaitParams  # units in which the parameters are updated
    optimiser: optax.GradientTransformation
    update: Callable[..., tuple[GaitParams, optax.OptState, RobotTask, Array]]


def prepare_optimisation(
    params: GaitParams, model: mjx.Model, settings: GaitGradientSettings, method: str
) -> Optimisation:
    """Compile the update by one of `METHODS`, with each parameter in units of its initial root mean square."""
    window, robots = round(settings.window / gait_test.TIME_STEP), ROBOTS_PER_COMMAND * len(COMMANDS)
    param_scales = jax.tree.map(lambda leaf: jnp.sqrt(jnp.mean(leaf**2)), params)

    def loss(scaled: GaitParams, task: RobotTask) -> tuple[Float[Array, ""], GaitState]:
        own = jax.tree.map(jnp.multiply, scaled, param_scales)
        summary, end = gait_objective.rollout(own, model, task.state, task.velocity, window)
        sound = hexapod.is_healthy(model, end.data)
        return jnp.where(sound, window_loss(summary, task.velocity, task.first), jnp.nan), end

    gradient = METHODS[method](loss, settings)
    by_gradient = method == "gradient"
    rate = settings.learning_rate if by_gradient else settings.evolution_learning_rate
    robot_seconds = robots * settings.window * (1 if by_gradient else 2 * settings.pairs)
    steps = round(settings.robot_seconds / robot_seconds)
    schedule = optax.cosine_decay_schedule(rate, steps)
    optimiser = optax.chain(optax.clip_by_global_norm(settings.clip), optax.adam(schedule))

    @jax.jit
    def update(scaled: GaitParams, opt_state: optax.OptState, tasks: RobotTask, initial: RobotTask, key: Array):
        value, grad, ends = gradient(scaled, tasks, key)
        changes, opt_state = optimiser.update(grad, opt_state)
        return jax.tree.map(jnp.add, scaled, changes), opt_state, continue_tasks(model, tasks, ends, initial), value

    return Optimisation(
        label=method, robot_seconds=robot_seconds, steps=steps, param_scales=param_scales, optimiser=optimiser,
        update=update,
    )  # fmt: skip


def fit(
    params: GaitParams, optimisation: Optimisation, initial: RobotTask, seed: int
) -> tuple[GaitParams, list[list[float]], float]:
    """Fit the gait with one random seed.

    Returns:
        The fitted parameters, the curve (simulated robot-seconds, loss), and the duration of the fit [s]. The duration
        of the first fit includes the compilation.
    """
    key, scaled = jax.random.key(seed), jax.tree.map(jnp.divide, params, optimisation.param_scales)
    opt_state, curve, tasks, clock = optimisation.optimiser.init(scaled), [], initial, time.monotonic()
    for number in tqdm(range(optimisation.steps), desc=f"{optimisation.label}, seed {seed}", unit="step"):
        # Through the host: arrays that are sharded over devices would make JAX compile a second program.
        scaled, opt_state = jax.device_get((scaled, opt_state))
        scaled, opt_state, tasks, value = optimisation.update(
            scaled, opt_state, tasks, initial, jax.random.fold_in(key, number)
        )
        curve.append([optimisation.robot_seconds * (number + 1), float(value)])
        tracking.log(number + 1, {f"{optimisation.label}, seed {seed}/loss": curve[-1][1]})
    return jax.tree.map(jnp.multiply, scaled, optimisation.param_scales), curve, time.monotonic() - clock


def initial_tasks(params: GaitParams, model: mjx.Model, key: Array, window: int) -> RobotTask:
    """Simulate all robots from random phases until their gait is steady, and summarise a first window."""
    velocities = jnp.asarray(COMMANDS * ROBOTS_PER_COMMAND, dtype=float)
    settling = round(gait_test.SETTLING_TIME / gait_test.TIME_STEP)

    def one(phase: Float[Array, ""], velocity: Float[Array, "2"]) -> RobotTask:
        state = gait_objective.init(params, model, phase)
        _, state = gait_objective.rollout(params, model, state, velocity, settling)
        first, state = gait_objective.rollout(params, model, state, velocity, window)
        return RobotTask(state=state, velocity=velocity, first=first)

    phases = jax.random.uniform(key, (len(velocities),))
    return jax.jit(partial(sharding.shard_robots, jax.vmap(one)))(phases, velocities)


def continue_tasks(model: mjx.Model, tasks: RobotTask, ends: GaitState, initial: RobotTask) -> RobotTask:
    """Return the tasks of the next window; robots that fell start from their initial state."""

    def one(end: GaitState, initial: GaitState) -> GaitState:
        return jax.tree.map(partial(jnp.where, hexapod.is_healthy(model, end.data)), end, initial)

    return replace(tasks, state=jax.vmap(one)(ends, initial.state))


def _reverse_mode(loss: Loss[P, T, E], _: GaitGradientSettings) -> Gradient[P, T, E]:
    """Take the gradient by reverse mode; robots that fell or have no finite gradient are left out of the mean."""

    def gradient(scaled: P, tasks: T, key: Array) -> tuple[Array, P, E]:
        value_and_grad = jax.value_and_grad(loss, has_aux=True)
        (losses, ends), grads = sharding.shard_robots(jax.vmap(partial(value_and_grad, scaled)), tasks)
        sound = jnp.isfinite(losses) & jnp.isfinite(jax.vmap(optax.tree.norm)(grads))

        def mean(leaf: Array) -> Array:
            return jnp.mean(leaf, axis=0, where=sound.reshape(-1, *[1] * (leaf.ndim - 1)))

        return mean(losses), jax.tree.map(mean, grads), ends

    return gradient


def _evolution_strategy(loss: Loss[P, T, E], settings: GaitGradientSettings) -> Gradient[P, T, E]:
    """Estimate the gradient from the losses at antithetic pairs of random perturbations."""
    pairs, sigma = settings.pairs, settings.sigma

    def gradient(scaled: P, tasks: T, key: Array) -> tuple[Array, P, E]:
        template: PyTree = scaled
        sample = partial(optax.tree.random_like, target_tree=template, sampler=jax.random.normal)
        noise: PyTree = jax.vmap(sample)(jax.random.split(key, pairs))

        def perturbed(task: T, noise: P, by: float) -> tuple[Array, E]:
            return loss(jax.tree.map(lambda x, e: x + by * e, scaled, noise), task)

        def pair(task: T, noise: P) -> tuple[Array, Array, E]:
            (up, end), (down, _) = (perturbed(task, noise, by) for by in (sigma, -sigma))
            return up, down, end

        up, down, ends = sharding.shard_robots(jax.vmap(lambda task: jax.vmap(partial(pair, task))(noise)), tasks)
        sound = jnp.isfinite(up - down)
        weights = jnp.mean((up - down) / (2 * sigma), axis=0, where=sound)
        grad = jax.tree.map(lambda leaf: jnp.tensordot(weights, leaf, axes=1) / pairs, noise)
        return jnp.mean((up + down) / 2, where=sound), grad, jax.tree.map(lambda leaf: leaf[:, 0], ends)

    return gradient


METHODS = {"gradient": _reverse_mode, "evolution": _evolution_strategy}


def measure_gait(params: GaitParams, seconds: float = 12.0, body: hexapod.Body | None = None) -> JsonObject:
    """Simulate straight walks in C MuJoCo, and return speed error and sway at every velocity."""
    cpg_params, networks = gait_objective.unpack(params)
    steps = round(seconds / gait_test.TIME_STEP)
    rows = []
    for velocity in STRAIGHT:
        targets = gait_test.servo_targets(cpg_params, networks, jnp.full(2, velocity), steps=steps)
        gait = gait_test.measure_gait(gait_test.simulate_mujoco(hexapod.load(body), targets), float(params.cycle_time))
        error = abs(gait.speed - NOMINAL_SPEED * velocity)
        rows.append((velocity, gait.speed, error, gait.pitch, gait.roll, gait.drift))
    table = np.array(rows)
    return {
        "velocities": table[:, 0].tolist(),
        "speeds": table[:, 1].tolist(),
        "speed_error": float(table[:, 2].mean()),
        "speed_errors": table[:, 2].tolist(),
        "pitch_deg": np.degrees(table[:, 3]).tolist(),
        "roll_deg": np.degrees(table[:, 4]).tolist(),
        "pitch_rms_deg": math.degrees(np.sqrt(np.mean(table[:, 3] ** 2))),
        "roll_rms_deg": math.degrees(np.sqrt(np.mean(table[:, 4] ** 2))),
        "drift_deg": np.degrees(table[:, 5]).tolist(),
    }


@style.styled
def plot(rows: Sequence[JsonObject]) -> Figure:
    """Plot the loss against simulated time, and speed error and sway of every fit; rows as in gait_gradient.json."""
    figure = Figure(figsize=(style.WIDTH, 2.6), layout="constrained")
    loss, error, sway = figure.subplots(1, 3)
    colours = {"initial": style.DARK, "gradient": style.LEFT_COLOUR, "evolution": style.GREY}
    for row in rows:
        colour = colours[row["method"]]
        if row["curve"]:
            curve = np.array(row["curve"])
            loss.plot(curve[:, 0] / 60, curve[:, 1], color=colour, linewidth=1)
        options = {"color": colour, "markersize": 3, "label": row["method"] if row["repeat"] == 0 else None}
        error.plot(row["velocities"], 1e3 * np.array(row["speed_errors"]), "o-", **options)
        sway.plot(row["velocities"], np.hypot(row["pitch_deg"], row["roll_deg"]), "o-", **options)
    loss.set(xlabel="simulated robot-minutes", ylabel="loss", yscale="log")
    error.set(xlabel="v", ylabel="error of the speed [mm/s]")
    error.legend()
    sway.set(xlabel="v", ylabel="pitch and roll [deg RMS]")
    for panel in (error, sway):
        panel.set_ylim(bottom=0)
    return figure
