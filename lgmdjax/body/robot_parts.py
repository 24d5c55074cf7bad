"""All numbers of a robot that an MJCF has: masses and shapes of its links, its sensors, its servos."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from lgmdjax.body import link_shapes
from lgmdjax.body.canonical_mjcf import Measured, Servo
from lgmdjax.body.leg_frames import Frame, LegFrames, Source
from lgmdjax.body.link_shapes import Bumper, Shape
from lgmdjax.errors import one_line

AT_TRUNK = Frame(np.zeros(3), np.eye(3))


def measure(source: Source, legs: Sequence[LegFrames]) -> Measured:
    """Read masses, shapes, sensors and servos."""
    frames = [AT_TRUNK, *(frame for leg in legs for frame in leg.frames)]
    links = link_shapes.links_of_bodies(source, legs)
    bodies = [np.flatnonzero(links == link).tolist() for link in range(len(frames))]
    inertias = [link_shapes.inertia(source, own, frame) for own, frame in zip(bodies, frames, strict=True)]
    feet = {leg.foot_geom for leg in legs}
    drawn, radii = [], np.zeros((6, 2))
    for link, (own, frame) in enumerate(zip(bodies, frames, strict=True)):
        geoms = [geom for geom in link_shapes.geoms_of(source.model, own) if geom not in feet]
        shapes = [link_shapes.shape(source, geom, frame) for geom in geoms]
        drawn.append([one for one, geom in zip(shapes, geoms, strict=True) if link_shapes.is_drawn(source.model, geom)])
        leg, joint = divmod(link - 1, 3)
        if link and joint:
            radii[leg, joint - 1] = link_shapes.thickness(shapes, 0 if joint == 1 else 2, legs[leg].foot_radius)
    robot = Measured(
        name=one_line(source.description.path.stem),
        legs=legs,
        servos=[_read_servo(source, leg, joint) for leg in legs for joint in range(3)],
        inertias=inertias,
        shapes=drawn,
        radii=radii,
        bumper=_read_bumper(source, links),
        sensors=_read_sensors(source, links),
    )
    _check_eyes(source, robot)
    return robot


def _read_bumper(source: Source, links: np.ndarray) -> Bumper:
    shapes: list[Shape] = []
    for name in source.description.shape:
        geom = source.find("geom", name, "shape")
        if links[source.model.geom_bodyid[geom]] != link_shapes.TRUNK:
            raise source.description.error("shape", "geoms of the trunk", f"{name}, which is not", "leave it out")
        shapes.append(link_shapes.shape(source, geom, AT_TRUNK))
    return link_shapes.cover(shapes)


def _read_sensors(source: Source, links: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Return the positions of both eyes and the scanner [m]."""
    description, positions = source.description, []
    for key, name in (("eyes", description.eyes[0]), ("eyes", description.eyes[1]), ("scanner", description.scanner)):
        site = source.find("site", name, key)
        if links[source.model.site_bodyid[site]] != link_shapes.TRUNK:
            raise description.error(key, "a site of the trunk", f"{name}, which is not", "move it to the trunk")
        positions.append(source.to_trunk(source.data.site_xpos[site]))
    if positions[0][1] <= positions[1][1]:
        raise description.error("eyes", "the left eye first", ", ".join(description.eyes), "exchange them")
    return np.stack(positions)


def _check_eyes(source: Source, robot: Measured) -> None:
    """Raise `InputError` for eyes that are outside of the trunk's shape: they would pass through walls."""
    for name, (x, y, _) in zip(source.description.eyes, robot.sensors[:2], strict=True):
        front = robot.bumper.front_at(y)
        if x > front:
            raise source.description.error(
                "shape", f"geoms that reach beyond the eye {name}, {1e3 * x:.0f} mm ahead",
                f"{1e3 * front:.0f} mm" if np.isfinite(front) else "none beside it",
                "add the geom of the head, so that the robot touches before an eye does",
            )  # fmt: skip


def _read_servo(source: Source, leg: LegFrames, joint: int) -> Servo:
    """Read the position servo of a joint."""
    model, index = source.model, leg.joints[joint]
    name, error = model.joint(index).name, source.description.error
    moving = [
        number for number in range(model.nu)
        if model.actuator_trntype[number] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[number, 0] == index
    ]  # fmt: skip
    example = f'give it <position joint="{name}" kp="60" kv="0.6" forcerange="-1.5 1.5" inheritrange="1"/>'
    if len(moving) != 1:
        raise error("mjcf", f"one servo on joint {name}", f"{len(moving)}", example)
    number, dof = moving[0], model.jnt_dofadr[index]
    gain, bias = model.actuator_gainprm[number, 0], model.actuator_biasprm[number, :3]
    is_servo = gain > 0 and np.allclose(bias[:2], [0, -gain]) and model.actuator_dyntype[number] == 0
    if not is_servo or not np.allclose(model.actuator_gear[number], [1, 0, 0, 0, 0, 0]):
        raise error("mjcf", f"a position servo with gear 1 on joint {name}", "another actuator", example)
    if not model.actuator_forcelimited[number]:
        raise error("mjcf", f"a servo with a torque limit on joint {name}", "none", example)
    if model.jnt_stiffness[index]:
        raise error("mjcf", f"joint {name} without a spring", f"stiffness {model.jnt_stiffness[index]:g}", "remove it")
    ranges = [model.jnt_range[index]]
    if model.actuator_ctrllimited[number]:
        ranges.append(model.actuator_ctrlrange[number])
    sign, offset = leg.signs[joint], leg.offsets[joint]
    limits = np.sort(sign * np.stack(ranges) + offset, axis=1)
    return Servo(
        limits=limits[0],
        set_points=np.array([limits[:, 0].max(), limits[:, 1].min()]),
        torque=np.sort(sign * model.actuator_forcerange[number]),
        gain=float(gain),
        damping=float(-bias[2]),
        joint_damping=np.append(model.dof_damping[dof], model.dof_dampingpoly[dof]),
        armature=float(model.dof_armature[dof]),
        friction=float(model.dof_frictionloss[dof]),
    )
