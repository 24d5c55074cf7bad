"""Recorded walks as arrays to learn from: split by room or in halves, laid end to end, and cut into streams."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Shaped

from lgmdjax.errors import InputError
from lgmdjax.simulation.episodes import Walk


@struct.dataclass(kw_only=True)
class Tape:
    """Frames to learn from, by window (unless it is one of them), frame in the window, and stream."""

    u: Float[Array, "*windows frames streams 2"]
    label: Float[Array, "*windows frames streams 2"]
    last: Float[Array, "*windows frames streams 2"]  # velocity of the frame before
    fresh: Bool[Array, "*windows frames streams"]  # nothing is remembered from before this frame
    counts: Float[Array, "*windows frames streams"]  # 1, or 0 where the tape is padded


def halve(walks: Sequence[Walk]) -> tuple[list[Walk], list[Walk]]:
    """Split every stretch in its middle, as the paper splits its data: first halves train, others test."""
    return [w[: len(w) // 2] for w in walks], [w[len(w) // 2 :] for w in walks]


def split_by_room(walks: Sequence[Walk], unseen: float, seed: int) -> tuple[list[Walk], list[Walk]]:
    """Keep whole rooms back: walks in the others, and in a fraction `unseen` of rooms, drawn by seed."""
    rooms = sorted({walk.room for walk in walks})
    if not 0 < unseen < 1 or len(rooms) < 2:
        raise InputError(
            f"training: expected a fraction in 0..1 of two rooms or more, got {unseen} of {len(rooms)}; "
            "collect more rooms"
        )
    count = min(max(1, round(unseen * len(rooms))), len(rooms) - 1)
    kept = set(np.random.default_rng(seed).permutation(rooms)[:count].tolist())
    return [w for w in walks if w.room not in kept], [w for w in walks if w.room in kept]


def lay(walks: Sequence[Walk], first: Float[np.ndarray, "2"], *, streams: int, window: int, mirrored: bool) -> Tape:
    """Lay walks end to end and cut them into streams of whole windows.

    Args:
        walks: stretches of walking.
        first: velocity before the first frame of each.
        streams: walked side by side.
        window: about as many frames; a little more or less, so that little is padded.
        mirrored: add every stream with left and right exchanged.
    """
    u, label = (np.concatenate([getattr(walk, name) for walk in walks]) for name in ("u", "label"))
    last = np.concatenate([np.concatenate([first[None], walk.velocity[:-1]]) for walk in walks])
    fresh = np.concatenate([np.arange(len(walk)) == 0 for walk in walks])

    def both(values: np.ndarray) -> np.ndarray:
        values = cut(values, streams=streams, window=window)
        if not mirrored:
            return values
        swapped = values[..., ::-1] if values.ndim == 4 else values
        return np.concatenate([values, swapped], axis=2)

    counts, fresh = np.ones(len(fresh)), both(fresh)
    fresh[0, 0] = True
    u, label, last, counts = (jnp.asarray(both(x), dtype=float) for x in (u, label, last, counts))
    return Tape(u=u, label=label, last=last, fresh=jnp.asarray(fresh), counts=counts)


def cut(values: Shaped[np.ndarray, "all *shape"], *, streams: int, window: int) -> np.ndarray:
    """Cut a series into streams of windows, axes (window, frame, stream, ...), as `lay` does, filled up with zeros."""
    frames = len(values)
    windows = max(1, round(frames / (streams * window)))
    length = -(-frames // (streams * windows))
    padding = streams * windows * length - frames
    values = np.pad(values, ((0, padding), *((0, 0),) * (values.ndim - 1)))
    return np.moveaxis(values.reshape(streams, windows, length, *values.shape[1:]), 0, 2)
