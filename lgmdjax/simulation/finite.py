"""Non-finite numbers in records: a frame with such a number is flagged as not ok, or refused if flagged as ok.

A rollout continues when a robot's state, its room or a texture is not finite, since compiled code cannot raise. On the
host every field of every frame is checked. In a frame that is not ok, numbers that are not finite become zero, so that
no sum over many frames becomes nan.
"""

from dataclasses import fields, replace

import numpy as np
from jaxtyping import Bool

from lgmdjax.errors import InputError
from lgmdjax.simulation.closed_loop import Record

FLOATS = tuple(field.name for field in fields(Record) if field.name not in ("contact", "is_first", "resets", "ok"))


def find_finite(record: Record) -> Bool[np.ndarray, "*axes"]:
    """Flag the frames in which every number of a record is finite."""
    axes = np.ndim(record.time)
    finite = np.ones(np.shape(record.time), bool)
    for name in FLOATS:
        values = np.asarray(getattr(record, name))
        finite &= np.isfinite(values).all(axis=tuple(range(axes, values.ndim)))
    return finite


def flag_nonfinite(record: Record) -> Record:
    """Return a record on the host in which frames that are not finite are not `ok`, and have zeros for nan."""
    finite = find_finite(record)
    if finite.all():
        return record
    numbers = {name: np.nan_to_num(getattr(record, name), nan=0.0, posinf=0.0, neginf=0.0) for name in FLOATS}
    return replace(record, ok=np.asarray(record.ok) & finite, **numbers)


def require_finite(record: Record, source: str) -> Record:
    """Return a record in which every number is finite; raise `InputError` for an `ok` frame that is not.

    The message names the field, the robot and the frame.

    Args:
        record: on the host, axes (robot, frame) or (frame).
        source: of the record, for the message.
    """
    wrong = np.argwhere(np.asarray(record.ok) & ~find_finite(record))
    if not len(wrong):
        return flag_nonfinite(record)
    at = tuple(wrong[0])
    name = next(name for name in FLOATS if not np.isfinite(np.asarray(getattr(record, name))[at]).all())
    value = np.asarray(getattr(record, name))[at]
    where = f"frame {at[0]}" if len(at) == 1 else f"robot {at[0]}, frame {at[1]}"
    raise InputError(
        f"{source}: expected finite numbers in frames that are ok, got {name} {value.tolist()} of {where}; "
        "flag the frame with ok = False, or leave the robot out"
    )
