"""A window of walking on the empty floor as a function of the legs: what speed, turn, sway and effort came to.

Everything from rhythm and shaping networks to the body's contacts is differentiated through. Speed and turn are means
weighted like a Hann window: a gait is fast and slow in turn, and an even mean would hang on where in its cycle the
window begins, whatever the cycle's length.

| symbol | name   | unit  | meaning                                                    |
| ------ | ------ | ----- | ---------------------------------------------------------- |
| s      | speed  | m/s   | along the mean heading, weighted                           |
| w      | turn   | rad/s | of the heading, weighted                                   |
| a      | sway   | rad   | root of the summed variances of the trunk's pitch and roll |
| e      | effort | N m   | root mean square of the servos' torque                     |

Gradient: that of `lgmdjax.body.implicit_step`, through every contact of the window; none through what went before it.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from mujoco import mjx

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.locomotion import cpg, shaping


@struct.dataclass(kw_only=True)
class Legs:
    """What is fitted: the right legs' networks are the left ones mirrored."""

    networks: shaping.Params
    cycle_time: Float[Array, ""]  # s
    within: Float[Array, ""]  # coupling of the legs of a tripod
    across: Float[Array, ""]  # and of the two tripods


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


def before(networks: shaping.Params) -> Legs:
    """Start from networks and the default rhythm."""
    rhythm = jax.tree.map(lambda x: jnp.asarray(x, float), cpg.Params())
    within, across = rhythm.coupling[0, 2], rhythm.coupling[0, 1]
    return Legs(networks=networks, cycle_time=rhythm.cycle_time, within=within, across=across)


def parts(legs: Legs) -> tuple[cpg.Params, shaping.Params]:
    """Put rhythm and networks together: a mirrored robot walks mirrored."""
    rhythm = jax.tree.map(lambda x: jnp.asarray(x, float), cpg.Params())
    rhythm = replace(rhythm, cycle_time=legs.cycle_time, coupling=cpg.coupling(legs.within, legs.across))
    return rhythm, shaping.symmetric(legs.networks)


def start(legs: Legs, model: mjx.Model, phase: Float[Array, ""] | float) -> Walker:
    """Stand a robot on the floor, its rhythm settled and ahead by a share of its cycle."""
    rhythm, steps = parts(legs)[0], 48
    ahead = phase * legs.cycle_time / steps
    state, _ = jax.lax.scan(lambda s, _: (cpg.step(rhythm, s, ahead)[0], None), cpg.settled(rhythm), length=steps)
    return Walker(data=hexapod.reset(model, jnp.zeros(3)), rhythm=state)


def walk(
    legs: Legs, model: mjx.Model, walker: Walker, velocity: Float[Array, "2"], steps: int
) -> tuple[Course, Walker]:
    """Walk one robot for a window of physics steps at a velocity (left, right), and measure it."""
    rhythm, networks = parts(legs)

    @partial(jax.checkpoint, prevent_cse=False)  # walked again on the way back: its inside need not be kept
    def step(walker: Walker, _: None):
        state, signal = cpg.step(rhythm, walker.rhythm, gait_test.STEP)
        data = hexapod.substep(model, walker.data, shaping.shape(networks, signal, velocity))
        pose = hexapod.pose(data)
        tilt = hexapod.rotation(pose)[2, :2]  # of pitch and roll, both small
        return Walker(data=data, rhythm=state), (pose.position[:2], hexapod.yaw(pose), tilt, data.actuator_force)

    end, (way, yaw, tilt, force) = jax.lax.scan(step, walker, length=steps)
    pose = hexapod.pose(walker.data)
    way = jnp.concatenate([pose.position[None, :2], way])
    return measured(way, jnp.append(hexapod.yaw(pose), yaw), tilt, force), end


def measured(
    way: Float[Array, "poses 2"], yaw: Float[Array, " poses"], tilt: Float[Array, "steps 2"], force: Array
) -> Course:
    """Measure a window: positions [m] and headings [rad] from its begin to its end, tilt [rad] and torques [N m]."""
    weight = np.hanning(len(yaw) + 1)[1:-1]
    weight = jnp.asarray(weight / weight.sum() / gait_test.STEP, way.dtype)
    forward = jnp.stack([jnp.mean(jnp.cos(yaw)), jnp.mean(jnp.sin(yaw))])
    turned = jnp.diff(yaw)
    return Course(
        speed=weight @ jnp.diff(way, axis=0) @ forward / jnp.linalg.norm(forward),
        turn=weight @ jnp.arctan2(jnp.sin(turned), jnp.cos(turned)),
        sway=jnp.sqrt(jnp.sum(jnp.var(tilt, axis=0)) + 1e-12),
        effort=jnp.sqrt(jnp.mean(force**2)),
    )
