"""Responses of looming detectors to video clips, seen by one eye that receives the whole picture.

Pictures of any size are area-averaged to 64 x 48 cells, so that a detector is compiled once for all clips.
Detectors keep their published constants, which are for 30 frames a second; the alarm uses each clip's rate.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt8

from lgmdjax.detectors import alarm
from lgmdjax.errors import InputError
from lgmdjax.evaluation.clip_labels import Label
from lgmdjax.evaluation.stimulus_scores import DetectorSetup
from lgmdjax.reporting import video_geometry, video_io
from lgmdjax.sensors import camera

WIDTH, HEIGHT = 64, 48  # cells
CHUNK = 32  # frames that are processed at once
MIN_FRAMES = 3  # inhibition is delayed by a frame, so the third frame is the first with full inhibition
MAX_OVERTIME = 0.5  # s; a labelled contact may be this long after the end of its clip, as labels are inexact
THUMBNAIL_WIDTH = 160  # px


@dataclass(frozen=True, kw_only=True)
class Clip:
    """A clip as the detectors see it, and thumbnails of some of its frames."""

    label: Label
    rate: float  # frames a second
    time: Float[np.ndarray, " frames"]  # s
    frames: UInt8[np.ndarray, "frames height width"]  # grey, of cells
    thumbnails: Sequence[tuple[float, UInt8[np.ndarray, "rows columns"]]]  # time [s], grey


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Responses of one detector to one clip; to the first frame, in which nothing has changed, those at rest."""

    u: Float[np.ndarray, " frames"]  # the detector's own
    excitation: Float[np.ndarray, " frames"]
    adapted: Float[np.ndarray, " frames"]  # A of `alarm`
    whole_field: Float[np.ndarray, " frames"]


def read_clip(folder: Path, label: Label, pictures: int = 10) -> Clip:
    """Return a clip in cells, with some thumbnails.

    Raises `InputError` if it is missing, not a video, or shorter than its label says.
    """
    path = folder / label.clip
    with video_io.open_reader(path) as video:
        rate = float(video.rate)
        read = list(video.frames(WIDTH, HEIGHT))
    if len(read) < MIN_FRAMES:
        raise InputError(
            f"expected a clip of {MIN_FRAMES} frames or more, got {len(read)} in {path}; take a longer one"
        )
    time = np.asarray([frame.time for frame in read])
    if label.contact is not None and label.contact > time[-1] + MAX_OVERTIME:
        raise InputError(
            f"expected a contact within {path}, which ends at {time[-1]:.2f} s, got {label.contact} s; "
            "correct the label, or get the whole file"
        )
    shown = np.unique(np.linspace(0, len(read) - 1, pictures).round().astype(int))
    return Clip(
        label=label,
        rate=rate,
        time=time,
        frames=np.stack([frame.picture for frame in read]),
        thumbnails=_thumbnails(path, set(shown.tolist())),
    )


def _thumbnails(path: Path, shown: set[int]) -> list[tuple[float, np.ndarray]]:
    with video_io.open_reader(path) as video:
        width, height = video_geometry.square_size(video.width, video.height, video.pixel_aspect)
        scale = min(THUMBNAIL_WIDTH / width, 1.0)
        frames = video.frames(max(round(width * scale), 1), max(round(height * scale), 1))
        return [(frame.time, frame.picture) for index, frame in enumerate(frames) if index in shown]


def respond(setup: DetectorSetup, clip: Clip) -> Trace:
    """Run a detector and the alarm's scale over a clip."""
    detector = setup.detector
    params = setup.params(camera.Params(width=WIDTH, height=HEIGHT))
    scale = jax.tree.map(jnp.float32, alarm.Params(frame_time=1.0 / clip.rate))
    frames = clip.frames.astype(np.float32)
    states = _start(detector.init, params, scale, jnp.asarray(frames[0]))
    rest = frames[1:]
    parts = []
    for first in range(0, len(rest), CHUNK):
        chunk = rest[first : first + CHUNK]
        padded = np.concatenate([chunk, np.repeat(chunk[-1:], CHUNK - len(chunk), axis=0)])
        states, outputs = _advance(detector.step, params, scale, states, jnp.asarray(padded))
        parts.append([np.asarray(output)[: len(chunk)] for output in outputs])
    u, excitation, adapted, whole_field = (
        np.concatenate([[at_rest], *(part[k] for part in parts)]).astype(float)
        for k, at_rest in enumerate((0.5, 0.0, 0.5, 0.0))
    )
    if not all(np.isfinite(values).all() for values in (u, excitation)):
        raise InputError(f"expected finite responses to {clip.label.clip}, got some that are not; check the detector")
    return Trace(u=u, excitation=excitation, adapted=adapted, whole_field=whole_field)


@partial(jax.jit, static_argnums=0)
def _start(init: Callable[..., PyTree], params: PyTree, scale: alarm.Params, frame: Array) -> PyTree:
    return init(params, frame), alarm.init(scale, frame)


@partial(jax.jit, static_argnums=0)
def _advance(
    step: Callable[..., Any], params: PyTree, scale: alarm.Params, states: PyTree, frames: Float[Array, "chunk h w"]
) -> tuple[PyTree, tuple[Array, ...]]:
    """Return the next states, and u, excitation, A and w of each frame."""

    def advance(states: PyTree, frame: Array) -> tuple[PyTree, tuple[Array, ...]]:
        seen, adapting = states
        seen, response = step(params, seen, frame)
        given = alarm.AlarmInput(frame=frame, excitation=response.excitation)
        adapting, adapted = alarm.step(scale, adapting, given)
        return (seen, adapting), (response.u, response.excitation, adapted.adapted, adapted.whole_field)

    return jax.lax.scan(advance, states, frames)
