"""Leg geometry, servo compliance, and forward and inverse kinematics.

| symbol | name    | unit | meaning                                   |
| ------ | ------- | ---- | ----------------------------------------- |
| -      | angles  | rad  | coxa, femur, tibia of a leg               |
| -      | feet    | m    | centres of the feet in the trunk's frame  |

Joint zeros: leg straight out along its mount, femur horizontal, tibia vertical. A positive coxa angle turns the leg to
the left, positive femur and tibia angles lift it. The numbers are read from the robot's model. Lengths may differ from
leg to leg, stiffness and lag from joint to joint.
"""

from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

Scalar = Float[Array, ""] | float


@struct.dataclass(kw_only=True)
class LegGeometry:
    """Geometry of the legs, and compliance and lag of their servos."""

    mounts: Float[Array, "legs 3"]  # m, coxa axes in the trunk's frame
    mount_yaws: Float[Array, "legs"]  # rad
    coxa: Scalar | Float[Array, "legs"]  # m, length
    femur: Scalar | Float[Array, "legs"]  # m, length
    tibia: Scalar | Float[Array, "legs"]  # m, length to the foot's centre
    foot_radius: Scalar  # m
    weight: Scalar  # N, of the robot
    stiffness: Scalar | Float[Array, "3"]  # N m/rad, of the servos of a leg
    lag: Scalar | Float[Array, "3"]  # s, delay of a servo behind a steady motion


def read_geometry(model: mujoco.MjModel) -> LegGeometry:
    """Return the geometry of a model whose actuators are coxa, femur and tibia of each leg, in leg order."""
    joints = model.actuator_trnid[:, 0].reshape(6, 3)
    bodies = model.jnt_bodyid[joints]
    w, _, _, z = model.body_quat[bodies[:, 0]].T
    feet = [
        np.flatnonzero((model.geom_bodyid == tibia) & (model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE))[0]
        for tibia in bodies[:, 2]
    ]
    gain, damping = model.actuator_gainprm[:, 0].reshape(6, 3)[0], -model.actuator_biasprm[:, 2].reshape(6, 3)[0]
    return LegGeometry(
        mounts=jnp.asarray(model.body_pos[bodies[:, 0]], dtype=float),
        mount_yaws=jnp.asarray(2 * np.arctan2(z, w), dtype=float),
        coxa=_common(model.body_pos[bodies[:, 1], 0]),
        femur=_common(model.body_pos[bodies[:, 2], 0]),
        tibia=_common(-model.geom_pos[feet, 2]),
        foot_radius=float(model.geom_size[feet[0], 0]),
        weight=float(model.body_mass.sum() * -model.opt.gravity[2]),
        stiffness=_common(gain),
        lag=_common(damping / gain),
    )


def left_legs(geometry: LegGeometry) -> LegGeometry:
    """Return the geometry of the left legs alone."""
    names = ("mounts", "mount_yaws", "coxa", "femur", "tibia")
    values = {name: getattr(geometry, name) for name in names}
    return replace(geometry, **{name: value[:3] for name, value in values.items() if np.ndim(value)})


def _common(values: Float[np.ndarray, " n"]) -> Float[Array, " n"] | float:
    """Return the number that some values have in common; all of them as an array if they differ."""
    return float(values[0]) if np.all(values == values[0]) else jnp.asarray(values, dtype=float)


def forward(geometry: LegGeometry, angles: Float[Array, "*batch legs 3"]) -> Float[Array, "*batch legs 3"]:
    """Return the positions of the feet [m, trunk's frame] for joint angles [rad].

    >>> leg = LegGeometry(
    ...     mounts=jnp.zeros((1, 3)), mount_yaws=jnp.zeros(1), coxa=0.05, femur=0.07, tibia=0.1,
    ...     foot_radius=0.01, weight=30.0, stiffness=10.0, lag=0.02,
    ... )
    >>> print(forward(leg, jnp.zeros((1, 3))).round(3))
    [[ 0.12  0.   -0.1 ]]
    """
    coxa, femur, tibia = jnp.moveaxis(angles, -1, 0)
    reach = geometry.coxa + geometry.femur * jnp.cos(femur) + geometry.tibia * jnp.sin(femur + tibia)
    rise = geometry.femur * jnp.sin(femur) - geometry.tibia * jnp.cos(femur + tibia)
    yaw = geometry.mount_yaws + coxa
    return geometry.mounts + jnp.stack([reach * jnp.cos(yaw), reach * jnp.sin(yaw), rise], axis=-1)


def inverse(geometry: LegGeometry, feet: Float[Array, "*batch legs 3"]) -> Float[Array, "*batch legs 3"]:
    """Return the joint angles [rad], with the knee up, for positions of the feet [m, trunk's frame].

    For a foot out of reach they are the angles of the stretched or folded leg in its direction.

    Gradient: exact within reach; zero for the knee out of reach; zero for the coxa with the foot on its axis.
    """
    x, y, rise = jnp.moveaxis(feet - geometry.mounts, -1, 0)
    yaw, distance = _polar(x, y)
    coxa = jnp.mod(yaw - geometry.mount_yaws + jnp.pi, 2 * jnp.pi) - jnp.pi
    direction, span = _polar(distance - geometry.coxa, rise)
    a, b = geometry.femur, geometry.tibia
    span = jnp.maximum(span, 1e-6)
    femur = direction + _arccos((a**2 + span**2 - b**2) / (2 * a * span))
    knee = _arccos((a**2 + b**2 - span**2) / (2 * a * b))
    return jnp.stack([coxa, femur, knee - jnp.pi / 2], axis=-1)


def _polar(x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Return the angle and the length of a vector, both with gradient zero where the vector is zero."""
    zero = (x == 0) & (y == 0)
    safe = jnp.where(zero, 1.0, x)
    return jnp.where(zero, 0.0, jnp.arctan2(y, safe)), jnp.where(zero, 0.0, jnp.sqrt(safe**2 + y**2))


def _arccos(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the arc cosine of the argument clipped to -1..1, with gradient zero where it is clipped."""
    inside = jnp.abs(x) < 1
    return jnp.where(inside, jnp.arccos(jnp.where(inside, x, 0.0)), jnp.where(x > 0, 0.0, jnp.pi))
