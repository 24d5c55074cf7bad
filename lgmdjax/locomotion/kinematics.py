"""The legs: how long, where they are, how they give under load, and their kinematics.

| symbol | name    | unit | meaning                                   |
| ------ | ------- | ---- | ----------------------------------------- |
| -      | angles  | rad  | coxa, femur, tibia of a leg               |
| -      | feet    | m    | centres of the feet in the trunk's frame  |

Joint zeros: leg straight out along its mount, femur level, tibia plumb; positive coxa turns left, positive
femur and tibia lift. Source of the numbers: the robot's model.
"""

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

Scalar = Float[Array, ""] | float


@struct.dataclass(kw_only=True)
class Geometry:
    """What the gait must know of the body: where the legs are, how long, and how they give under load."""

    mounts: Float[Array, "legs 3"]  # m, coxa axes in the trunk's frame
    mount_yaws: Float[Array, "legs"]  # rad
    coxa: Scalar  # m
    femur: Scalar
    tibia: Scalar  # down to the foot's centre
    foot_radius: Scalar
    weight: Scalar  # N
    stiffness: Scalar  # N m/rad, of a servo
    lag: Scalar  # s, by which a servo trails a steady motion


def geometry(model: mujoco.MjModel) -> Geometry:
    """Read the legs off a model whose actuators are coxa, femur and tibia of each leg, in leg order."""
    joints = model.actuator_trnid[:, 0].reshape(6, 3)
    bodies = model.jnt_bodyid[joints]
    w, _, _, z = model.body_quat[bodies[:, 0]].T
    feet = [
        np.flatnonzero((model.geom_bodyid == tibia) & (model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE))[0]
        for tibia in bodies[:, 2]
    ]
    stiffness = float(model.actuator_gainprm[0, 0])
    return Geometry(
        mounts=jnp.asarray(model.body_pos[bodies[:, 0]], dtype=float),
        mount_yaws=jnp.asarray(2 * np.arctan2(z, w), dtype=float),
        coxa=float(model.body_pos[bodies[0, 1], 0]),
        femur=float(model.body_pos[bodies[0, 2], 0]),
        tibia=-float(model.geom_pos[feet[0], 2]),
        foot_radius=float(model.geom_size[feet[0], 0]),
        weight=float(model.body_mass.sum() * -model.opt.gravity[2]),
        stiffness=stiffness,
        lag=float(-model.actuator_biasprm[0, 2]) / stiffness,
    )


def forward(geometry: Geometry, angles: Float[Array, "*batch legs 3"]) -> Float[Array, "*batch legs 3"]:
    """Find the feet [m, trunk's frame] that joint angles [rad] lead to."""
    coxa, femur, tibia = jnp.moveaxis(angles, -1, 0)
    reach = geometry.coxa + geometry.femur * jnp.cos(femur) + geometry.tibia * jnp.sin(femur + tibia)
    rise = geometry.femur * jnp.sin(femur) - geometry.tibia * jnp.cos(femur + tibia)
    yaw = geometry.mount_yaws + coxa
    return geometry.mounts + jnp.stack([reach * jnp.cos(yaw), reach * jnp.sin(yaw), rise], axis=-1)


def inverse(geometry: Geometry, feet: Float[Array, "*batch legs 3"]) -> Float[Array, "*batch legs 3"]:
    """Find the joint angles [rad], knee up, that put the feet [m, trunk's frame] there.

    A foot out of reach gets the angles of the stretched or folded leg in its direction.

    Gradient: exact within reach; zero for the knee beyond it; zero for the coxa with the foot on its axis.
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
    """Angle and length of a vector, both with gradient zero where it vanishes."""
    zero = (x == 0) & (y == 0)
    safe = jnp.where(zero, 1.0, x)
    return jnp.where(zero, 0.0, jnp.arctan2(y, safe)), jnp.where(zero, 0.0, jnp.sqrt(safe**2 + y**2))


def _arccos(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Arc cosine of the clipped argument, with gradient zero where it is clipped."""
    inside = jnp.abs(x) < 1
    return jnp.where(inside, jnp.arccos(jnp.where(inside, x, 0.0)), jnp.where(x > 0, 0.0, jnp.pi))
