"""The robot as capsules, for pictures: in any pose, and with any body (`lgmdjax.body.custom_robot`)."""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from lgmdjax.body import robot_xml
from lgmdjax.body.robot_xml import Body


class BodyGeometry(NamedTuple):
    """The robot's visible capsules and its eyes in n poses."""

    starts: Float[ndarray, "n capsules 3"]  # m, world
    ends: Float[ndarray, "n capsules 3"]  # m, world
    eye_positions: Float[ndarray, "n 2 3"]  # m, world
    eye_rotations: Float[ndarray, "n 2 3 3"]
    radii: Float[ndarray, " capsules"]  # m
    colours: Float[ndarray, "capsules 3"]  # 0..1


def body_geometry(qpos: Float[ndarray, "n 25"], body: Body | None = None) -> BodyGeometry:
    """Compute the robot's visible capsules and its eyes in n poses with C MuJoCo's kinematics.

    Other shapes than spheres and capsules are drawn as capsules along their longest axis.
    """
    model = robot_xml.compiled(body)
    data = mujoco.MjData(model)
    visible = np.flatnonzero(model.geom_group == 2)
    sites = [model.site(name).id for name in robot_xml.EYES]
    axes, half_length, radii = _capsules(model, visible)
    rows = []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        rotations = data.geom_xmat[visible].reshape(-1, 3, 3)
        half_axis = np.take_along_axis(rotations, axes[:, None, None], axis=2)[..., 0] * half_length[:, None]
        centres, rotations = data.geom_xpos[visible], data.site_xmat[sites].reshape(2, 3, 3)
        rows.append((centres - half_axis, centres + half_axis, data.site_xpos[sites].copy(), rotations.copy()))
    material = model.geom_matid[visible, None]
    colours = np.where(material < 0, model.geom_rgba[visible, :3], model.mat_rgba[material[:, 0], :3])
    starts, ends, eye_positions, eye_rotations = map(np.stack, zip(*rows, strict=True))
    return BodyGeometry(starts, ends, eye_positions, eye_rotations, radii, colours)


def _capsules(
    model: mujoco.MjModel, geoms: Int[ndarray, " n"]
) -> tuple[Int[ndarray, " n"], Float[ndarray, " n"], Float[ndarray, " n"]]:
    """Return the axis along which each geom lies, and half the length and the radius of a capsule for it [m]."""
    kinds, sizes = model.geom_type[geoms], model.geom_size[geoms]
    axes, half_length, radii = np.full(len(geoms), 2), sizes[:, 1].copy(), sizes[:, 0].copy()
    half_length[kinds == mujoco.mjtGeom.mjGEOM_SPHERE] = 0.0
    for index in np.flatnonzero(~np.isin(kinds, (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE))):
        is_round = kinds[index] == mujoco.mjtGeom.mjGEOM_CYLINDER
        half = sizes[index, [0, 0, 1]] if is_round else sizes[index]
        axes[index] = np.argmax(half)
        radii[index] = np.delete(half, axes[index]).mean()
        half_length[index] = max(half.max() - radii[index], 0.0)
    return axes, half_length, radii


def size_ratio(body: Body | None = None) -> float:
    """Return how much larger a body stands than the package's, in height or in width, whichever is more; at least 1."""
    own, package = (_extent(robot_xml.compiled(one)) for one in (body, None))
    return float(max(1.0, np.max(own / package)))


def _extent(model: mujoco.MjModel) -> Float[ndarray, "2"]:
    """Return how far the feet are from the trunk's centre in the stance [m]: beside it, and below it."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("stance").qpos
    mujoco.mj_kinematics(model, data)
    feet = np.stack([data.geom(f"{leg}_foot").xpos for leg in robot_xml.LEGS]) - data.qpos[:3]
    return np.array([np.linalg.norm(feet[:, :2], axis=1).max(), -feet[:, 2].min()])
