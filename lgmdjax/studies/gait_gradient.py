"""Can the gait be fitted through the body? The shaping networks and the rhythm, by gradient through the physics.

The kinematic fit (`lgmdjax.locomotion.gait_fit`) puts the feet where the regular gait has them, and knows nothing of
what the body makes of it: feet slip, servos sag, the trunk sways. Here robots walk on an empty floor, each at a
velocity of its own, and the loss of a window of theirs (`lgmdjax.learning.gait_objective`) is

    L = mean over robots of ((s - s*) / 5 mm/s)^2 + ((w - w*) / 0.05 rad/s)^2 + 0.5 (a / a_0)^2 + 0.1 (e / e_0)^2,

of which Adam follows the gradient, through every contact of the window. Robots walk on from window to window. Beside
it, an evolution strategy follows differences of the same loss, with the same optimiser at a rate of its own, from the
same start, for as many simulated steps.

| symbol   | name   | unit  | meaning                                                                          |
| -------- | ------ | ----- | -------------------------------------------------------------------------------- |
| s, s*    | speed  | m/s   | forward; asked: the mean of both sides' velocity times 0.05 m/s                  |
| w, w*    | turn   | rad/s | of the heading; asked: none when straight, what it was where sides differ        |
| a, a_0   | sway   | rad   | of pitch and roll; before the fit                                                |
| e, e_0   | effort | N m   | of the servos; before the fit                                                    |

Fitted are the left legs' networks, mirrored to the right ones, the cycle time, and the coupling within and across the
tripods. All is measured again in C MuJoCo, with the contacts of the XML, before and after.

Writes stride.json (a row a method and start), and shaping-<method>-<start>.safetensors.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from mujoco import mjx
from tqdm import tqdm

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.learning import gait_objective
from lgmdjax.learning.gait_objective import Course, Legs, Walker
from lgmdjax.locomotion import shaping, tripod_gait
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.simulation import assembly, sharding
from lgmdjax.studies.settings import GaitGradientSettings

STRAIGHT = (-1.0, 0.5, 1.0, 1.5, 2.0)
COMMANDS = (*((v, v) for v in STRAIGHT), (-1.0, 1.0), (1.0, -1.0), (0.4, 1.6), (1.6, 0.4))
ROBOTS = 2  # of each command
SPEED = float(tripod_gait.Gait().nominal_velocity)  # m/s
OFF_SPEED, OFF_TURN = 0.005, 0.05  # m/s, rad/s; errors that count as much as all of the sway does
SWAY_COUNTS, EFFORT_COUNTS = 0.5, 0.1


@struct.dataclass(kw_only=True)
class Task:
    """One robot's: where it is, what is asked of it, and what its first window came to, with the kinematic fit."""

    walker: Walker
    velocity: Float[Array, "2"]
    first: Course


def work(folder: Path, inputs: Mapping[str, Path], settings: GaitGradientSettings, seed: int) -> None:
    """Fit by both methods from every start, and measure what came of it."""
    robot = assembly.trained(inputs["fit-gait"], inputs["train"]).controller
    legs, model = gait_objective.before(robot.shaping), hexapod.build()
    rows = [{"method": "before", "start": 0, "curve": []} | measure(legs)]
    window = round(settings.window / gait_test.STEP)
    crowds = [tasks(legs, model, jax.random.key(seed + start), window) for start in range(settings.seeds)]
    for method in METHODS:
        follow = follower(legs, model, settings, method)
        for start, began in enumerate(crowds):
            fitted, curve, seconds = fit(legs, follow, began, seed + start)
            name = folder / f"shaping-{method}-{start}.safetensors"
            numbers = {name: float(getattr(fitted, name)) for name in ("cycle_time", "within", "across")}
            shaping.save(name, gait_objective.parts(fitted)[1], numbers | {"seed": seed + start})
            row = {"method": method, "start": start, "curve": curve, "seconds": seconds}
            rows.append(row | numbers | measure(fitted))
    storage.write_json(folder / "gait_gradient.json", rows)


def cost(course: Course, velocity: Float[Array, "2"], first: Course) -> Float[Array, ""]:
    """Weigh one robot's window against what was asked, and against the kinematic fit."""
    turn = jnp.where(velocity[0] == velocity[1], 0.0, first.turn)
    return (
        ((course.speed - SPEED * jnp.mean(velocity)) / OFF_SPEED) ** 2
        + ((course.turn - turn) / OFF_TURN) ** 2
        + SWAY_COUNTS * (course.sway / first.sway) ** 2
        + EFFORT_COUNTS * (course.effort / first.effort) ** 2
    )


@dataclass(frozen=True, kw_only=True)
class Follower:
    """A method, compiled once for all starts."""

    label: str
    robot_seconds: float  # that a step takes
    steps: int
    sizes: Legs  # in shares of which legs are changed
    optimiser: optax.GradientTransformation
    update: Callable[..., tuple[Legs, Any, Task, Float[Array, ""]]]


def follower(legs: Legs, model: mjx.Model, settings: GaitGradientSettings, method: str) -> Follower:
    """Prepare to follow one method's slopes from legs."""
    window, robots = round(settings.window / gait_test.STEP), ROBOTS * len(COMMANDS)
    sizes = jax.tree.map(lambda leaf: jnp.sqrt(jnp.mean(leaf**2)), legs)

    def loss(scaled: Legs, task: Task) -> tuple[Float[Array, ""], Walker]:
        own = jax.tree.map(jnp.multiply, scaled, sizes)
        course, end = gait_objective.walk(own, model, task.walker, task.velocity, window)
        sound = hexapod.is_sound(end.data)
        return jnp.where(sound, cost(course, task.velocity, task.first), jnp.nan), end

    slope = METHODS[method](loss, settings)
    walks, rate = (1, settings.learning_rate) if method == "gradient" else (2 * settings.pairs, settings.evolution_rate)
    each = robots * settings.window * walks
    steps = round(settings.robot_seconds / each)
    optimiser = optax.chain(
        optax.clip_by_global_norm(settings.clip), optax.adam(optax.cosine_decay_schedule(rate, steps))
    )

    @jax.jit
    def update(scaled: Legs, state: Any, here: Task, began: Task, key: Array):
        value, slopes, ends = slope(scaled, here, key)
        changes, state = optimiser.update(slopes, state)
        return jax.tree.map(jnp.add, scaled, changes), state, going_on(here, ends, began), value

    return Follower(label=method, robot_seconds=each, steps=steps, sizes=sizes, optimiser=optimiser, update=update)


def fit(legs: Legs, follow: Follower, began: Task, seed: int) -> tuple[Legs, list[list[float]], float]:
    """Follow the slopes from one start; give the legs, the curve (simulated robot-seconds, loss), and its seconds.

    The first start's seconds have the compilation in them.
    """
    key, scaled = jax.random.key(seed), jax.tree.map(jnp.divide, legs, follow.sizes)
    state, curve, here, clock = follow.optimiser.init(scaled), [], began, time.monotonic()
    for number in tqdm(range(follow.steps), desc=f"{follow.label}, start {seed}", unit="step"):
        # By way of the host: what was laid out over the devices of the crowd would be another program's.
        scaled, state = jax.device_get((scaled, state))
        scaled, state, here, value = follow.update(scaled, state, here, began, jax.random.fold_in(key, number))
        curve.append([follow.robot_seconds * (number + 1), float(value)])
    return jax.tree.map(jnp.multiply, scaled, follow.sizes), curve, time.monotonic() - clock


def tasks(legs: Legs, model: mjx.Model, key: Array, window: int) -> Task:
    """Walk all robots until their gait is steady, each from a phase that luck chooses, and measure a first window."""
    velocities = jnp.asarray(COMMANDS * ROBOTS, dtype=float)
    settling = round(gait_test.SETTLING / gait_test.STEP)

    def one(phase: Float[Array, ""], velocity: Float[Array, "2"]) -> Task:
        walker = gait_objective.start(legs, model, phase)
        _, walker = gait_objective.walk(legs, model, walker, velocity, settling)
        first, walker = gait_objective.walk(legs, model, walker, velocity, window)
        return Task(walker=walker, velocity=velocity, first=first)

    phases = jax.random.uniform(key, (len(velocities),))
    return jax.jit(partial(sharding.deal, jax.vmap(one)))(phases, velocities)


def going_on(tasks: Task, ends: Walker, began: Task) -> Task:
    """Go on from where the robots are; those that fell begin again."""

    def one(end: Walker, anew: Walker) -> Walker:
        return jax.tree.map(partial(jnp.where, hexapod.is_sound(end.data)), end, anew)

    return replace(tasks, walker=jax.vmap(one)(ends, began.walker))


def _reverse(loss: Callable, _: GaitGradientSettings) -> Callable:
    """Take the slope by reverse mode, through the body; those that fell or have no finite slope do not count."""

    def slope(scaled: Any, tasks: Any, key: Array):
        one = jax.value_and_grad(loss, has_aux=True)
        (costs, ends), each = sharding.deal(jax.vmap(partial(one, scaled)), tasks)
        sound = jnp.isfinite(costs) & jnp.isfinite(jax.vmap(optax.tree.norm)(each))

        def mean(leaf: Array) -> Array:
            return jnp.mean(leaf, axis=0, where=sound.reshape(-1, *[1] * (leaf.ndim - 1)))

        return mean(costs), jax.tree.map(mean, each), ends

    return slope


def _evolution(loss: Callable, settings: GaitGradientSettings) -> Callable:
    """Estimate the slope from the losses at random places to both sides (an evolution strategy, antithetic)."""
    pairs, sigma = settings.pairs, settings.sigma

    def slope(scaled: Any, tasks: Any, key: Array):
        draw = partial(optax.tree.random_like, target_tree=scaled, sampler=jax.random.normal)
        noise = jax.vmap(draw)(jax.random.split(key, pairs))

        def shifted(task: Any, noise: Any, by: float):
            return loss(jax.tree.map(lambda x, e: x + by * e, scaled, noise), task)

        def tried(task: Any, noise: Any):
            (up, end), (down, _) = (shifted(task, noise, by) for by in (sigma, -sigma))
            return up, down, end

        up, down, ends = sharding.deal(jax.vmap(lambda task: jax.vmap(partial(tried, task))(noise)), tasks)
        sound = jnp.isfinite(up - down)
        weights = jnp.mean((up - down) / (2 * sigma), axis=0, where=sound)
        slopes = jax.tree.map(lambda leaf: jnp.tensordot(weights, leaf, axes=1) / pairs, noise)
        return jnp.mean((up + down) / 2, where=sound), slopes, jax.tree.map(lambda leaf: leaf[:, 0], ends)

    return slope


METHODS = {"gradient": _reverse, "evolution": _evolution}


def measure(legs: Legs, seconds: float = 12.0) -> dict[str, Any]:
    """Walk straight in C MuJoCo, contacts as in the XML: error of the speed, and sway, at every velocity."""
    rhythm, networks = gait_objective.parts(legs)
    steps = round(seconds / gait_test.STEP)
    rows = []
    for velocity in STRAIGHT:
        course = gait_test.targets(rhythm, networks, jnp.full(2, velocity), steps=steps)
        gauge = gait_test.gauge(gait_test.walk_c(hexapod.load(), course), float(legs.cycle_time))
        rows.append((velocity, gauge.speed, abs(gauge.speed - SPEED * velocity), gauge.pitch, gauge.roll, gauge.drift))
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
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the loss against simulated time, and speed error and sway of every fit; rows as in stride.json."""
    figure = Figure(figsize=(style.WIDTH, 2.6), layout="constrained")
    loss, error, sway = figure.subplots(1, 3)
    colours = {"before": style.INK, "gradient": style.LEFT, "evolution": style.QUIET}
    for row in rows:
        colour = colours[row["method"]]
        if row["curve"]:
            curve = np.array(row["curve"])
            loss.plot(curve[:, 0] / 60, curve[:, 1], color=colour, linewidth=1)
        label = row["method"] if row["start"] == 0 else None
        error.plot(
            row["velocities"], 1e3 * np.array(row["speed_errors"]), "o-", color=colour, markersize=3, label=label
        )
        total = np.hypot(row["pitch_deg"], row["roll_deg"])
        sway.plot(row["velocities"], total, "o-", color=colour, markersize=3)
    loss.set(xlabel="simulated robot-minutes", ylabel="loss", yscale="log")
    error.set(xlabel="v", ylabel="error of the speed [mm/s]")
    error.legend()
    sway.set(xlabel="v", ylabel="pitch and roll [deg RMS]")
    for panel in (error, sway):
        panel.set_ylim(bottom=0)
    return figure
