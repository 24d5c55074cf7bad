"""Clips of laboratory stimuli, with the true geometry of what they show.

| clips     | what                                                                                             |
| --------- | ------------------------------------------------------------------------------------------------ |
| selection | 2 s of every stimulus; those that approach make contact 0.2 s before the end                     |
| timing    | approaches of a dark square, all as long as the slowest needs: 10 l/|v|, and 0.2 s after contact |
| contrast  | an approach whose contrast with its surroundings is reduced                                      |
| noise     | an approach, and a still image, with noise that is new in every pixel and frame                  |
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgmdjax.detectors.protocol import Geometry
from lgmdjax.evaluation.settings import StimulusBench
from lgmdjax.sensors import camera, stimuli

L_OVER_V = (0.03, 0.1, 0.3)  # s, of the approaches and recessions that are told from each other
RATES = (0.25, 0.5, 1.0, 2.0)  # rad/s, of translation
HALF_ANGLE = 0.3  # rad, of the square that translates; half of it is the half height of the bar
CONTRASTS = (1.0, 0.5, 0.2, 0.1)  # of an approach with the middle l/|v|
NOISE = (2.0, 5.0, 10.0, 20.0)  # grey, standard deviation
SECONDS, HOLD = 2.0, 0.2  # duration of a clip, and of what follows contact [s]
APPROACH_LENGTH = 10.0  # l/|v|, duration of an approach whose peak is timed

Frames = Float[np.ndarray, "clips frames height width"]


class Clips(NamedTuple):
    """Clips of one length, each with a name."""

    names: tuple[str, ...]
    frames: Frames  # grey
    geometry: Geometry  # (clips, frames)
    time: Float[np.ndarray, "frames"]  # before (negative) or after the contact of those that approach [s]


def selection(settings: StimulusBench) -> Clips:
    """Return a clip of every stimulus."""
    eye = camera.Params(width=settings.width, height=settings.height)
    time = _times(settings, SECONDS - HOLD)
    clips = [clip for l_over_v in L_OVER_V for clip in _looming(eye, l_over_v, time)]
    clips += [_clip(f"translate {r:g} rad/s", partial(stimuli.translation, eye, HALF_ANGLE, r), time) for r in RATES]
    middle = L_OVER_V[1]
    bar = partial(stimuli.elongation, eye, 0.5 * HALF_ANGLE, middle)
    clips.append(_clip("elongate", bar, time, approach_geometry(middle, time)))
    clips.append(_clip("grating", partial(stimuli.grating, eye, 0.5, 0.5), time))
    clips.append(_clip("yaw", partial(stimuli.yaw, eye, 0.5), time))
    clips.append(_clip("sway", partial(stimuli.roll, eye, 0.1, 0.8), time))
    clips.append(_clip("flash", partial(stimuli.flash, eye), time + 0.5 * SECONDS))
    textured = partial(stimuli.textured_approach, eye, middle)
    clips.append(_clip("approach textured", textured, time, approach_geometry(middle, time)))
    return _stack(clips, time)


def timing(settings: StimulusBench) -> Clips:
    """Return approaches with the l/|v| of the settings."""
    eye = camera.Params(width=settings.width, height=settings.height)
    time = _times(settings, APPROACH_LENGTH * max(settings.l_over_v))
    clips = [
        _clip(f"{l_over_v:g}", partial(stimuli.approach, eye, l_over_v), time, approach_geometry(l_over_v, time))
        for l_over_v in settings.l_over_v
    ]
    return _stack(clips, time)


def contrast(settings: StimulusBench) -> Clips:
    """Return an approach at every contrast."""
    _, frames, geometry, time = _plain_approach(settings)
    clips = [(f"{c:g}", stimuli.BRIGHT + c * (frames - stimuli.BRIGHT), geometry) for c in CONTRASTS]
    return _stack(clips, time)


def noise(settings: StimulusBench, seed: int) -> Clips:
    """Return an approach and a still image with every noise, in turn."""
    _, frames, geometry, time = _plain_approach(settings)
    generator = np.random.default_rng(seed)
    still = np.broadcast_to(frames[:1], frames.shape)
    clips = []
    for sigma in NOISE:
        for name, clean, true in (("approach", frames, geometry), ("still", still, _nothing(time))):
            noisy = np.clip(clean + generator.normal(0.0, sigma, frames.shape), 0.0, 255.0)
            clips.append((f"{name} {sigma:g}", noisy.astype(frames.dtype), true))
    return _stack(clips, time)


def approach_geometry(l_over_v: float, time: Float[np.ndarray, "frames"]) -> Geometry:
    """Return size and expansion of an object that makes contact at t = 0, and is not seen to grow afterwards."""
    before = np.maximum(-time, 0.0)
    size = 2.0 * np.arctan2(l_over_v, before)
    rate = np.where(time < 0, 2.0 * l_over_v / (before**2 + l_over_v**2), 0.0)
    return Geometry(size=jnp.asarray(size, float), rate=jnp.asarray(rate, float))


def _looming(eye: camera.Params, l_over_v: float, time: Float[np.ndarray, "frames"]) -> Iterable[tuple]:
    """Return an approach and its reverse, each dark and bright."""
    _, frames, geometry = _clip("", partial(stimuli.approach, eye, l_over_v), time, approach_geometry(l_over_v, time))
    back = Geometry(size=geometry.size[::-1], rate=-geometry.rate[::-1])  # pyright: ignore[reportIndexIssue]
    for polarity, images in (("dark", frames), ("bright", stimuli.DARK + stimuli.BRIGHT - frames)):
        yield f"approach {polarity} {l_over_v:g} s", images, geometry
        yield f"recede {polarity} {l_over_v:g} s", images[::-1], back


def _plain_approach(settings: StimulusBench) -> tuple[str, np.ndarray, Geometry, np.ndarray]:
    eye = camera.Params(width=settings.width, height=settings.height)
    time = _times(settings, SECONDS - HOLD)
    middle = L_OVER_V[1]
    return *_clip("approach", partial(stimuli.approach, eye, middle), time, approach_geometry(middle, time)), time


def _times(settings: StimulusBench, before: float) -> Float[np.ndarray, "frames"]:
    first, last = round(before * settings.frame_rate), round(HOLD * settings.frame_rate)
    return np.arange(-first, last + 1) / settings.frame_rate


def _nothing(time: np.ndarray) -> Geometry:
    return Geometry(size=jnp.zeros(len(time)), rate=jnp.zeros(len(time)))


def _clip(
    name: str, stimulus: Callable[[Array], Array], time: Float[np.ndarray, "frames"], geometry: Geometry | None = None
) -> tuple[str, np.ndarray, Geometry]:
    frames = jax.jit(jax.vmap(stimulus))(jnp.asarray(time, float))
    return name, np.asarray(frames), _nothing(time) if geometry is None else geometry


def _stack(clips: Iterable[tuple[str, np.ndarray, Geometry]], time: Float[np.ndarray, "frames"]) -> Clips:
    names, frames, geometry = zip(*clips, strict=True)
    together = jax.tree.map(lambda *parts: jnp.stack(parts), *geometry)
    return Clips(names=names, frames=np.stack(frames), geometry=together, time=time)
