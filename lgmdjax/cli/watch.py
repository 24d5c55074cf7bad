"""`lgmdjax watch`: the two LGMDs on a video of the user, read and written frame by frame.

Writes to a folder with the full name of the video:

| file                          | content                                                            |
| ----------------------------- | ------------------------------------------------------------------ |
| response.csv or .parquet      | the responses, one row for each frame                              |
| response.png                  | plot of the responses over time                                    |
| overlay.mp4                   | the pictures of both eyes, the layers E, I and S, and u over time; |
|                               | not with --no-overlay                                              |
"""

import contextlib
import json
import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from jaxtyping import Array, Float, UInt8
from matplotlib.figure import Figure
from tqdm import tqdm

from lgmdjax import __version__
from lgmdjax.cli.flags import WatchFlags
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.hardware import live_source
from lgmdjax.reporting import lgmd_overlay, video_geometry, video_io
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.sensors import hemifield

MIN_FRAMES = 3  # inhibition is delayed by a frame, so the third is the first with all of it
MIN_SIZE = 16  # px, smallest width and height of the picture of an eye
NOMINAL_RATE = 30  # Hz, of the robot's cameras
SIDES = ("left", "right")
CONSTANTS = ("threshold", "suppression", "inhibition")  # of the detector, which the command line can change
TableFormat = Literal["csv", "parquet"]
UNITS = {
    "time": "s",
    "u": "1, from 0.5 (still) to 1",
    "feed_forward": "grey level",
    "excitation": "grey level",
}


@dataclass(frozen=True, kw_only=True)
class StereoLayout:
    """How the pictures of both eyes are cut out of the frames of a video."""

    stereo: bool = False  # each frame holds two pictures, side by side
    overlap: float = 0.5  # fraction of the picture's width that an eye sees, from its own side
    width: int = 320  # px of one picture; wider ones are averaged down to it


def watch_video(flags: WatchFlags) -> list[Path]:
    """Run both detectors on the video of the flags, and return the written files."""
    if flags.mono and flags.stereo is not None:
        raise InputError("expected --mono or --stereo, got both; leave one out")
    given = {name: getattr(flags, name) for name in CONSTANTS}
    params = replace(lgmd.Params(), **{name: value for name, value in given.items() if value is not None})
    layout = StereoLayout(stereo=flags.stereo is not None, overlap=flags.overlap, width=flags.width)
    if live_source.is_live(flags.video):
        if not flags.seconds > 0:
            raise InputError(f"expected --seconds above 0, got {flags.seconds:g}; a live source is watched for so long")
        name, reader = live_source.file_name(flags.video), live_source.open_reader(flags.video, flags.seconds)
    else:
        name = os.path.expanduser(flags.video)
        reader = video_io.open_reader(Path(name))
    lgmd.check(params)
    with reader as video:
        return detect_in(
            video, Path(name), flags.out, layout=layout, params=params, table=flags.table, overlay=flags.overlay
        )


def detect_looming(
    path: Path,
    out: Path,
    *,
    layout: StereoLayout,
    params: lgmd.Params,
    table: TableFormat = "csv",
    overlay: bool = True,
) -> list[Path]:
    """Run both detectors on a video, and return the files written to out/<name of the video>/.

    Raises InputError, and writes nothing, if the video is missing, damaged, too short, or does not fit the layout.
    """
    lgmd.check(params)
    with video_io.open_reader(path) as video:
        return detect_in(video, path, out, layout=layout, params=params, table=table, overlay=overlay)


def detect_in(
    video: video_io.Video,
    path: Path,
    out: Path,
    *,
    layout: StereoLayout,
    params: lgmd.Params,
    table: TableFormat = "csv",
    overlay: bool = True,
) -> list[Path]:
    """Run both detectors on an open video; arguments, files and errors as of `detect_looming`."""
    lgmd.check(params)
    folder = out / path.name
    width, height = _scaled_size(path, video, layout)
    eyes = _split(np.zeros((height, width), np.uint8), layout)
    overlay_layout = lgmd_overlay.make_layout(*eyes.shape[1:]) if overlay else None
    _print_notes(path, video)
    with storage.replacing_all(folder) as partial_folder, _progress(video, width, height) as frames:
        samples, excitations = _process(
            frames, layout, params, overlay=overlay_layout, target=partial_folder / "overlay.mp4", rate=video.rate
        )
        if len(samples) < MIN_FRAMES:
            raise InputError(
                f"expected a video of {MIN_FRAMES} frames or more, got {len(samples)} in {path}; take a longer one"
            )
        responses = _table(samples, excitations, _metadata(path, video, layout, params))
        _write_table(responses, partial_folder, table)
        (partial_folder / "response.png").write_bytes(style.to_png(plot(responses, params)))
    written = [f"response.{table}", "response.png", *(["overlay.mp4"] if overlay else [])]
    for earlier in {"response.csv", "response.parquet", "overlay.mp4"} - set(written):
        (folder / earlier).unlink(missing_ok=True)
    return [folder / name for name in written]


def _write_table(responses: pa.Table, folder: Path, table: TableFormat) -> None:
    """Write the responses; the file is opened here, because Arrow refuses names that are not UTF-8."""
    with (folder / f"response.{table}").open("wb") as file:
        if table == "csv":
            pyarrow.csv.write_csv(responses, file)
        else:
            pyarrow.parquet.write_table(responses, file)


@style.styled
def plot(responses: pa.Table, params: lgmd.Params) -> Figure:
    """Plot u and FF of both eyes over time, with the threshold T_f above which FF suppresses u."""
    figure = Figure(figsize=(style.WIDTH, 3.4))
    upper, lower = figure.subplots(2, 1, sharex=True)
    time = responses["time"].to_numpy()
    for side, colour in zip(SIDES, (style.LEFT_COLOUR, style.RIGHT_COLOUR), strict=True):
        upper.plot(time, responses[f"u_{side}"].to_numpy(), color=colour, label=f"{side} eye")
        lower.plot(time, responses[f"feed_forward_{side}"].to_numpy(), color=colour)
    lower.axhline(float(params.suppression), color=style.GREY, linestyle=":", label="T_f")
    upper.set(ylabel="u", ylim=(0.48, 1.02), title="response of the two LGMDs")
    lower.set(ylabel="FF [grey levels]", xlabel="time [s]")
    upper.legend(loc="upper left", ncols=2)
    lower.legend(loc="upper left")
    return figure


def _print_notes(path: Path, video: video_io.Video) -> None:
    """Print on stderr what the user should know of the video, and do about it."""
    ratio = NOMINAL_RATE / float(video.rate)
    if not 0.8 < ratio < 1.25:
        scaled = [f"--{name} {ratio * getattr(lgmd.Params, name):.3g}" for name in ("threshold", "suppression")]
        print(
            f"note: {float(video.rate):.3g} frames a second; T_s and T_f are meant for the changes of "
            f"1/{NOMINAL_RATE} s: try {' '.join(scaled)}, or convert to {NOMINAL_RATE} frames a second",
            file=sys.stderr,
        )
    if video.left_out:
        print(
            f"note: {path} begins between two key frames or with damage: {video.left_out} packets before the first "
            "whole frame are left out; look whether the beginning matters",
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
            f"expected pictures of {MIN_SIZE} px or more either way, got {width} x {height} from {path}; "
            "raise --width, or give a larger video"
        )
    return pictures * width, height


def _split(picture: UInt8[np.ndarray, "height width"], layout: StereoLayout) -> Float[np.ndarray, "2 height eye"]:
    """Cut the pictures of both eyes out of one frame."""
    pictures = np.split(picture, 2, axis=1) if layout.stereo else [picture, picture]
    crops = [hemifield.crop(whole, side, overlap=layout.overlap) for side, whole in enumerate(pictures)]
    return np.stack(crops).astype(jnp.result_type(float))


@jax.jit
def _init(params: lgmd.Params, pictures: Float[Array, "2 height eye"]) -> lgmd.State:
    return jax.vmap(partial(lgmd.init, params))(pictures)


@jax.jit
def _step(
    params: lgmd.Params, states: lgmd.State, pictures: Float[Array, "2 height eye"]
) -> tuple[lgmd.State, Float[Array, "3 2"], lgmd.Layers]:
    """Return the next states, u, FF and excitation of both eyes, and the layers for the overlay.

    The layers are also returned without an overlay: another program would round u otherwise.
    """
    layers = jax.vmap(partial(lgmd.layers, params))(states, pictures)
    states, response = jax.vmap(partial(lgmd.step, params))(states, pictures)
    return states, jnp.stack([response.u, response.feed_forward, response.excitation]), layers


def _process(
    frames: Iterable[video_io.Frame],
    layout: StereoLayout,
    params: lgmd.Params,
    *,
    overlay: lgmd_overlay.Layout | None,
    target: Path,
    rate: Fraction,
) -> tuple[list[lgmd_overlay.ResponseSample], list[tuple[float, float]]]:
    """Run the detectors over the frames; return responses and excitations of each frame.

    With an overlay, its video is written to the target.
    """
    samples: list[lgmd_overlay.ResponseSample] = []
    excitations: list[tuple[float, float]] = []
    threshold = float(params.threshold)
    with contextlib.ExitStack() as stack:
        write = None
        if overlay is not None:
            write = stack.enter_context(video_io.open_writer(target, *overlay.size, rate, fast=True))
        for sample, excitation, pictures, layers in _respond(frames, layout, params):
            samples.append(sample)
            excitations.append(excitation)
            if overlay is not None and write is not None:
                write(lgmd_overlay.render_overlay(overlay, pictures, layers, threshold, samples))
    return samples, excitations


def _respond(
    frames: Iterable[video_io.Frame], layout: StereoLayout, params: lgmd.Params
) -> Iterator[tuple[lgmd_overlay.ResponseSample, tuple[float, float], np.ndarray, lgmd.Layers]]:
    """Yield responses, excitations, pictures and layers of each frame.

    The detectors start from the first frame, so that nothing has changed in it.
    """
    states = None
    for frame in frames:
        pictures = _split(frame.picture, layout)
        states = _init(params, jnp.asarray(pictures)) if states is None else states
        states, responses, layers = _step(params, states, jnp.asarray(pictures))
        u, feed_forward, excitation = ((left, right) for left, right in np.asarray(responses).tolist())
        yield lgmd_overlay.ResponseSample(frame.time, u, feed_forward), excitation, pictures, layers


def _table(
    samples: list[lgmd_overlay.ResponseSample], excitations: list[tuple[float, float]], metadata: dict[str, str]
) -> pa.Table:
    """Return the responses as a table with one row for each frame."""
    columns: dict[str, object] = {"frame": range(len(samples)), "time": [sample.time for sample in samples]}
    for side, name in enumerate(SIDES):
        columns[f"u_{name}"] = [sample.u[side] for sample in samples]
        columns[f"feed_forward_{name}"] = [sample.feed_forward[side] for sample in samples]
        columns[f"excitation_{name}"] = [pair[side] for pair in excitations]
    return pa.table({name: pa.array(values) for name, values in columns.items()}, metadata=metadata)


def _metadata(path: Path, video: video_io.Video, layout: StereoLayout, params: lgmd.Params) -> dict[str, str]:
    constants = {name: float(getattr(params, name)) for name in CONSTANTS}
    facts = {"units": UNITS, "eyes": asdict(layout), "lgmd": constants, "rate": float(video.rate)}
    name = os.fsencode(path.name).decode("utf-8", "replace")
    return {"video": name, "lgmdjax": __version__} | {key: json.dumps(fact) for key, fact in facts.items()}
