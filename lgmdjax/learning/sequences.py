"""Batches of training sequences from recorded walks, and splits of walks into training and held-out parts."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Shaped

from lgmdjax.errors import InputError
from lgmdjax.simulation.episodes import Walk


@struct.dataclass(kw_only=True)
class SequenceBatch:
    """Training data as parallel streams of frames, cut into windows; one window has no leading axis."""

    u: Float[Array, "*windows frames streams 2"]
    label: Float[Array, "*windows frames streams 2"]
    previous_velocity: Float[Array, "*windows frames streams 2"]  # command of the previous frame
    is_first: Bool[Array, "*windows frames streams"]  # the recurrent state is reset before this frame
    mask: Float[Array, "*windows frames streams"]  # 1, or 0 in padding


def split_halves(walks: Sequence[Walk]) -> tuple[list[Walk], list[Walk]]:
    """Split every segment in its middle, as the paper does: first halves for training, second halves for testing."""
    return [w[: len(w) // 2] for w in walks], [w[len(w) // 2 :] for w in walks]


def split_by_room(walks: Sequence[Walk], held_out: float, seed: int) -> tuple[list[Walk], list[Walk]]:
    """Split walks by room; return those in the other rooms, and those in a random fraction `held_out` of all rooms."""
    rooms = sorted({walk.room for walk in walks})
    if not 0 < held_out < 1 or len(rooms) < 2:
        raise InputError(
            f"training: expected a fraction in 0..1 of two rooms or more, got {held_out} of {len(rooms)}; "
            "collect more rooms"
        )
    count = min(max(1, round(held_out * len(rooms))), len(rooms) - 1)
    chosen = set(np.random.default_rng(seed).permutation(rooms)[:count].tolist())
    return [w for w in walks if w.room not in chosen], [w for w in walks if w.room in chosen]


def pack(
    walks: Sequence[Walk], initial_velocity: Float[np.ndarray, "2"], *, streams: int, window: int, mirrored: bool
) -> SequenceBatch:
    """Concatenate walks and cut them into parallel streams of equal windows.

    Args:
        walks: segments of walks.
        initial_velocity: previous velocity at the first frame of each segment.
        streams: number of parallel streams.
        window: frames in a window; the actual number differs a little, to keep the padding short.
        mirrored: append each stream's mirror image (left and right exchanged).
    """
    u, label = (np.concatenate([getattr(walk, name) for walk in walks]) for name in ("u", "label"))
    previous = np.concatenate([np.concatenate([initial_velocity[None], walk.velocity[:-1]]) for walk in walks])
    is_first = np.concatenate([np.arange(len(walk)) == 0 for walk in walks])

    def windows(values: np.ndarray) -> np.ndarray:
        values = to_streams(values, streams=streams, window=window)
        if not mirrored:
            return values
        swapped = values[..., ::-1] if values.ndim == 4 else values
        return np.concatenate([values, swapped], axis=2)

    mask, is_first = np.ones(len(is_first)), windows(is_first)
    is_first[0, 0] = True
    u, label, previous, mask = (jnp.asarray(windows(x), dtype=float) for x in (u, label, previous, mask))
    return SequenceBatch(u=u, label=label, previous_velocity=previous, is_first=jnp.asarray(is_first), mask=mask)


def to_streams(values: Shaped[np.ndarray, "frames *shape"], *, streams: int, window: int) -> np.ndarray:
    """Cut a series into windows of parallel streams, axes (window, frame, stream, ...), padded with zeros at its end.

    >>> to_streams(np.arange(1, 8), streams=2, window=2).tolist()
    [[[1, 5], [2, 6]], [[3, 7], [4, 0]]]
    """
    frames = len(values)
    windows = max(1, round(frames / (streams * window)))
    length = -(-frames // (streams * windows))
    padding = streams * windows * length - frames
    values = np.pad(values, ((0, padding), *((0, 0),) * (values.ndim - 1)))
    return np.moveaxis(values.reshape(streams, windows, length, *values.shape[1:]), 0, 2)
