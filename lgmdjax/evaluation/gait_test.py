"""An empty floor and a set velocity: how well rhythm, shaping and body walk, in MJX and in C MuJoCo.

| symbol | name      | unit              | meaning                               |
| ------ | --------- | ----------------- | ------------------------------------- |
| v      | velocity  | nominal, 0.05 m/s | (left, right), held for the whole walk |
| -      | speed     | m/s               | forward, after the first cycles       |
| -      | yaw_rate  | rad/s             | positive to the left                  |
| -      | drift     | rad               | heading at the end                    |
| -      | sway      | rad, m            | RMS about the mean, whole cycles      |

Both simulators get the same servo targets, drawn once from the rhythm: the walk in open loop is the same question
to either.
"""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from mujoco import mjx

from lgmdjax.body import hexapod
from lgmdjax.evaluation.metrics import yaws
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.simulation import rollout
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS

SETTLING = 3.0  # s, left out of every mean
STEP = 1 / (FRAME_RATE * SUBSTEPS)


@struct.dataclass(kw_only=True)
class Course:
    """A trunk's way and its feet over time, a row a physics step."""

    position: Float[np.ndarray, "steps 3"]
    quaternion: Float[np.ndarray, "steps 4"]
    feet: Float[np.ndarray, "steps 6 3"]  # m, in the trunk's frame


@struct.dataclass(kw_only=True)
class Gauge:
    """What a walk came to."""

    speed: float
    yaw_rate: float
    drift: float
    pitch: float
    roll: float
    yaw: float
    bounce: float


@partial(jax.jit, static_argnames="steps")
def targets(
    network: cpg.Params, networks: shaping.Params, velocity: Float[Array, "2"], *, steps: int
) -> Float[Array, "steps 6 3"]:
    """Draw the servo targets [rad] of a walk at one velocity, a row a physics step."""

    def beat(state: cpg.State, _: None) -> tuple[cpg.State, Array]:
        state, rhythm = cpg.step(network, state, STEP)
        return state, shaping.shape(networks, rhythm, velocity)

    return jax.lax.scan(beat, cpg.settled(network), length=steps)[1]


@jax.jit
def _walk(model: mjx.Model, courses: Float[Array, "walks steps 6 3"]):
    def step(_: None, data: mjx.Data, angles: Array):
        data = hexapod.substep(model, data, angles)
        return data, (hexapod.pose(data), hexapod.feet(data))

    starts = jax.vmap(lambda _: hexapod.reset(model, jnp.zeros(3)))(courses)
    return rollout.march(step, None, starts, courses)[1]


def walk_mjx(model: mjx.Model, courses: Float[Array, "walks steps 6 3"]) -> list[Course]:
    """Walk a batch of target courses on an empty floor in MJX."""
    poses, feet = _walk(model, courses)
    return [
        _course(*(np.asarray(leaf[i], float) for leaf in (poses.position, poses.quaternion, feet)))
        for i in range(len(courses))
    ]


def walk_c(model: mujoco.MjModel, course: Float[Array, "steps 6 3"]) -> Course:
    """Walk one target course on an empty floor in C MuJoCo."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stance").id)
    feet = [model.geom(f"{leg}_foot").id for leg in hexapod.LEGS]
    rows = []
    for angles in np.asarray(course, float).reshape(len(course), 18):
        data.ctrl[:] = angles
        mujoco.mj_step(model, data)
        rows.append((data.qpos[:3].copy(), data.qpos[3:7].copy(), data.geom_xpos[feet].copy()))
    return _course(*(np.stack(column) for column in zip(*rows, strict=True)))


def gauge(course: Course, cycle_time: float) -> Gauge:
    """Measure speed, turning and sway of a walk, over whole gait cycles after it settled."""
    first, cycle = round(SETTLING / STEP), cycle_time / STEP
    last = first + round(int((len(course.position) - 1 - first) / cycle) * cycle)
    roll, pitch, yaw = (np.unwrap(angle)[first : last + 1] for angle in _angles(course.quaternion))
    seconds = (last - first) * STEP
    start, end = course.position[first, :2], course.position[last, :2]
    along = np.array([np.cos(yaw).mean(), np.sin(yaw).mean()])
    trend = np.linspace(yaw[0], yaw[-1], len(yaw))
    return Gauge(
        speed=float((end - start) @ along / max(np.linalg.norm(along), 1e-9) / seconds),
        yaw_rate=float((yaw[-1] - yaw[0]) / seconds),
        drift=float(np.unwrap(yaws(course.quaternion))[-1]),
        pitch=float(np.std(pitch)),
        roll=float(np.std(roll)),
        yaw=float(np.std(yaw - trend)),
        bounce=float(np.std(course.position[first:last, 2])),
    )


def _angles(quaternion: Float[np.ndarray, "steps 4"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read roll, pitch (nose down positive) and yaw [rad] off quaternions w x y z."""
    w, x, y, z = quaternion.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    return roll, np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)), yaws(quaternion)


def _course(position: np.ndarray, quaternion: np.ndarray, feet: np.ndarray) -> Course:
    """Turn the feet into the trunk's frame."""
    w, x, y, z = quaternion.T
    turned = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = np.einsum("jis,slj->sli", turned, feet - position[:, None])
    return Course(position=position, quaternion=quaternion, feet=local)
