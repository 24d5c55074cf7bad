"""Gait tests: walk at a set velocity on an empty floor, in MJX and in C MuJoCo, and measure speed, turning and sway.

| symbol | name      | unit              | meaning                                        |
| ------ | --------- | ----------------- | ---------------------------------------------- |
| v      | velocity  | nominal, 0.05 m/s | (left, right), constant during the walk        |
| -      | speed     | m/s               | forward, after the settling time               |
| -      | yaw_rate  | rad/s             | positive to the left, after the settling time  |
| -      | drift     | rad               | heading at the end                             |
| -      | sway      | rad, m            | RMS about the mean over whole gait cycles      |

The servo targets are computed once from the CPG, in open loop, and are the same for both simulators.
"""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from numpy import ndarray

from lgmdjax import geometry
from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.runtime.mjx import mjx
from lgmdjax.simulation import rollout
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS

SETTLING_TIME = 3.0  # s, left out of every mean
TIME_STEP = 1 / (FRAME_RATE * SUBSTEPS)  # s, of the physics


@struct.dataclass(kw_only=True)
class GaitTrajectory:
    """Poses of the trunk and positions of the feet over time, one row per physics step."""

    position: Float[ndarray, "steps 3"]  # m
    quaternion: Float[ndarray, "steps 4"]
    feet: Float[ndarray, "steps 6 3"]  # m, in the trunk's frame


@struct.dataclass(kw_only=True)
class GaitMetrics:
    """Speed, turning and sway of one walk."""

    speed: float  # m/s, forward
    yaw_rate: float  # rad/s, positive to the left
    drift: float  # rad, heading at the end
    pitch: float  # rad, RMS
    roll: float  # rad, RMS
    yaw: float  # rad, RMS about a straight trend
    heave: float  # m, RMS of the height


@partial(jax.jit, static_argnames="steps")
def servo_targets(
    cpg_params: cpg.Params, shaping_params: shaping.Params, velocity: Float[Array, "2"], *, steps: int
) -> Float[Array, "steps 6 3"]:
    """Compute the servo targets [rad] of a walk at one velocity, one row per physics step."""

    def step(state: cpg.State, _: None) -> tuple[cpg.State, Array]:
        state, outputs = cpg.step(cpg_params, state, TIME_STEP)
        return state, shaping.apply(shaping_params, outputs, velocity)

    return jax.lax.scan(step, cpg.limit_cycle_state(cpg_params), length=steps)[1]


@jax.jit
def _simulate(
    model: mjx.Model, targets: Float[Array, "walks steps 6 3"]
) -> tuple[hexapod.Pose, Float[Array, "walks steps 6 3"]]:
    def step(_: None, data: mjx.Data, angles: Array) -> tuple[mjx.Data, tuple[hexapod.Pose, Array]]:
        data = hexapod.substep(model, data, angles)
        return data, (hexapod.pose(data), hexapod.foot_positions(model, data))

    starts = jax.vmap(lambda _: hexapod.init(model, jnp.zeros(3)))(targets)
    return rollout.scan_batch(step, None, starts, targets)[1]


def simulate_mjx(model: mjx.Model, targets: Float[Array, "walks steps 6 3"]) -> list[GaitTrajectory]:
    """Simulate a batch of walks with given servo targets on an empty floor in MJX."""
    poses, feet = _simulate(model, targets)
    return [
        _to_trajectory(*(np.asarray(leaf[i], float) for leaf in (poses.position, poses.quaternion, feet)))
        for i in range(len(targets))
    ]


def simulate_mujoco(model: mujoco.MjModel, targets: Float[Array, "steps 6 3"]) -> GaitTrajectory:
    """Simulate one walk with given servo targets on an empty floor in C MuJoCo."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stance").id)
    feet = [model.geom(f"{leg}_foot").id for leg in hexapod.LEGS]
    rows = []
    for angles in np.asarray(targets, float).reshape(len(targets), 18):
        data.ctrl[:] = angles
        mujoco.mj_step(model, data)
        rows.append((data.qpos[:3].copy(), data.qpos[3:7].copy(), data.geom_xpos[feet].copy()))
    return _to_trajectory(*(np.stack(column) for column in zip(*rows, strict=True)))


def require_duration(seconds: float, cycle_time: float) -> None:
    """Raise `InputError` for walks that are shorter than the settling time and one gait cycle [s]."""
    least = SETTLING_TIME + cycle_time + TIME_STEP
    if seconds < least - 1e-9:
        raise InputError(f"expected walks of {least:.2f} s or more to measure a gait, got {seconds:g} s; walk longer")


def measure_gait(trajectory: GaitTrajectory, cycle_time: float) -> GaitMetrics:
    """Measure speed, turning and sway over whole gait cycles [s] after the settling time.

    Raises InputError if the walk has no whole cycle after it.
    """
    require_duration(len(trajectory.position) * TIME_STEP, cycle_time)
    first, cycle = round(SETTLING_TIME / TIME_STEP), cycle_time / TIME_STEP
    last = first + round(int((len(trajectory.position) - 1 - first) / cycle) * cycle)
    roll, pitch, yaw = (np.unwrap(angle)[first : last + 1] for angle in _euler_angles(trajectory.quaternion))
    duration = (last - first) * TIME_STEP
    start, end = trajectory.position[first, :2], trajectory.position[last, :2]
    forward = np.array([np.cos(yaw).mean(), np.sin(yaw).mean()])
    trend = np.linspace(yaw[0], yaw[-1], len(yaw))
    return GaitMetrics(
        speed=float((end - start) @ forward / max(np.linalg.norm(forward), 1e-9) / duration),
        yaw_rate=float((yaw[-1] - yaw[0]) / duration),
        drift=float(np.unwrap(geometry.yaw(trajectory.quaternion))[-1]),
        pitch=float(np.std(pitch)),
        roll=float(np.std(roll)),
        yaw=float(np.std(yaw - trend)),
        heave=float(np.std(trajectory.position[first:last, 2])),
    )


def _euler_angles(quaternion: Float[ndarray, "steps 4"]) -> tuple[ndarray, ndarray, ndarray]:
    """Return roll, pitch (nose down positive) and yaw [rad] of quaternions w x y z."""
    w, x, y, z = quaternion.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    return roll, np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)), geometry.yaw(quaternion)


def _to_trajectory(position: ndarray, quaternion: ndarray, feet: ndarray) -> GaitTrajectory:
    """Return the trajectory with the feet rotated from world coordinates into the trunk's frame."""
    rotation = geometry.rotation_matrix(quaternion.T)
    local = np.einsum("jis,slj->sli", rotation, feet - position[:, None])
    return GaitTrajectory(position=position, quaternion=quaternion, feet=local)
