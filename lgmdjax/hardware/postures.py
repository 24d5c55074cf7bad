"""Slow motions between sitting and standing, and the limits that hold for every motion.

A posture is the joint angles for feet on the floor and a trunk at some height above them. `sit_to_stand_postures` is a
row of `POSTURES` of them, from the trunk on the floor to the height of the gait, at which the feet are at their neutral
positions. At lower heights the feet are farther out, since the legs cannot fold enough to sit between them. The trunk
moves vertically along the row. When a robot is switched on, its legs may be anywhere: they first move to the nearest
posture, and then along the row.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Float

from lgmdjax.body import hexapod
from lgmdjax.locomotion import kinematics, tripod_gait

SITTING_HEIGHT = 0.022  # m, of the trunk's centre above the feet's centres; its shell is then on the floor
SITTING_REACH = 0.06  # m, of the feet beyond their neutral positions
POSTURES = 60
SLOW = 0.8  # rad/s, of the fastest joint in a slow motion
RAMP = 1.0  # s in which the speed of a walk grows to its limit
TOLERANCE = 0.02  # rad, largest difference from a posture that counts as reached

Angles = Float[np.ndarray, "6 3"]


@struct.dataclass(kw_only=True, frozen=True)
class Limits:
    """Limits of the joints."""

    lowest: Angles  # rad
    highest: Angles  # rad
    speed: float  # rad/s


@cache
def sit_to_stand_postures() -> Float[np.ndarray, "postures 6 3"]:
    """Return the postures from sitting to standing [rad]; the last one is the stance of the gait."""
    geometry = kinematics.read_geometry(hexapod.load())
    feet = np.asarray(tripod_gait.neutral_feet(tripod_gait.Gait()), float)
    outward = feet - np.asarray(geometry.mounts, float)
    outward[:, 2] = 0.0
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    down = np.array([0.0, 0.0, SITTING_HEIGHT + feet[0, 2]])  # from standing to sitting, of the trunk
    progress = np.linspace(1.0, 0.0, POSTURES)[:, None, None]  # 1 sitting, 0 standing
    lowered = feet + progress * (SITTING_REACH * outward - down)
    postures = np.array(kinematics.inverse(geometry, jnp.asarray(lowered)), float)
    postures[-1] = hexapod.stance()
    return postures


def toward(target: int, angles: Angles, max_change: float) -> Angles:
    """Return the next set points on the way to a posture of the row; all joints arrive at the same time.

    Args:
        target: index of the posture, 0 for sitting and -1 for standing.
        angles: present set points [rad].
        max_change: largest change of a joint [rad].
    """
    postures = sit_to_stand_postures()
    target %= POSTURES
    distances = np.abs(postures - angles).max(axis=(1, 2))
    nearest = int(np.argmin(distances))
    on_the_row = distances[nearest] <= TOLERANCE
    change = postures[nearest + int(np.sign(target - nearest)) * on_the_row] - angles
    return angles + change * min(1.0, max_change / max(np.abs(change).max(), 1e-9))


def has_reached(target: int, angles: Angles) -> bool:
    """Return whether set points are within `TOLERANCE` of a posture of the row."""
    return bool(np.abs(sit_to_stand_postures()[target] - angles).max() <= TOLERANCE)


def limit(limits: Limits, before: Angles, wanted: Angles, max_change: float) -> Angles:
    """Return set points within the limits that differ from those before by at most `max_change` [rad]."""
    within = np.clip(wanted, limits.lowest, limits.highest)
    return before + np.clip(within - before, -max_change, max_change)
