"""`lgmdjax watch`: run the two LGMDs on a video, which is read and written frame by frame.

Writes to a folder with the full name of the video:

| file                          | content                                                            |
| ----------------------------- | ------------------------------------------------------------------ |
| response.csv or .parquet      | the responses, one row for each frame                              |
| response.png                  | plot of the responses over time                                    |
| alarms.json                   | when alarms begin and end, and with which settings                 |
| overlay.mp4                   | the pictures of both eyes, the layers E, I and S, and u over time; |
|                               | not with --no-overlay                                              |
"""

import contextlib
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from tqdm.auto import tqdm

from lgmdjax.cli import watch_files
from lgmdjax.cli.flags import WatchFlags
from lgmdjax.cli.watch_files import Detectors, Responses, TableFormat
from lgmdjax.detectors import alarm, lgmd
from lgmdjax.errors import InputError, one_line
from lgmdjax.hardware import live_source
from lgmdjax.reporting import lgmd_overlay, video_geometry, video_io
from lgmdjax.runtime import partial_files
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield
from lgmdjax.sensors.settings import check_field

MIN_FRAMES = 3  # inhibition is delayed by a frame, so the third frame is the first with full inhibition
MIN_SIZE = 16  # px, smallest width and height of the picture of an eye
NOMINAL_RATE = 30  # Hz, of the robot's cameras


@dataclass(frozen=True, kw_only=True)
class StereoLayout:
    """How the pictures of both eyes are cut out of the frames of a video."""

    stereo: bool = False  # each frame holds two pictures, side by side
    overlap: float = 0.5  # fraction of the picture's width that an eye sees, from its own side
    ground: float = 0.0  # fraction of its height, at the bottom, that no eye sees
    width: int = 320  # px of one picture; wider ones are averaged down to it


class WatchResult(NamedTuple):
    """The files written, and the alarms."""

    files: list[Path]
    alarms: list[JsonObject]  # with start and end [s]


def watch_video(flags: WatchFlags) -> WatchResult:
    """Run both detectors on the video of the flags."""
    if flags.mono and flags.stereo is not None:
        raise InputError("expected --mono or --stereo, got both; leave one out")
    if live_source.is_live(flags.video):
        if not flags.seconds > 0:
            raise InputError(f"expected --seconds above 0, got {flags.seconds:g}; a live source is watched that long")
        name, reader = live_source.file_name(flags.video), live_source.open_reader(flags.video, flags.seconds)
    else:
        name = os.path.expanduser(flags.video)
        reader = video_io.open_reader(Path(name))
    layout, params = _settings(flags)
    with reader as video:
        return detect_looming_in_video(
            video, Path(name), flags.out, layout=layout, params=params, table=flags.table, overlay=flags.overlay
        )


def _settings(flags: WatchFlags) -> tuple[StereoLayout, Detectors]:
    """Return the layout, and the constants of detectors and alarm; raise InputError for impossible ones."""
    given = {name: getattr(flags, name) for name in lgmd.SCALARS}
    check_field(overlap=flags.overlap, ground=flags.ground, falloff=flags.falloff)
    if not 0 < flags.fov <= 360:
        raise InputError(
            f"expected --fov of more than 0 to 360 degrees, got {flags.fov}; 170 is that of the robot's eyes"
        )
    params = lgmd.Params(
        **{name: value for name, value in given.items() if value is not None},
        pooling=flags.pooling,
        falloff=flags.falloff,
        edges=hemifield.edges(math.radians(flags.fov), flags.overlap),
    )
    layout = StereoLayout(
        stereo=flags.stereo is not None, overlap=flags.overlap, ground=flags.ground, width=flags.width
    )
    raised = alarm.Params(threshold=flags.alarm.threshold, persistence=flags.alarm.persistence)
    return layout, Detectors(params, raised)


def detect_looming(
    path: Path,
    out: Path,
    *,
    layout: StereoLayout,
    params: Detectors,
    table: TableFormat = "csv",
    overlay: bool = True,
) -> WatchResult:
    """Run both detectors on a video; files are written to out/<name of the video>/.

    Raises InputError, and writes nothing, if the video is missing, damaged, too short, or does not fit the layout.
    """
    with video_io.open_reader(path) as video:
        return detect_looming_in_video(video, path, out, layout=layout, params=params, table=table, overlay=overlay)


def detect_looming_in_video(
    video: video_io.Video,
    path: Path,
    out: Path,
    *,
    layout: StereoLayout,
    params: Detectors,
    table: TableFormat = "csv",
    overlay: bool = True,
) -> WatchResult:
    """Run both detectors on an open video; arguments, files and errors as for `detect_looming`."""
    lgmd.check(params.lgmd)
    alarm.check(params.alarm)
    folder = out / path.name
    width, height = _scaled_size(path, video, layout)
    eyes = _split(np.zeros((height, width), np.uint8), layout)
    overlay_layout = lgmd_overlay.make_layout(*eyes.shape[1:]) if overlay else None
    _print_notes(path, video)
    params = params._replace(alarm=replace(params.alarm, frame_time=1 / float(video.rate)))
    with partial_files.replacing_all(folder) as partial_folder, _progress(video, width, height) as frames:
        with contextlib.ExitStack() as stack:
            write = None
            if overlay_layout is not None:
                target, size = partial_folder / "overlay.mp4", overlay_layout.size
                write = stack.enter_context(video_io.open_writer(target, *size, video.rate, fast=True))
            seen = _process(frames, layout, params, overlay_layout, write)
        if len(seen.samples) < MIN_FRAMES:
            raise InputError(
                f"expected a video of {MIN_FRAMES} frames or more, got {len(seen.samples)} in {path}; take a longer one"
            )
        name = os.fsencode(path.name).decode("utf-8", "replace")
        facts = {"video": name, "eyes": asdict(layout), "rate": float(video.rate)}
        alarms = watch_files.write_files(partial_folder, seen, params, facts, table)
    written = [f"response.{table}", "response.png", "alarms.json", *(["overlay.mp4"] if overlay else [])]
    for earlier in {"response.csv", "response.parquet", "overlay.mp4"} - set(written):
        (folder / earlier).unlink(missing_ok=True)
    return WatchResult([folder / name for name in written], alarms)


def _print_notes(path: Path, video: video_io.Video) -> None:
    """Print notes on stderr about a video that may need other settings or a repair."""
    ratio = NOMINAL_RATE / float(video.rate)
    if not 0.8 < ratio < 1.25:
        scaled = [f"--{name} {ratio * getattr(lgmd.Params, name):.3g}" for name in ("threshold", "suppression")]
        print(
            f"note: {float(video.rate):.3g} frames a second; T_s and T_f are meant for changes over "
            f"1/{NOMINAL_RATE} s: try {' '.join(scaled)}, or convert to {NOMINAL_RATE} frames a second",
            file=sys.stderr,
        )
    if video.left_out:
        print(
            one_line(
                f"note: {path} begins between two key frames or with damage: {video.left_out} packets before the first "
                "whole frame are left out; check whether the beginning matters"
            ),
            file=sys.stderr,
        )


def _progress(video: video_io.Video, width: int, height: int) -> tqdm:
    return tqdm(video.frames(width, height), total=video.count or None, unit="frame", desc="watch")


def _scaled_size(path: Path, video: video_io.Video, layout: StereoLayout) -> tuple[int, int]:
    """Return the size at which the video is read, so that the picture of an eye is at most `layout.width` wide."""
    if layout.stereo and video.width % 2:
        raise InputError(
            f"expected an even width for two pictures side by side, got {video.width} px in {path}; "
            "crop the video, or use --mono"
        )
    pictures = 2 if layout.stereo else 1
    full_width, full_height = video_geometry.square_size(video.width // pictures, video.height, video.pixel_aspect)
    width = min(layout.width, full_width)
    height = round(full_height * width / full_width)
    if min(width, height) < MIN_SIZE:
        raise InputError(
            f"expected pictures of {MIN_SIZE} px or more in width and height, got {width} x {height} from {path}; "
            "raise --width, or give a larger video"
        )
    return pictures * width, height


def _split(picture: UInt8[np.ndarray, "height width"], layout: StereoLayout) -> Float[np.ndarray, "2 height eye"]:
    """Cut the pictures of both eyes out of one frame."""
    pictures = np.split(picture, 2, axis=1) if layout.stereo else [picture, picture]
    field = {"overlap": layout.overlap, "ground": layout.ground}
    crops = [hemifield.crop(whole, side, **field) for side, whole in enumerate(pictures)]
    return np.stack(crops).astype(jnp.result_type(float))


States = tuple[lgmd.State, alarm.State]


@jax.jit
def _init(params: Detectors, pictures: Float[Array, "2 height eye"]) -> States:
    seen = _outermost_first(params.lgmd, pictures)
    return jax.vmap(partial(lgmd.init, params.lgmd))(seen), jax.vmap(partial(alarm.init, params.alarm))(pictures)


@jax.jit
def _step(
    params: Detectors, states: States, pictures: Float[Array, "2 height eye"]
) -> tuple[States, Float[Array, "5 2"], lgmd.Layers]:
    """Return the next states, u, FF, excitation, adapted response and alarm of both eyes, and the layers.

    The layers are returned even without an overlay, because a program without them would round u differently.
    """
    seen, adapting = states
    ordered = _outermost_first(params.lgmd, pictures)
    layers = jax.vmap(partial(lgmd.layers, params.lgmd))(seen, ordered)
    seen, response = jax.vmap(partial(lgmd.step, params.lgmd))(seen, ordered)
    inputs = alarm.AlarmInput(frame=pictures, excitation=response.excitation)
    adapting, adapted = jax.vmap(partial(alarm.step, params.alarm))(adapting, inputs)
    curves = [response.u, response.feed_forward, response.excitation, adapted.adapted, adapted.alarm]
    _, rows, columns = pictures.shape
    shown = jax.tree.map(partial(_to_pixels, params.lgmd, (rows, columns)), layers)
    return (seen, adapting), jnp.stack(curves), shown


def _outermost_first(params: lgmd.Params, pictures: Float[Array, "2 rows columns"]) -> Float[Array, "2 rows columns"]:
    """Mirror the right picture if its columns have weights; without them this would only change the rounding of u."""
    return hemifield.outermost_first(pictures) if params.falloff else pictures


def _to_pixels(params: lgmd.Params, shape: tuple[int, ...], layer: Float[Array, "2 rows columns"]) -> Array:
    """Return a layer with a value for each pixel, in the order of the picture."""
    if params.pooling > 1:
        sizes = zip(shape, layer.shape[1:], strict=True)
        rows, columns = (np.arange(pixels) * cells // pixels for pixels, cells in sizes)
        layer = layer[:, rows][:, :, columns]
    return _outermost_first(params, layer)


def _process(
    frames: Iterable[video_io.Frame],
    layout: StereoLayout,
    params: Detectors,
    overlay: lgmd_overlay.Layout | None,
    write: Callable[[UInt8[np.ndarray, "height width channels"]], None] | None,
) -> Responses:
    """Run the detectors over the frames and return the responses; with an overlay, write that of each frame."""
    samples: list[lgmd_overlay.ResponseSample] = []
    excitations: list[tuple[float, float]] = []
    threshold = float(params.lgmd.threshold)
    for sample, excitation, pictures, layers in _respond(frames, layout, params):
        samples.append(sample)
        excitations.append(excitation)
        if overlay is not None and write is not None:
            write(lgmd_overlay.render_overlay(overlay, pictures, layers, threshold, samples))
    return Responses(samples, excitations)


def _respond(
    frames: Iterable[video_io.Frame], layout: StereoLayout, params: Detectors
) -> Iterator[tuple[lgmd_overlay.ResponseSample, tuple[float, float], np.ndarray, lgmd.Layers]]:
    """Yield responses, excitations, pictures and layers of each frame.

    The detectors start from the first frame, in which nothing has changed.
    """
    states = None
    for frame in frames:
        pictures = _split(frame.picture, layout)
        states = _init(params, jnp.asarray(pictures)) if states is None else states
        states, responses, layers = _step(params, states, jnp.asarray(pictures))
        u, feed_forward, excitation, adapted, alarms = ((left, right) for left, right in np.asarray(responses).tolist())
        is_alarm = max(alarms) > 0
        yield lgmd_overlay.ResponseSample(frame.time, u, feed_forward, adapted, is_alarm), excitation, pictures, layers
