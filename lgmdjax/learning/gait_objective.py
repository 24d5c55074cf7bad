"""Speed, turning, sway and effort of a walk on an empty floor, as a differentiable function of the gait's parameters.

The derivative passes through CPG, shaping networks and body, including its contacts. Speed and yaw rate are weighted
with a Hann window. Both vary within a gait cycle, and an unweighted mean would depend on the phase at which the window
begins, whatever the length of the cycle.

| symbol | name     | unit  | meaning                                                    |
| ------ | -------- | ----- | ---------------------------------------------------------- |
| s      | speed    | m/s   | along the mean heading, weighted                           |
| w      | yaw_rate | rad/s | weighted                                                   |
| a      | sway     | rad   | root of the summed variances of the trunk's pitch and roll |
| e      | effort   | N m   | root mean square of the servos' torque                     |

Gradient: that of `lgmdjax.body.implicit_step`, through every contact of the window; none through earlier windows.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.body import hexapod
from lgmdjax.evaluation import gait_test
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.runtime.mjx import mjx

ADVANCE_STEPS = 48  # steps of the CPG from its settled state to the initial phase


@struct.dataclass(kw_only=True)
class GaitParams:
    """The fitted parameters. The right legs' networks mirror the left legs', so only the left ones have an effect."""

    shaping: shaping.Params
    cycle_time: Float[Array, ""]  # s
    within: Float[Array, ""]  # coupling within a tripod
    across: Float[Array, ""]  # coupling between the tripods


@struct.dataclass(kw_only=True)
class GaitState:
    """Body and CPG of a robot on the empty floor."""

    data: mjx.Data
    cpg: cpg.State


@struct.dataclass(kw_only=True)
class GaitSummary:
    """Measures of one window."""

    speed: Float[Array, ""]
    yaw_rate: Float[Array, ""]
    sway: Float[Array, ""]
    effort: Float[Array, ""]


def from_shaping(networks: shaping.Params) -> GaitParams:
    """Return the gait of shaping networks with the default CPG."""
    rhythm = _default_cpg()
    within, across = rhythm.coupling[0, 2], rhythm.coupling[0, 1]
    return GaitParams(shaping=networks, cycle_time=jnp.asarray(rhythm.cycle_time), within=within, across=across)


def unpack(params: GaitParams) -> tuple[cpg.Params, shaping.Params]:
    """Return the parameters of CPG and shaping networks of a mirror-symmetric gait."""
    coupling = cpg.coupling(params.within, params.across)
    rhythm = replace(_default_cpg(), cycle_time=params.cycle_time, coupling=coupling)
    return rhythm, shaping.symmetrise(params.shaping)


def init(params: GaitParams, model: mjx.Model, phase: Float[Array, ""] | float) -> GaitState:
    """Place a robot on the floor, with its CPG on the limit cycle, at a phase in cycles."""
    rhythm = unpack(params)[0]
    interval = phase * params.cycle_time / ADVANCE_STEPS

    def advance(state: cpg.State, _: None) -> tuple[cpg.State, None]:
        return cpg.step(rhythm, state, interval)[0], None

    state, _ = jax.lax.scan(advance, cpg.limit_cycle_state(rhythm), length=ADVANCE_STEPS)
    return GaitState(data=hexapod.init(model, jnp.zeros(3)), cpg=state)


def rollout(
    params: GaitParams, model: mjx.Model, state: GaitState, velocity: Float[Array, "2"], steps: int
) -> tuple[GaitSummary, GaitState]:
    """Simulate a window of physics steps at a commanded velocity (left, right); return its measures and end state."""
    rhythm, networks = unpack(params)

    @partial(jax.checkpoint, prevent_cse=False)  # recomputed in the backward pass, to save memory
    def step(state: GaitState, _: None):
        cpg_state, signal = cpg.step(rhythm, state.cpg, gait_test.TIME_STEP)
        data = hexapod.substep(model, state.data, shaping.apply(networks, signal, velocity))
        pose = hexapod.pose(data)
        tilt = hexapod.rotation(pose)[2, :2]  # of pitch and roll, both small
        return GaitState(data=data, cpg=cpg_state), (pose.position[:2], hexapod.yaw(pose), tilt, data.actuator_force)

    end, (positions, yaw, tilt, torques) = jax.lax.scan(step, state, length=steps)
    pose = hexapod.pose(state.data)
    positions = jnp.concatenate([pose.position[None, :2], positions])
    return summarise(positions, jnp.append(hexapod.yaw(pose), yaw), tilt, torques), end


def summarise(
    positions: Float[Array, "poses 2"],
    yaw: Float[Array, " poses"],
    tilt: Float[Array, "steps 2"],
    torques: Float[Array, "steps 18"],
) -> GaitSummary:
    """Measure a window.

    Args:
        positions: of the trunk, from the beginning to the end of the window [m].
        yaw: headings at the same times [rad].
        tilt: pitch and roll after every step [rad].
        torques: of the servos in every step [N m].
    """
    weight = np.hanning(len(yaw) + 1)[1:-1]
    weight = jnp.asarray(weight / weight.sum() / gait_test.TIME_STEP, positions.dtype)
    forward = jnp.stack([jnp.mean(jnp.cos(yaw)), jnp.mean(jnp.sin(yaw))])
    turned = jnp.diff(yaw)
    return GaitSummary(
        speed=weight @ jnp.diff(positions, axis=0) @ forward / jnp.linalg.norm(forward),
        yaw_rate=weight @ jnp.arctan2(jnp.sin(turned), jnp.cos(turned)),
        sway=jnp.sqrt(jnp.sum(jnp.var(tilt, axis=0)) + 1e-12),
        effort=jnp.sqrt(jnp.mean(torques**2)),
    )


def _default_cpg() -> cpg.Params:
    return jax.tree.map(lambda x: jnp.asarray(x, float), cpg.Params())
