"""Clips of laboratory stimuli, with the true geometry of what they show.

| clips     | what                                                                                             |
| --------- | ------------------------------------------------------------------------------------------------ |
| selection | 2 s of every stimulus; those that approach make contact 0.2 s before the end                     |
| timing    | approaches of a dark square, all as long as the slowest needs: 10 l/|v|, and 0.2 s after contact |
| contrast  | an approach whose contrast with its surroundings is reduced                                      |
| noise     | an approach, and a still image, with independent noise in every pixel and frame                  |
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.detectors.protocol import Geometry
from lgmdjax.evaluation.settings import StimulusBench
from lgmdjax.sensors import camera, stimuli

CONTRASTS = (1.0, 0.5, 0.2, 0.1)  # of an approach with the middle l/|v|
NOISE = (2.0, 5.0, 10.0, 20.0)  # grey, standard deviation
SECONDS, HOLD = 2.0, 0.2  # duration of a clip, and of what follows contact [s]
APPROACH_LENGTH = 10.0  # l/|v|, duration of an approach whose peak is timed

Frames = Float[np.ndarray, "clips frames height width"]
Stimulus = Callable[..., Array]
Clip = tuple[str, Any, Geometry]
"""Name, frames, geometry."""


class Motions(NamedTuple):
    """Sizes and speeds of the stimuli that are to be distinguished."""

    l_over_v: tuple[float, float, float] = (0.03, 0.1, 0.3)  # of approaches and recessions [s]
    rates: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)  # of translation [rad/s]
    half_angle: float = 0.3  # of the square that translates; half of it is the half height of the bar [rad]
    grating: tuple[float, float] = (0.5, 0.5)  # period [rad] and rate [rad/s]
    yaw: float = 0.5  # rad/s
    sway: tuple[float, float] = (0.1, 0.8)  # amplitude [rad] and period [s]


SCORED = Motions()  # those of `lgmdjax bench stimuli`
OTHER = Motions(
    l_over_v=(0.05, 0.15, 0.4),
    rates=(0.35, 0.7, 1.4, 2.8),
    half_angle=0.4,
    grating=(0.7, 0.8),
    yaw=0.8,
    sway=(0.15, 1.1),
)  # the same kinds of motion, for a fit that is scored on the others


class Clips(NamedTuple):
    """Clips of one length, each with a name."""

    names: tuple[str, ...]
    frames: Frames  # grey
    geometry: Geometry  # (clips, frames)
    time: Float[np.ndarray, "frames"]  # from contact in clips that approach, negative before it [s]


def selection(settings: StimulusBench, motions: Motions = SCORED) -> Clips:
    """Return a clip of every stimulus."""
    eye = camera.Params(width=settings.width, height=settings.height)
    time = _times(settings, SECONDS - HOLD)
    middle, width = motions.l_over_v[1], motions.half_angle
    looms, nothing = approach_geometry(middle, time), _nothing(time)

    def clip(name: str, geometry: Geometry, stimulus: Stimulus, *values: float) -> Clip:
        return name, _render(stimulus, eye, jnp.asarray(time, float), *values), geometry

    return _stack(
        [
            *(each for l_over_v in motions.l_over_v for each in _looming(eye, l_over_v, time)),
            *(clip(f"translate {r:g} rad/s", nothing, stimuli.translation, width, r) for r in motions.rates),
            clip("elongate", looms, stimuli.elongation, 0.5 * width, middle),
            clip("grating", nothing, stimuli.grating, *motions.grating),
            clip("yaw", nothing, stimuli.yaw, motions.yaw),
            clip("sway", nothing, stimuli.roll, *motions.sway),
            ("flash", _render(stimuli.flash, eye, jnp.asarray(time + 0.5 * SECONDS, float)), nothing),
            clip("approach textured", looms, stimuli.textured_approach, middle),
        ],
        time,
    )


def timing(settings: StimulusBench) -> Clips:
    """Return approaches with the l/|v| of the settings."""
    eye = camera.Params(width=settings.width, height=settings.height)
    time = _times(settings, APPROACH_LENGTH * max(settings.l_over_v))
    return _stack([(f"{x:g}", *_approach(eye, x, time)) for x in settings.l_over_v], time)


def contrast(settings: StimulusBench) -> Clips:
    """Return an approach at every contrast."""
    frames, geometry, time = _plain_approach(settings)
    clips = [(f"{c:g}", stimuli.BRIGHT + c * (frames - stimuli.BRIGHT), geometry) for c in CONTRASTS]
    return _stack(clips, time)


def noise(settings: StimulusBench, seed: int) -> Clips:
    """Return an approach and a still image at every noise level, in alternation."""
    frames, geometry, time = _plain_approach(settings)
    generator = np.random.default_rng(seed)
    still = np.broadcast_to(frames[:1], frames.shape)
    clips = []
    for sigma in NOISE:
        for name, clean, true in (("approach", frames, geometry), ("still", still, _nothing(time))):
            noisy = np.clip(clean + generator.normal(0.0, sigma, frames.shape), 0.0, 255.0)
            clips.append((f"{name} {sigma:g}", noisy.astype(frames.dtype), true))
    return _stack(clips, time)


def approach_geometry(l_over_v: float, time: Float[np.ndarray, "frames"]) -> Geometry:
    """Return size and expansion of an object that makes contact at t = 0 and does not grow afterwards."""
    before = np.maximum(-time, 0.0)
    size = 2.0 * np.arctan2(l_over_v, before)
    rate = np.where(time < 0, 2.0 * l_over_v / (before**2 + l_over_v**2), 0.0)
    return Geometry(size=jnp.asarray(size, float), rate=jnp.asarray(rate, float))


def _approach(eye: camera.Params, l_over_v: float, time: Float[np.ndarray, "frames"]) -> tuple[np.ndarray, Geometry]:
    frames = _render(stimuli.approach, eye, jnp.asarray(time, float), l_over_v)
    return np.asarray(frames), approach_geometry(l_over_v, time)


def _looming(eye: camera.Params, l_over_v: float, time: Float[np.ndarray, "frames"]) -> Iterator[Clip]:
    """Yield an approach and its reverse, each dark and bright."""
    frames, geometry = _approach(eye, l_over_v, time)
    back = Geometry(size=jnp.flip(jnp.asarray(geometry.size)), rate=-jnp.flip(jnp.asarray(geometry.rate)))
    for polarity, images in (("dark", frames), ("bright", stimuli.DARK + stimuli.BRIGHT - frames)):
        yield f"approach {polarity} {l_over_v:g} s", images, geometry
        yield f"recede {polarity} {l_over_v:g} s", images[::-1], back


def _plain_approach(settings: StimulusBench) -> tuple[np.ndarray, Geometry, np.ndarray]:
    eye = camera.Params(width=settings.width, height=settings.height)
    time = _times(settings, SECONDS - HOLD)
    return *_approach(eye, SCORED.l_over_v[1], time), time


def _times(settings: StimulusBench, before: float) -> Float[np.ndarray, "frames"]:
    first, last = round(before * settings.frame_rate), round(HOLD * settings.frame_rate)
    return np.arange(-first, last + 1) / settings.frame_rate


def _nothing(time: np.ndarray) -> Geometry:
    return Geometry(size=jnp.zeros(len(time)), rate=jnp.zeros(len(time)))


@partial(jax.jit, static_argnums=(0, 1))
def _render(stimulus: Stimulus, eye: camera.Params, time: Float[Array, "frames"], *values: Array | float) -> Array:
    """Return the frames of a stimulus, compiled once for all values."""
    return jax.vmap(lambda t: stimulus(eye, *values, t))(time)


def _stack(clips: Iterable[Clip], time: Float[np.ndarray, "frames"]) -> Clips:
    names, frames, geometry = zip(*clips, strict=True)
    together = jax.tree.map(lambda *parts: jnp.stack(parts), *geometry)
    return Clips(names=names, frames=np.stack([np.asarray(images) for images in frames]), geometry=together, time=time)
