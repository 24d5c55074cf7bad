"""The six legs of an MJCF: each where its name says, the right ones like the left ones, and no joint left out."""

from collections.abc import Sequence

import mujoco
import numpy as np

from lgmdjax.body import leg_frames
from lgmdjax.body.leg_frames import LegFrames, Source
from lgmdjax.body.robot_xml import LEGS

MAX_ASYMMETRY = 0.003  # m, between lengths and mounts of a left leg and its right one
SIDES = np.repeat([1.0, -1.0], 3)  # of the legs: left, right


def measure(source: Source) -> tuple[Source, list[LegFrames]]:
    """Measure the legs, with the trunk's origin in the middle of their mounts."""
    middle = np.mean([leg_frames.measure(source, leg).mount for leg in LEGS], axis=0)
    source = source._replace(origin=source.origin + source.rotation @ middle)
    legs = [leg_frames.measure(source, leg) for leg in LEGS]
    _check_all_joints(source, legs)
    _check_places(source, legs)
    for left, right in ((0, 5), (1, 4), (2, 3)):
        legs[right] = leg_frames.with_mount_yaw(legs[right], -legs[left].mount_yaw)
    return source, legs


def _check_all_joints(source: Source, legs: Sequence[LegFrames]) -> None:
    """Raise `InputError` for joints that are named twice or not at all, and for constraints, which are not kept."""
    model, description = source.model, source.description
    named = [joint for leg in legs for joint in leg.joints]
    locked = [source.find("joint", name, "locked") for name in description.locked]
    for joint in range(model.njnt):
        name, is_free = model.joint(joint).name, model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        if named.count(joint) + locked.count(joint) > 1:
            raise description.error("legs", "every joint in one place", f"{name} in two", "name each joint once")
        if joint not in (*named, *locked) and not is_free:
            raise description.error(
                "locked", f"an angle for joint {name}, which is no coxa, femur or tibia", "none",
                f'add `"{name}" = 0.0` (degrees) to the table [locked], or remove the joint from the MJCF',
            )  # fmt: skip
    for count, kind in ((model.neq, "equality constraints"), (model.ntendon, "tendons")):
        if count:
            raise description.error("mjcf", f"a robot without {kind}", f"{count}", "remove them from the MJCF")


def _check_places(source: Source, legs: Sequence[LegFrames]) -> None:
    """Raise `InputError` unless each leg is where its name says, and the right legs mirror the left ones."""
    error, mounts = source.description.error, np.stack([leg.mount for leg in legs])
    remedy = "exchange the names of the legs, or set `forward`"
    for leg, mount, side in zip(LEGS, mounts, SIDES, strict=True):
        if side * mount[1] <= 0:
            where = f"one {1e3 * abs(mount[1]):.0f} mm to its {'left' if mount[1] > 0 else 'right'}"
            raise error(f"legs.{leg}", f"a leg on the {leg.partition('_')[0]} of the trunk", where, remedy)
    if np.any(np.diff(mounts[:3, 0]) >= 0) or np.any(np.diff(mounts[3:, 0]) <= 0):
        places = ", ".join(f"{leg} {1e3 * x:.0f}" for leg, x in zip(LEGS, mounts[:, 0], strict=True))
        raise error("legs", "front legs before middle before rear ones", f"x of the mounts [mm]: {places}", remedy)
    for left, right, name in zip(legs[:3], legs[:2:-1], LEGS[:2:-1], strict=True):
        differences = [left.mount * [1, -1, 1] - right.mount, left.lengths - right.lengths]
        largest = max(np.abs(part).max() for part in differences)
        if largest > MAX_ASYMMETRY:
            raise error(
                f"legs.{name}", "a mirror image of the left leg",
                f"a length or place that differs by {1e3 * largest:.1f} mm", "make the MJCF symmetric",
            )  # fmt: skip
