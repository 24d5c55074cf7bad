"""Can the gait be fitted through the body? The shaping networks and the rhythm, by gradient through the physics.

The kinematic fit (`lgmdjax.lesson`) puts the feet where the regular gait has them, and knows nothing of what the body
makes of it: feet slip, servos sag, the trunk sways. Here robots walk on an empty floor, each at a velocity of its own,
and the loss of a window of theirs is

    L = sum over robots of ((s - s*) / 0.05 m/s)^2 + (w - w*)^2 / (0.2 rad/s)^2
        + 0.5 (a / a_0)^2 + 0.1 (e / e_0)^2,

of which Adam follows the gradient, through every contact of the window. Robots walk on from window to window; what went
before a window has no derivative. Beside it, an evolution strategy follows differences of the same loss, with the same
optimiser, from the same start, for as many simulated steps.

| symbol   | name   | unit    | meaning                                                                          |
| -------- | ------ | ------- | -------------------------------------------------------------------------------- |
| s, s*    | speed  | m/s     | forward over the window; asked: the mean of both sides' velocity times 0.05 m/s  |
| w, w*    | turn   | rad/s   | of the heading; asked: none when straight, what it was where sides differ        |
| a, a_0   | sway   | rad     | root of the summed variances of pitch and roll; before the fit                   |
| e, e_0   | effort | N m     | root mean square of the servos' torque; before the fit                           |

Fitted are the left legs' networks, mirrored to the right ones, the cycle time, and the coupling within and across the
tripods. All is measured again in C MuJoCo, with the contacts of the XML, before and after.

Writes stride.json (a row a method and start), and shaping-<method>-<start>.safetensors.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
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

from lgmdjax import cpg, figures, files, gait, hexapod, scales, shaping, treadmill
from lgmdjax.stages import crew

STRAIGHT = (-1.0, 0.5, 1.0, 1.5, 2.0)
COMMANDS = (*((v, v) for v in STRAIGHT), (-1.0, 1.0), (1.0, -1.0), (0.4, 1.6), (1.6, 0.4))
ROBOTS = 2  # of each command
SPEED, TURN = float(gait.Gait().nominal_velocity), 0.2  # m/s, rad/s; what an error is measured by
SWAY_COUNTS, EFFORT_COUNTS = 0.5, 0.1
BLOCK = 6  # physics steps that are walked again as one on the way back
SIGMA = 0.02  # by how much the evolution strategy tries, as a share of each weight's size


@struct.dataclass(kw_only=True)
class Legs:
    """What is fitted; the right legs' networks are the left ones mirrored."""

    networks: shaping.Params
    cycle_time: Float[Array, ""]
    within: Float[Array, ""]
    across: Float[Array, ""]


@struct.dataclass(kw_only=True)
class Walker:
    """A robot on the empty floor."""

    data: mjx.Data
    rhythm: cpg.State


@struct.dataclass(kw_only=True)
class Course:
    """What a window came to."""

    speed: Float[Array, ""]
    turn: Float[Array, ""]
    sway: Float[Array, ""]
    effort: Float[Array, ""]


def work(folder: Path, inputs: Mapping[str, Path], settings: scales.Stride, seed: int) -> None:
    """Fit by both methods from every start, and measure what came of it."""
    robot = crew.trained(inputs["fit-gait"], inputs["train"]).controller
    legs, model = before(robot.shaping), hexapod.build()
    rows = [{"method": "before", "start": 0, "curve": []} | measure(legs)]
    for method in METHODS:
        for start in range(settings.seeds):
            fitted, curve, seconds = fit(legs, model, settings, method, seed + start)
            name = folder / f"shaping-{method}-{start}.safetensors"
            shaping.save(name, parts(fitted)[1], {"cycle_time": float(fitted.cycle_time), "seed": seed + start})
            row = {"method": method, "start": start, "curve": curve, "seconds": seconds}
            numbers = {name: float(getattr(fitted, name)) for name in ("cycle_time", "within", "across")}
            rows.append(row | numbers | measure(fitted))
    files.write_json(folder / "stride.json", rows)


def before(networks: shaping.Params) -> Legs:
    """Start from the kinematic fit and the default rhythm."""
    rhythm = jax.tree.map(lambda x: jnp.asarray(x, float), cpg.Params())
    within, across = rhythm.coupling[0, 2], rhythm.coupling[0, 1]
    return Legs(networks=networks, cycle_time=rhythm.cycle_time, within=within, across=across)


def parts(legs: Legs) -> tuple[cpg.Params, shaping.Params]:
    """Put rhythm and networks together: a mirrored robot walks mirrored."""
    coxa = jnp.asarray([-1.0, 1.0, 1.0], dtype=float)
    signs = {"w1": 1.0, "b1": 1.0, "w2": coxa, "b2": coxa}
    both = {
        name: jnp.concatenate([left := getattr(legs.networks, name)[:3], left[::-1] * sign])
        for name, sign in signs.items()
    }
    rhythm = jax.tree.map(lambda x: jnp.asarray(x, float), cpg.Params())
    return replace(rhythm, cycle_time=legs.cycle_time, coupling=cpg.coupling(legs.within, legs.across)), replace(
        legs.networks, **both
    )


def walk(
    legs: Legs, model: mjx.Model, walker: Walker, velocity: Float[Array, "2"], blocks: int
) -> tuple[Course, Walker]:
    """Walk one robot for a window of `blocks`, and measure it."""
    rhythm, networks = parts(legs)

    def step(walker: Walker, _: None):
        state, signal = cpg.step(rhythm, walker.rhythm, treadmill.STEP)
        data = hexapod.substep(model, walker.data, shaping.shape(networks, signal, velocity))
        tilt = hexapod.rotation(hexapod.pose(data))[2, :2]  # of pitch and roll, both small
        return Walker(data=data, rhythm=state), (tilt, jnp.mean(data.actuator_force**2))

    @partial(jax.checkpoint, prevent_cse=False)
    def block(walker: Walker, _: None):
        return jax.lax.scan(step, walker, length=BLOCK)

    end, (tilt, force) = jax.lax.scan(block, walker, length=blocks)
    seconds = blocks * BLOCK * treadmill.STEP
    headings = jnp.stack([hexapod.yaw(hexapod.pose(one.data)) for one in (walker, end)])
    turned = jnp.arctan2(jnp.sin(headings[1] - headings[0]), jnp.cos(headings[1] - headings[0]))
    middle = headings[0] + turned / 2
    way = end.data.qpos[:2] - walker.data.qpos[:2]
    tilt = tilt.reshape(-1, 2)
    course = Course(
        speed=(way[0] * jnp.cos(middle) + way[1] * jnp.sin(middle)) / seconds,
        turn=turned / seconds,
        sway=jnp.sqrt(jnp.sum(jnp.var(tilt, axis=0)) + 1e-12),
        effort=jnp.sqrt(jnp.mean(force)),
    )
    return course, end


def cost(course: Course, velocity: Float[Array, "2"], first: Course) -> Float[Array, ""]:
    """Weigh one robot's window against what was asked, and against the kinematic fit."""
    turn = jnp.where(velocity[0] == velocity[1], 0.0, first.turn)
    return (
        ((course.speed - SPEED * jnp.mean(velocity)) / SPEED) ** 2
        + ((course.turn - turn) / TURN) ** 2
        + SWAY_COUNTS * (course.sway / first.sway) ** 2
        + EFFORT_COUNTS * (course.effort / first.effort) ** 2
    )


def fit(
    legs: Legs, model: mjx.Model, settings: scales.Stride, method: str, seed: int
) -> tuple[Legs, list[list[float]], float]:
    """Follow one method's slopes; give the legs, the curve (simulated robot-seconds, loss), and the seconds it took."""
    velocities = jnp.asarray(COMMANDS * ROBOTS, dtype=float)
    blocks = round(settings.window / (BLOCK * treadmill.STEP))
    key = jax.random.key(seed)
    walkers = _settled(legs, model, velocities, key)
    first, walkers = _crowd(legs, model, walkers, velocities, blocks)

    def loss(legs: Legs, walkers: Walker) -> tuple[Float[Array, ""], Walker]:
        courses, ends = _crowd(legs, model, walkers, velocities, blocks)
        costs = jax.vmap(cost)(courses, velocities, first)
        return jnp.mean(jnp.where(jax.vmap(hexapod.is_sound)(ends.data), costs, 0.0)), ends

    slope = METHODS[method](loss, settings.pairs)
    each = len(velocities) * settings.window * (1 if method == "gradient" else 2 * settings.pairs)
    steps = round(settings.robot_seconds / each)
    optimiser = optax.chain(
        optax.clip_by_global_norm(settings.clip),
        optax.adam(optax.cosine_decay_schedule(settings.learning_rate, steps)),
    )
    sizes = jax.tree.map(lambda leaf: jnp.sqrt(jnp.mean(leaf**2)), legs)

    @jax.jit
    def update(scaled: Legs, state: Any, walkers: Walker, key: Array):
        value, slopes, walkers = slope(lambda x: jax.tree.map(jnp.multiply, x, sizes), scaled, walkers, key)
        changes, state = optimiser.update(slopes, state)
        return jax.tree.map(jnp.add, scaled, changes), state, walkers, value

    scaled = jax.tree.map(jnp.divide, legs, sizes)
    state, curve, began = optimiser.init(scaled), [], time.monotonic()
    for number in tqdm(range(steps), desc=f"{method}, start {seed}", unit="step"):
        scaled, state, walkers, value = update(scaled, state, walkers, jax.random.fold_in(key, number))
        curve.append([each * (number + 1), float(value)])
    return jax.tree.map(jnp.multiply, scaled, sizes), curve, time.monotonic() - began


def _reverse(loss: Callable, _: int) -> Callable:
    """Take the slope by reverse mode, through the body."""

    def slope(unscaled: Callable, scaled: Any, walkers: Any, key: Array):
        (value, ends), slopes = jax.value_and_grad(lambda x: loss(unscaled(x), walkers), has_aux=True)(scaled)
        return value, slopes, ends

    return slope


def _evolution(loss: Callable, pairs: int) -> Callable:
    """Estimate the slope from the losses at random places to both sides (an evolution strategy, antithetic)."""

    def slope(unscaled: Callable, scaled: Any, walkers: Any, key: Array):
        leaves, structure = jax.tree.flatten(scaled)

        def pair(key: Array):
            keys = jax.random.split(key, len(leaves))
            tried = [jax.random.normal(k, x.shape, x.dtype) for k, x in zip(keys, leaves, strict=True)]
            noise = jax.tree.unflatten(structure, tried)
            ends = [
                loss(unscaled(jax.tree.map(lambda x, e, s=s: x + s * e, scaled, noise)), walkers)
                for s in (SIGMA, -SIGMA)
            ]
            weight = (ends[0][0] - ends[1][0]) / (2 * SIGMA)
            return jax.tree.map(lambda e: weight * e, noise), (ends[0][0] + ends[1][0]) / 2, ends[0][1]

        slopes, values, ends = jax.vmap(pair)(jax.random.split(key, pairs))
        first = jax.tree.map(lambda leaf: leaf[0], ends)
        return jnp.mean(values), jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), slopes), first

    return slope


METHODS = {"gradient": _reverse, "evolution": _evolution}


def _crowd(
    legs: Legs, model: mjx.Model, walkers: Walker, velocities: Float[Array, "robots 2"], blocks: int
) -> tuple[Course, Walker]:
    return jax.vmap(lambda walker, velocity: walk(legs, model, walker, velocity, blocks))(walkers, velocities)


def _settled(legs: Legs, model: mjx.Model, velocities: Float[Array, "robots 2"], key: Array) -> Walker:
    """Walk until the gait is steady, each robot from a phase of its cycle that luck chooses."""
    rhythm, steps = parts(legs)[0], 48

    def start(luck: Float[Array, ""]) -> Walker:
        ahead = luck * legs.cycle_time / steps
        state, _ = jax.lax.scan(lambda s, _: (cpg.step(rhythm, s, ahead)[0], None), cpg.settled(rhythm), length=steps)
        return Walker(data=hexapod.reset(model, jnp.zeros(3)), rhythm=state)

    walkers = jax.jit(jax.vmap(start))(jax.random.uniform(key, (len(velocities),)))
    blocks = round(treadmill.SETTLING / (BLOCK * treadmill.STEP))
    return jax.jit(_crowd, static_argnums=4)(legs, model, walkers, velocities, blocks)[1]


def measure(legs: Legs, seconds: float = 12.0) -> dict[str, Any]:
    """Walk straight in C MuJoCo, contacts as in the XML: error of the speed, and sway, at every velocity."""
    rhythm, networks = parts(legs)
    steps = round(seconds / treadmill.STEP)
    rows = []
    for velocity in STRAIGHT:
        course = treadmill.targets(rhythm, networks, jnp.full(2, velocity), steps=steps)
        gauge = treadmill.gauge(treadmill.walk_c(hexapod.load(), course), float(legs.cycle_time))
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


@figures.styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the loss against simulated time, and speed error and sway of every fit; rows as in stride.json."""
    figure = Figure(figsize=(figures.WIDTH, 2.6), layout="constrained")
    loss, error, sway = figure.subplots(1, 3)
    colours = {"before": figures.INK, "gradient": figures.LEFT, "evolution": figures.QUIET}
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
