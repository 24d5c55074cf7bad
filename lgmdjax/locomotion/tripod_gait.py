"""Regular tripod gait in foot space, and the servo targets that make a robot walk it.

Three legs stand while three swing. A standing foot moves backward at constant speed, so that the trunk moves forward
smoothly. A swinging foot returns in an arc and touches the floor at the speed of the floor. The stride of a side is
proportional to its velocity. `joint_targets` converts the foot paths to servo targets that compensate for the servos'
lag and for their compliance under the trunk's weight; `lgmdjax.locomotion.gait_fit` fits the shaping networks to them.

| symbol | name       | unit             | meaning                                          |
| ------ | ---------- | ---------------- | ------------------------------------------------ |
| v      | velocity   | nominal velocity | of a leg's side, in [-1, 2]                      |
| p      | phase      | cycles           | 0 at touch-down, `duty_factor` at lift-off       |
| q      | -          | 1                | progress of the swing, 0 to 1                    |
| -      | feet       | m                | centres of the feet in the trunk's frame         |

Source: Cizek & Faigl, sec. 3.2 and fig. 5c; the "regular gait" of Mrva & Faigl 2015, for which the paper gives no
formula.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.locomotion import cpg, kinematics
from lgmdjax.locomotion.kinematics import LegGeometry, Scalar

NUMERIC = "gait"
"""Name of the custom numbers of a model: body height, swing height, x and y of the left feet [m]."""


@struct.dataclass(kw_only=True)
class Gait:
    """Parameters of the gait, chosen for little sway of the trunk, which carries the cameras, and for quick turns.

    The feet are closer to the body than those of the Mark II (0.14 m from the coxa). A sideways push on a foot then
    hardly raises or lowers it, and front and rear feet slip less in a turn. The feet's centres are 0.40 m apart at the
    widest; the paper's robot is 0.40 m wide.

    |                                  | here | Mark II |
    | -------------------------------- | ---- | ------- |
    | turn on the spot [rad/s]         | 0.19 | 0.14    |
    | pitch, root mean square [deg]    | 0.02 | 0.16    |
    """

    nominal_velocity: Scalar = 0.05  # m/s at v = 1
    cycle_time: Scalar = cpg.CYCLE_TIME  # s; that of the rhythm
    duty_factor: Scalar = 0.55  # fraction of the cycle in stance; the tripods overlap by the excess over 0.5
    swing_height: Scalar = 0.02  # m
    body_height: Scalar = 0.10  # m, of the trunk's centre above the feet's centres
    left_feet: tuple[tuple[float, float], ...] = struct.field(
        pytree_node=False, default=((0.155, 0.145), (0.0, 0.20), (-0.155, 0.145))
    )  # m, neutral x, y: front, middle, rear
    stride_gain: Scalar = 1.02  # compensates for slip

    def width_ratio(self) -> float:
        """Return the width of the stance as a multiple of that of the package's robot."""
        return max(y for _, y in self.left_feet) / max(y for _, y in Gait.left_feet)


def read_gait(model: mujoco.MjModel) -> Gait:
    """Return the gait of a robot's model: its custom numbers `NUMERIC`; without them that of the package's robot."""
    if not any(model.numeric(index).name == NUMERIC for index in range(model.nnumeric)):
        return Gait()
    body_height, swing_height, *feet = model.numeric(NUMERIC).data.tolist()
    return Gait(
        body_height=body_height, swing_height=swing_height, left_feet=tuple(zip(feet[::2], feet[1::2], strict=True))
    )


def to_numbers(gait: Gait) -> list[float]:
    """Return the numbers of a gait that differ between bodies, as `read_gait` expects them in a model."""
    return [float(gait.body_height), float(gait.swing_height), *(value for foot in gait.left_feet for value in foot)]


def neutral_feet(gait: Gait) -> Float[Array, "6 3"]:
    """Return the positions of the feet in mid-stance [m, trunk's frame], in leg order.

    >>> print(neutral_feet(Gait())[:2])
    [[ 0.155  0.145 -0.1  ]
     [ 0.     0.2   -0.1  ]]
    """
    plan = jnp.asarray(_neutral_plan(gait), dtype=float)
    return jnp.concatenate([plan, -gait.body_height * jnp.ones((6, 1))], axis=1)


def foot_path(gait: Gait, phase: Float[Array, "*batch"], velocity: Float[Array, "*batch"]) -> Float[Array, "*batch 3"]:
    """Return the position of a foot relative to its neutral position [m]: backward in stance, in an arc in swing.

    The swing is a cubic that leaves and meets the floor with the velocity of the stance. Its height begins and ends
    with zero vertical velocity. At v = 0 the foot steps on the spot.

    >>> print(foot_path(Gait(), jnp.array(0.0), jnp.array(1.0)).round(4))  # at touch-down
    [0.0112 0.     0.    ]

    Args:
        gait: of the robot.
        phase: of the leg [cycles].
        velocity: of the leg's side, 1 being nominal.
    """
    p, d = jnp.mod(phase, 1.0), gait.duty_factor
    speed = gait.nominal_velocity * gait.stride_gain * velocity
    stride = speed * gait.cycle_time * d
    stance = stride * (0.5 - p / d)
    q = jnp.clip((p - d) / (1 - d), 0.0, 1.0)
    reach = stride * (q**2 * (3 - 2 * q) - 0.5)
    ends = speed * gait.cycle_time * (1 - d) * (q - q**2) * (2 * q - 1)  # backward speed at both ends
    x = jnp.where(p < d, stance, reach + ends)
    return jnp.stack([x, jnp.zeros_like(x), gait.swing_height * (4 * q * (1 - q)) ** 2], axis=-1)


def load_share(gait: Gait, phase: Float[Array, "*batch 6"], x: Float[Array, "*batch 6"]) -> Float[Array, "*batch 6"]:
    """Return the fraction of the weight on each leg: statics within a tripod, a smooth transfer between the two.

    Args:
        gait: of the robot.
        phase: of each leg [cycles].
        x: displacement of each foot from its neutral position [m]; the other two feet of its tripod are assumed to
            have the same displacement.
    """
    plan = _neutral_plan(gait)
    coefficients = np.zeros((2, 6))  # of the load in mid-stance, and of its change with x
    for tripod in (slice(0, 6, 2), slice(1, 6, 2)):
        balance = np.linalg.inv(np.column_stack([np.ones(3), plan[tripod]]).T)  # of forces and moments
        coefficients[:, tripod] = balance[:, 0], -balance[:, 1]
    p, overlap = jnp.mod(phase, 1.0), jnp.maximum(gait.duty_factor - 0.5, 1e-3)
    standing = _smooth_step(p / overlap) * _smooth_step((gait.duty_factor - p) / overlap)
    return standing * (jnp.asarray(coefficients[0], dtype=float) + jnp.asarray(coefficients[1], dtype=float) * x)


def joint_targets(
    geometry: LegGeometry, gait: Gait, phase: Float[Array, "*batch 6"], velocity: Float[Array, "*batch 6"]
) -> Float[Array, "*batch 6 3"]:
    """Return servo targets [rad] that make the feet follow the gait despite the servos' lag and compliance.

    A position servo is late by its lag, and under the weight on its leg it deviates by torque / stiffness. Each leg's
    targets depend only on its own phase and velocity, as those of its network do.

    Args:
        geometry: of the legs.
        gait: of the robot.
        phase: of each leg [cycles].
        velocity: of each leg's side, 1 being nominal.
    """

    def angles_at(phase: Float[Array, "*batch 6"]) -> Float[Array, "*batch 6 3"]:
        return kinematics.inverse(geometry, neutral_feet(gait) + foot_path(gait, phase, velocity))

    angles, rate = jax.jvp(angles_at, (phase,), (jnp.ones_like(phase) / gait.cycle_time,))
    load = geometry.weight * load_share(gait, phase, foot_path(gait, phase, velocity)[..., 0])
    _, femur, tibia = jnp.moveaxis(angles, -1, 0)
    # The lever arm of a joint is its horizontal distance from the foot.
    shank = geometry.tibia * jnp.sin(femur + tibia)
    levers = jnp.stack([jnp.zeros_like(shank), geometry.femur * jnp.cos(femur) + shank, shank], axis=-1)
    return angles + geometry.lag * rate - load[..., None] * levers / geometry.stiffness


def _neutral_plan(gait: Gait) -> Float[np.ndarray, "6 2"]:
    """Return the neutral positions of the feet in plan view [m]."""
    left = np.array(gait.left_feet, float)
    return np.concatenate([left, left[::-1] * [1.0, -1.0]])


def _smooth_step(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    x = jnp.clip(x, 0.0, 1.0)
    return x**2 * (3 - 2 * x)
