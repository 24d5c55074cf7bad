"""The regular tripod gait in foot space, and the servo targets that make a robot walk it.

Three legs stand while three swing. A standing foot goes backward at constant speed, so that the trunk goes
forward smoothly; a swinging foot returns in an arc and meets the floor at the floor's own speed. A side's
stride is proportional to its velocity. `targets` turns that into servo targets, ahead of the servos' lag and
beyond their sag under the trunk's weight; `lgmdjax.locomotion.gait_fit` teaches the shaping networks that.

| symbol | name       | unit             | meaning                                   |
| ------ | ---------- | ---------------- | ----------------------------------------- |
| v      | velocity   | nominal velocity | of a leg's side, in [-1, 2]               |
| p      | phase      | cycles           | 0 at touch-down, `duty` at lift-off       |
| q      | -          | 1                | progress of the swing, 0 to 1             |
| -      | feet       | m                | centres of the feet in the trunk's frame  |

Source: Cizek & Faigl, sec. 3.2 and fig. 5c; the "regular gait" of Mrva & Faigl 2015, for which the paper
gives no formula. The legs' kinematics are in `lgmdjax.locomotion.kinematics` and can be had from here.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.locomotion import cpg
from lgmdjax.locomotion.kinematics import Geometry as Geometry
from lgmdjax.locomotion.kinematics import Scalar
from lgmdjax.locomotion.kinematics import forward as forward
from lgmdjax.locomotion.kinematics import geometry as geometry
from lgmdjax.locomotion.kinematics import inverse as inverse


@struct.dataclass(kw_only=True)
class Gait:
    """The gait's figures, chosen for little sway of the trunk, which carries the eyes, and a quick turn.

    The feet stand closer in than the Mark II's (0.14 m from the coxa). There a sideways push on a foot hardly
    raises or lowers it, and front and rear feet drag less when the robot turns: on the spot at 0.19 rad/s
    instead of 0.14, with 0.02 degrees RMS of pitch instead of 0.16. The feet's centres are then 0.40 m apart at
    the widest; the paper's robot is 0.40 m wide.
    """

    nominal_velocity: Scalar = 0.05  # m/s at v = 1
    cycle_time: Scalar = cpg.CYCLE_TIME  # s; that of the rhythm
    duty: Scalar = 0.55  # share of the cycle that a foot stands; the tripods overlap by what is over 0.5
    lift: Scalar = 0.02  # m
    height: Scalar = 0.10  # m, trunk's centre above the feet's centres
    front: tuple[float, float] = struct.field(pytree_node=False, default=(0.155, 0.145))  # m, left front foot's home
    middle: float = struct.field(pytree_node=False, default=0.20)  # m, left middle foot's home, to the side
    stride_gain: Scalar = 1.02  # makes up for what the feet slip


def homes(gait: Gait) -> Float[Array, "6 3"]:
    """Place the feet's mid-stance points [m, trunk's frame], in leg order."""
    floor = jnp.asarray(_floor(gait), dtype=float)
    return jnp.concatenate([floor, -gait.height * jnp.ones((6, 1))], axis=1)


def foot_path(gait: Gait, phase: Float[Array, "*batch"], velocity: Float[Array, "*batch"]) -> Float[Array, "*batch 3"]:
    """Trace a foot relative to its home [m]: backward in stance, and in an arc back again.

    The swing is a cubic that leaves and meets the floor with the stance's velocity, and its height a bump
    that begins and ends flat. At v = 0 the foot steps on the spot.
    """
    p, d = jnp.mod(phase, 1.0), gait.duty
    speed = gait.nominal_velocity * gait.stride_gain * velocity
    stride = speed * gait.cycle_time * d
    stance = stride * (0.5 - p / d)
    q = jnp.clip((p - d) / (1 - d), 0.0, 1.0)
    reach = stride * (q**2 * (3 - 2 * q) - 0.5)
    ends = speed * gait.cycle_time * (1 - d) * (q - q**2) * (2 * q - 1)  # backward speed at both ends
    x = jnp.where(p < d, stance, reach + ends)
    return jnp.stack([x, jnp.zeros_like(x), gait.lift * (4 * q * (1 - q)) ** 2], axis=-1)


def load_share(gait: Gait, phase: Float[Array, "*batch 6"], x: Float[Array, "*batch 6"]) -> Float[Array, "*batch 6"]:
    """Share the weight among standing legs: by statics within a tripod, handed over smoothly between the two.

    Args:
        phase: of each leg.
        x: each foot's way from home [m]; the other two of its tripod are taken to be as far from theirs.
    """
    floor = _floor(gait)
    shares = np.zeros((2, 6))
    for legs in (slice(0, 6, 2), slice(1, 6, 2)):
        balance = np.linalg.inv(np.column_stack([np.ones(3), floor[legs]]).T)  # forces and moments add up
        shares[:, legs] = balance[:, 0], -balance[:, 1]
    p, overlap = jnp.mod(phase, 1.0), jnp.maximum(gait.duty - 0.5, 1e-3)
    bears = _smooth_step(p / overlap) * _smooth_step((gait.duty - p) / overlap)
    return bears * (jnp.asarray(shares[0], dtype=float) + jnp.asarray(shares[1], dtype=float) * x)


def targets(
    geometry: Geometry, gait: Gait, phase: Float[Array, "*batch 6"], velocity: Float[Array, "*batch 6"]
) -> Float[Array, "*batch 6 3"]:
    """Compute servo targets [rad] that make the feet follow the gait: ahead of the lag, beyond the sag.

    A position servo trails by its lag, and gives by torque / stiffness under the weight on its leg; each leg
    knows only its own phase and velocity, as its network does.
    """

    def angles_at(phase: Float[Array, "*batch 6"]) -> Float[Array, "*batch 6 3"]:
        return inverse(geometry, homes(gait) + foot_path(gait, phase, velocity))

    angles, rate = jax.jvp(angles_at, (phase,), (jnp.ones_like(phase) / gait.cycle_time,))
    load = geometry.weight * load_share(gait, phase, foot_path(gait, phase, velocity)[..., 0])
    _, femur, tibia = jnp.moveaxis(angles, -1, 0)
    shank = geometry.tibia * jnp.sin(femur + tibia)  # how far a joint is from above the foot is its lever arm
    levers = jnp.stack([jnp.zeros_like(shank), geometry.femur * jnp.cos(femur) + shank, shank], axis=-1)
    return angles + geometry.lag * rate - load[..., None] * levers / geometry.stiffness


def _floor(gait: Gait) -> Float[np.ndarray, "6 2"]:
    """Feet's homes seen from above [m]."""
    x, y = gait.front
    return np.array([(x, y), (0, gait.middle), (-x, y), (-x, -y), (0, -gait.middle), (x, -y)], float)


def _smooth_step(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    x = jnp.clip(x, 0.0, 1.0)
    return x**2 * (3 - 2 * x)
