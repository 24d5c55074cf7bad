"""A film of one walk: the robot from outside, what both its eyes see, and u and v running below.

Everything is drawn again from recorded poses, without OpenGL: room and robot by `lgmdjax.reporting.third_person`, the
eyes' pictures by `lgmdjax.sensors.camera`, as the robot saw them. A recorded frame is 1/30 s; the film shows every
fifth of them, twelve a second, which is twice as fast as life.

Left is blue and right is orange, as in the report's figures. What an eye's LGMD does not look at, because its
hemifield ends there, is dimmed.
"""

import io
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy import ndarray
from PIL import Image
from scipy import ndimage

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.reporting import third_person, video_io
from lgmdjax.reporting.figures.style import FAINT, INK, LEFT, RIGHT, STYLE
from lgmdjax.sensors import camera
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.world import arena

RATE = 12  # pictures a second
STRIDE = round(2 * FRAME_RATE / RATE)  # recorded frames from one picture to the next: twice as fast as life
SIZE = (960, 600)  # px, width and height of the film
STAGE = (8, 28, 624, 390)  # px: left, top, width, height of the view from outside
EYES = ((640, 28, 312, 234), (640, 294, 312, 234))
CURVES = ((58, 444, 574, 50), (58, 520, 574, 50))
BEHIND, ABOVE, AHEAD = 0.88, 0.58, 0.20  # m, of the camera from the robot, and of the point that it looks at
DIMMED = 0.45
CHUNK = 12  # pictures drawn in one call: the memory of the machine, and what two threads share


class Walk(NamedTuple):
    """One recorded walk, a row a frame of 1/30 s."""

    time: Float[ndarray, " frames"]  # s
    position: Float[ndarray, "frames 3"]  # m
    quaternion: Float[ndarray, "frames 4"]
    joints: Float[ndarray, "frames 6 3"]  # rad
    u: Float[ndarray, "frames 2"]
    velocity: Float[ndarray, "frames 2"]  # multiples of 0.05 m/s
    contact: Bool[ndarray, " frames"]


class _Shots(NamedTuple):
    """What is needed to draw each picture."""

    time: Array
    eye: Array  # of the camera outside
    rotation: Array
    target: Array
    starts: Array  # the robot's capsules
    ends: Array
    positions: Array  # of the robot's own eyes
    rotations: Array


def write(
    target: Path | BinaryIO,
    walk: Walk,
    room: arena.Arena,
    eyes: camera.Params,
    seconds: float = 10.0,
    overlap: float = 1.0,
) -> int:
    """Draw the liveliest stretch of a walk, `seconds` of film, into an MP4 file; give its number of pictures.

    Args:
        target: the file, or something to write bytes to.
        walk: what the robot did. room: where.
        eyes: camera parameters for the robot's own pictures, which are drawn in full width.
        seconds: length of the film; it is shorter if the walk is.
        overlap: part of the picture's width that each LGMD looks at, for the dimming.
    """
    _check(walk)
    chosen = choose(walk, round(seconds * RATE) * STRIDE)
    shots, body = _shots(walk, chosen[::STRIDE])
    paper = _Paper(walk, chosen, (eyes.width, eyes.height))
    with video_io.writing(target, *SIZE, RATE) as show:
        for index, (stage, views) in enumerate(_draw(shots, body, room, eyes)):
            show(paper.picture(stage, views, chosen[index * STRIDE], overlap))
    return len(shots.time)


def choose(walk: Walk, frames: int) -> ndarray:
    """Choose the frames, one after another, with the hardest steering, if possible without a set-back."""
    total = len(walk.time)
    frames = min(max(frames, 1), total)
    steering = np.abs(walk.velocity[:, 1] - walk.velocity[:, 0])
    jumps = np.concatenate([[0.0], jumped(walk.position).astype(float)])
    sums = np.concatenate([[0.0], np.cumsum(steering - 1e6 * jumps)])
    # Starts half a second apart are choice enough.
    starts = np.arange(0, total - frames + 1, 15)
    first = starts[np.argmax(sums[starts + frames] - sums[starts])]
    return np.arange(first, first + frames)


def jumped(position: Float[ndarray, "frames 3"]) -> Bool[ndarray, " steps"]:
    """Tell between which frames the robot was set back: it cannot walk 5 cm in 1/30 s."""
    return np.linalg.norm(np.diff(position, axis=0), axis=1) > 0.05


def _check(walk: Walk) -> None:
    frames = len(walk.time)
    widths = {"position": (3,), "quaternion": (4,), "joints": (6, 3), "u": (2,), "velocity": (2,)}
    for name, series in walk._asdict().items():
        shape = (frames, *widths.get(name, ()))
        if np.shape(series) != shape or not np.all(np.isfinite(series)) or not frames:
            raise InputError(
                f"expected a walk with finite {name} of shape {shape}, got {np.shape(series)}; "
                "delete the run's evaluate folder and run `lgmdjax evaluate`"
            )


def _shots(walk: Walk, rows: ndarray) -> tuple[_Shots, third_person.Body]:
    """Work out where cameras, eyes and limbs are in the chosen frames."""
    position, heading = _smooth(walk)
    forward = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=-1)[rows]
    target = position[rows]
    eye = target - BEHIND * forward + np.array([0, 0, ABOVE])
    starts, ends, positions, rotations, radii, colours = bodies(poses(walk, rows))
    single = partial(jnp.asarray, dtype=jnp.float32)
    shots = _Shots(
        *map(
            single,
            (
                walk.time[rows],
                eye,
                looking(eye, target + AHEAD * forward),
                target,
                starts,
                ends,
                positions,
                rotations,
            ),
        )
    )
    return shots, third_person.Body(shots.starts[0], shots.ends[0], single(radii), single(colours))


def _smooth(walk: Walk) -> tuple[Float[ndarray, "frames 3"], Float[ndarray, " frames"]]:
    """Average positions over a second and headings over two, for a steady camera; not across a set-back."""
    w, x, y, z = walk.quaternion.T
    heading = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    position, cuts = walk.position.copy(), np.flatnonzero(jumped(walk.position)) + 1
    for piece in np.split(np.arange(len(heading)), cuts):
        position[piece] = ndimage.uniform_filter1d(walk.position[piece], 31, axis=0, mode="nearest")
        heading[piece] = ndimage.gaussian_filter1d(heading[piece], 20, mode="nearest")
    return position, heading


def looking(eye: Float[ndarray, "n 3"], at: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
    """Turn cameras so that x looks from `eye` at `at` and y is level to the left."""
    forward = (at - eye) / np.linalg.norm(at - eye, axis=-1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left, axis=-1, keepdims=True)
    return np.stack([forward, left, np.cross(forward, left)], axis=-1)


def poses(walk: Walk, rows: ndarray) -> Float[ndarray, "n 25"]:
    """Put the chosen frames of a walk into the model's coordinates (qpos)."""
    joints = walk.joints[rows].reshape(len(rows), -1)
    return np.concatenate([walk.position[rows], walk.quaternion[rows], joints], axis=1)


def bodies(qpos: Float[ndarray, "n 25"]) -> tuple[ndarray, ...]:
    """Find the robot's visible capsules and its eyes in so many poses, by C MuJoCo's kinematics.

    Returns:
        The capsules' two ends (n, k, 3), the eyes' positions (n, 2, 3) and rotations (n, 2, 3, 3); the same
        for all poses, the radii (k,) and colours (k, 3).
    """
    model = hexapod.load()
    data = mujoco.MjData(model)
    seen = np.flatnonzero(model.geom_group == 2)
    sites = [model.site(name).id for name in hexapod.EYES]
    half_length = np.where(model.geom_type[seen] == mujoco.mjtGeom.mjGEOM_CAPSULE, model.geom_size[seen, 1], 0.0)
    found = []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        reach = data.geom_xmat[seen].reshape(-1, 3, 3)[..., 2] * half_length[:, None]
        centres, turned = data.geom_xpos[seen], data.site_xmat[sites].reshape(2, 3, 3)
        found.append((centres - reach, centres + reach, data.site_xpos[sites].copy(), turned.copy()))
    colours = model.mat_rgba[model.geom_matid[seen], :3]
    return (*map(np.stack, zip(*found, strict=True)), model.geom_size[seen, 0], colours)


def _draw(
    shots: _Shots, body: third_person.Body, room: arena.Arena, eyes: camera.Params
) -> Iterator[tuple[ndarray, ndarray]]:
    """Draw the shots in chunks of one size, two chunks at a time; the last is filled up and cut."""
    count = len(shots.time)
    draw = _drawer(third_person.Params(), eyes.replace(overlap=1.0))  # pyright: ignore[reportAttributeAccessIssue]
    room = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), room)

    def chunk(first: int) -> tuple[ndarray, ndarray]:
        rows = np.minimum(np.arange(first, first + CHUNK), count - 1)
        stage, views = draw(jax.tree.map(lambda leaf: leaf[rows], shots), body, room)
        return np.asarray(stage)[: count - first], np.asarray(views)[: count - first]

    with ThreadPoolExecutor(2) as pool:
        for stage, views in pool.map(chunk, range(0, count, CHUNK)):
            yield from zip(stage, views, strict=True)


def _drawer(view: third_person.Params, eyes: camera.Params):
    """Compile the drawing of a chunk: pictures from outside (n, h, w, 3) and of both eyes (n, 2, h, w)."""

    def one(body: third_person.Body, room: arena.Arena, shot: _Shots) -> tuple[Array, Array]:
        scene = arena.at(room, shot.time)
        robot = body._replace(starts=shot.starts, ends=shot.ends)
        stage = third_person.picture(view, scene, shot.eye, shot.rotation, robot, shot.target)
        views = camera.render(eyes, scene, shot.positions, shot.rotations)
        return (255 * stage).astype(jnp.uint8), jnp.clip(views, 0, 255).astype(jnp.uint8)

    return jax.jit(lambda shots, body, room: jax.lax.map(partial(one, body, room), shots))


class _Paper:
    """The film's page: drawn once by matplotlib, with and without its curves, then only cut and pasted."""

    def __init__(self, walk: Walk, chosen: ndarray, pixels: tuple[int, int]) -> None:
        time = walk.time[chosen]
        self.contact = ndimage.maximum_filter1d(walk.contact.astype(float), 2 * STRIDE) > 0
        series = walk.u[chosen], walk.velocity[chosen]
        self.blank, _ = _page(time, series, pixels, curves=False)
        self.full, columns = _page(time, series, pixels, curves=True)
        self.column = dict(zip(chosen.tolist(), np.round(columns).astype(int).tolist(), strict=True))

    def picture(
        self,
        stage: UInt8[ndarray, "h w 3"],
        views: UInt8[ndarray, "2 rows columns"],
        frame: int,
        overlap: float,
    ) -> UInt8[ndarray, "height width 3"]:
        """Put one picture of the film together."""
        page, now, top = self.blank.copy(), self.column[frame], CURVES[0][1] - 8
        page[top:, :now] = self.full[top:, :now]
        bottom = CURVES[1][1] + CURVES[1][3]
        page[CURVES[0][1] : bottom, now - 1 : now + 1] = _rgb(INK)
        _paste(page, stage, STAGE, "#c1121f" if self.contact[frame] else None)
        for side, (view, place, colour) in enumerate(zip(views, EYES, (LEFT, RIGHT), strict=True)):
            lit = np.arange(view.shape[1]) < overlap * view.shape[1]
            lit = lit if side == 0 else lit[::-1]
            shown = (view * np.where(lit, 1.0, DIMMED)).astype(np.uint8)
            _paste(page, np.repeat(shown[..., None], 3, axis=-1), place, colour)
        return page


def _page(
    time: ndarray, series: tuple[ndarray, ndarray], pixels: tuple[int, int], *, curves: bool
) -> tuple[UInt8[ndarray, "h w 3"], ndarray]:
    """Draw titles, axes and, if wanted, the curves of u and v; give the page and the column of each time."""
    with matplotlib.rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(SIZE[0] / 100, SIZE[1] / 100), dpi=100)
        size = f"{pixels[0]} × {pixels[1]} pixels"
        for place, title in (
            (STAGE, "the robot from outside, at twice its speed"),
            (EYES[0], f"left eye, {size}"),
            (EYES[1], f"right eye, {size}"),
        ):
            _write(figure, place[0], place[1] - 7, title)
        for index, line in enumerate(("Dimmed: not in the hemifield of this", "eye's collision detector.")):
            _write(figure, EYES[1][0], 552 + 18 * index, line, color="#555555")
        axes = [figure.add_axes(_fraction(place)) for place in CURVES]
        # u seldom leaves the lower part of its range; the axis goes as far as it does.
        top = max(0.6, 0.5 + 1.1 * (float(series[0].max()) - 0.5))
        axes[0].set(ylim=(0.5 - 0.05 * (top - 0.5), top), title="LGMD outputs u", xticklabels=[])
        axes[1].set(ylim=(-1.15, 2.15), yticks=(-1, 0, 1, 2))
        axes[1].set_title("commanded velocities v [0.05 m/s], over time [s]")
        for panel, both in zip(axes, series, strict=True):
            panel.set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1)
            panel.spines[:].set_color(FAINT)
            panel.title.set_fontsize(8.5)
            for side, colour in enumerate((LEFT, RIGHT) if curves else ()):
                panel.plot(time, both[:, side], color=colour, linewidth=1.3)
        axes[0].locator_params(axis="y", nbins=3)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=100, facecolor="white")
        columns = axes[0].transData.transform(np.stack([time, 0 * time], axis=-1))[:, 0]
    return np.asarray(Image.open(buffer).convert("RGB")).copy(), columns


def _write(figure: Figure, x: int, y: int, text: str, **style) -> None:
    figure.text(x / SIZE[0], 1 - y / SIZE[1], text, va="baseline", fontsize=9.5, **style)


def _fraction(place: tuple[int, int, int, int]) -> tuple[float, float, float, float]:
    x, y, width, height = place
    return x / SIZE[0], 1 - (y + height) / SIZE[1], width / SIZE[0], height / SIZE[1]


def _paste(page: ndarray, picture: ndarray, place: tuple[int, int, int, int], frame: str | None) -> None:
    """Put a picture in its place, scaled to fit, with a coloured frame around it if wanted."""
    x, y, width, height = place
    if frame:
        page[y - 3 : y + height + 3, x - 3 : x + width + 3] = _rgb(frame)
    page[y : y + height, x : x + width] = np.asarray(
        Image.fromarray(picture).resize((width, height), Image.Resampling.BICUBIC)
    )


def _rgb(colour: str) -> ndarray:
    return (255 * np.array(to_rgb(colour))).astype(np.uint8)
