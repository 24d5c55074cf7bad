"""`lgmdjax watch`: the two LGMDs on a video of the user's, read and written a frame at a time.

Leaves, in a folder of the video's full name: `response.csv` (or `.parquet`), one row a frame; `response.png`, the
same as a plot; `overlay.mp4`, what the eyes see with the layers E, I and S and the course of u.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Literal, get_args

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
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.reporting import lgmd_overlay, video_io
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.sensors import hemifield

LEAST_FRAMES = 3  # inhibition, a frame late, has not been felt before the third
SMALLEST = 16  # px, of an eye's picture either way
TUNED_RATE = 30  # Hz, of the robot's cameras
SIDES = ("left", "right")
Table = Literal["csv", "parquet"]
UNITS = {
    "time": "s",
    "u": "1, from 0.5 (still) to 1",
    "feed_forward": "grey level",
    "excitation": "grey level",
}


@dataclass(frozen=True, kw_only=True)
class Eyes:
    """How the pictures of a video become those of two eyes."""

    stereo: bool = False  # each frame holds two pictures side by side
    overlap: float = 0.5  # fraction of its picture's width that an eye looks at, from its own side
    width: int = 320  # px of one picture; wider ones are averaged down to it


def watch(
    path: Path,
    out: Path,
    *,
    eyes: Eyes,
    params: lgmd.Params,
    table: Table = "csv",
) -> list[Path]:
    """Run both detectors over a video; give the files written into out/<name of the video>/.

    Raises InputError when the video is missing, damaged, too short, or does not fit the eyes; nothing is then
    written.
    """
    lgmd.check(params)
    place = out / path.name
    with video_io.reading(path) as film:
        width, height = _scaled(path, film, eyes)
        _note_rate(film)
        sheet = lgmd_overlay.lay_out(*_split(np.zeros((height, width), np.uint8), eyes).shape[1:])
        with storage.all_or_nothing(place) as folder, _progress(film, width, height) as frames:
            course, excitations = _look_at_all(frames, sheet, folder / "overlay.mp4", film.rate, eyes, params)
            if len(course) < LEAST_FRAMES:
                raise InputError(
                    f"expected a video of {LEAST_FRAMES} frames or more, got {len(course)} in {path}; take a longer one"
                )
            responses = _table(course, excitations, _metadata(path, film, eyes, params))
            if table == "csv":
                pyarrow.csv.write_csv(responses, folder / "response.csv")
            else:
                pyarrow.parquet.write_table(responses, folder / "response.parquet")
            (folder / "response.png").write_bytes(style.to_png(plot(responses, params)))
    for other in set(get_args(Table)) - {table}:  # of an earlier time
        (place / f"response.{other}").unlink(missing_ok=True)
    return [place / name for name in (f"response.{table}", "response.png", "overlay.mp4")]


@style.styled
def plot(responses: pa.Table, params: lgmd.Params) -> Figure:
    """Draw u and FF of both eyes over time, FF with the level T_f at which it silences u."""
    figure = Figure(figsize=(style.WIDTH, 3.4))
    upper, lower = figure.subplots(2, 1, sharex=True)
    time = responses["time"].to_numpy()
    for side, colour in zip(SIDES, (style.LEFT, style.RIGHT), strict=True):
        upper.plot(time, responses[f"u_{side}"].to_numpy(), color=colour, label=f"{side} eye")
        lower.plot(time, responses[f"feed_forward_{side}"].to_numpy(), color=colour)
    lower.axhline(float(params.suppression), color=style.QUIET, linestyle=":", label="T_f")
    upper.set(ylabel="u", ylim=(0.48, 1.02), title="response of the two LGMDs")
    lower.set(ylabel="FF [grey levels]", xlabel="time [s]")
    upper.legend(loc="upper left", ncols=2)
    lower.legend(loc="upper left")
    return figure


def _note_rate(film: video_io.Video) -> None:
    rate = float(film.rate)
    if not 0.8 < rate / TUNED_RATE < 1.25:
        print(f"note: {rate:.3g} frames a second; T_s and T_f are meant for the changes of 1/{TUNED_RATE} s")


def _progress(film: video_io.Video, width: int, height: int) -> tqdm:
    return tqdm(film.frames(width, height), total=film.count or None, unit="frame", desc="watch")


def _scaled(path: Path, film: video_io.Video, eyes: Eyes) -> tuple[int, int]:
    """The size to read the video at, so that an eye's picture is at most `eyes.width` wide."""
    if eyes.stereo and film.width % 2:
        raise InputError(
            f"expected an even width for two pictures side by side, got {film.width} px in {path}; "
            "crop the video, or watch it with --mono"
        )
    pictures = 2 if eyes.stereo else 1
    own = film.width // pictures
    width = min(eyes.width, own)
    height = round(film.height * width / own)
    if min(width, height) < SMALLEST:
        raise InputError(
            f"expected pictures of {SMALLEST} px or more either way, got {width} x {height} from {path}; "
            "raise --width, or give a larger video"
        )
    return pictures * width, height


def _split(picture: UInt8[np.ndarray, "height width"], eyes: Eyes) -> Float[np.ndarray, "2 height eye"]:
    """Cut one frame into what the two eyes look at."""
    both = np.split(picture, 2, axis=1) if eyes.stereo else [picture, picture]
    cut = [hemifield.hemifield(own, side, eyes.overlap) for side, own in enumerate(both)]
    return np.stack(cut).astype(jnp.result_type(float))


@jax.jit
def _open(params: lgmd.Params, pictures: Float[Array, "2 height eye"]) -> lgmd.State:
    return jax.vmap(partial(lgmd.init, params))(pictures)


@jax.jit
def _look(
    params: lgmd.Params, states: lgmd.State, pictures: Float[Array, "2 height eye"]
) -> tuple[lgmd.State, lgmd.Response, lgmd.Layers]:
    layers = jax.vmap(partial(lgmd.layers, params))(states, pictures)
    return *jax.vmap(partial(lgmd.step, params))(states, pictures), layers


def _look_at_all(
    frames: tqdm,
    sheet: lgmd_overlay.Sheet,
    target: Path,
    rate: Fraction,
    eyes: Eyes,
    params: lgmd.Params,
) -> tuple[list[lgmd_overlay.Moment], list[tuple[float, float]]]:
    """Run the detectors over the frames, drawing on the way; what they say of each, and their excitations."""
    course: list[lgmd_overlay.Moment] = []
    excitations: list[tuple[float, float]] = []
    with video_io.writing(target, *sheet.paper.size, rate) as write:
        for moment, excitation, pictures, layers in _responses(frames, eyes, params):
            course.append(moment)
            excitations.append(excitation)
            write(lgmd_overlay.draw(sheet, pictures, layers, float(params.threshold), course))
    return course, excitations


def _responses(
    frames: Iterable[video_io.Frame], eyes: Eyes, params: lgmd.Params
) -> Iterator[tuple[lgmd_overlay.Moment, tuple[float, float], np.ndarray, lgmd.Layers]]:
    """Show every frame to both eyes; the first one twice, so that nothing has changed in it."""
    states = None
    for frame in frames:
        pictures = _split(frame.picture, eyes)
        states = _open(params, jnp.asarray(pictures)) if states is None else states
        states, response, layers = _look(params, states, jnp.asarray(pictures))
        u, feed_forward, excitation = (
            _pair(value) for value in (response.u, response.feed_forward, response.excitation)
        )
        yield lgmd_overlay.Moment(frame.time, u, feed_forward), excitation, pictures, layers


def _pair(values: Array) -> tuple[float, float]:
    left, right = np.asarray(values).tolist()
    return left, right


def _table(
    course: list[lgmd_overlay.Moment], excitations: list[tuple[float, float]], metadata: dict[str, str]
) -> pa.Table:
    """Put the responses into columns, one row a frame."""
    columns: dict[str, object] = {"frame": range(len(course)), "time": [moment.time for moment in course]}
    for side, name in enumerate(SIDES):
        columns[f"u_{name}"] = [moment.u[side] for moment in course]
        columns[f"feed_forward_{name}"] = [moment.feed_forward[side] for moment in course]
        columns[f"excitation_{name}"] = [pair[side] for pair in excitations]
    return pa.table({name: pa.array(values) for name, values in columns.items()}, metadata=metadata)


def _metadata(path: Path, film: video_io.Video, eyes: Eyes, params: lgmd.Params) -> dict[str, str]:
    numbers = {name: float(getattr(params, name)) for name in ("threshold", "suppression", "inhibition")}
    facts = {"units": UNITS, "eyes": asdict(eyes), "lgmd": numbers, "rate": float(film.rate)}
    return {"video": path.name, "lgmdjax": __version__} | {key: json.dumps(fact) for key, fact in facts.items()}
