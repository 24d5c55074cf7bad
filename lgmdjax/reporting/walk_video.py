"""Video of one recorded walk: third-person view of the robot, the images of both its eyes, and curves of u and v.

All images are rendered from recorded poses, without OpenGL: room and robot by `lgmdjax.reporting.third_person`, the
eyes' images by `lgmdjax.sensors.camera`, as the robot saw them. A recorded frame is 1/30 s. The video shows every fifth
frame at twelve images a second, which is twice real speed.

Left is blue and right is orange, as in the report's figures. Parts of an eye's image outside the hemifield of its LGMD
are dimmed.
"""

import io
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy import ndarray
from PIL import Image
from scipy import ndimage

from lgmdjax import geometry
from lgmdjax.body.robot_xml import Body
from lgmdjax.errors import InputError
from lgmdjax.reporting import robot_shape, selection, third_person, video_io
from lgmdjax.reporting.figures.style import DARK, LEFT_COLOUR, LIGHT_GREY, RED, RIGHT_COLOUR, STYLE
from lgmdjax.reporting.third_person import RobotCapsules, Viewpoint
from lgmdjax.sensors import camera, hemifield
from lgmdjax.simulation import assembly, closed_loop
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record, Room
from lgmdjax.world import arena

VIDEO_RATE = 12  # images per second
FRAME_STRIDE = round(2 * FRAME_RATE / VIDEO_RATE)  # recorded frames per image: twice real speed
VIDEO_SIZE = (960, 600)  # px, width and height
VIEW_BOX = (8, 28, 624, 390)  # px: left, top, width, height of the third-person view
EYE_BOXES = ((640, 28, 312, 234), (640, 294, 312, 234))  # px, of the left and the right eye's image
CURVE_BOXES = ((58, 444, 574, 50), (58, 520, 574, 50))  # px, of the curves of u and v
CAMERA_BEHIND, CAMERA_ABOVE = 0.88, 0.58  # m, position of the third-person camera relative to the robot
LOOK_AHEAD = 0.20  # m, the camera looks at a point this far ahead of the robot
DIMMING = 0.45  # brightness outside the hemifield
IMAGES_PER_CALL = 12  # rendered in one call, which limits memory; two threads share the calls
Box = tuple[int, int, int, int]  # px: left, top, width, height


class WalkTrace(NamedTuple):
    """Time series of one recorded walk, one row per frame of 1/30 s; the names are those of `Record`."""

    time: Float[ndarray, " frames"]  # s
    position: Float[ndarray, "frames 3"]  # m
    quaternion: Float[ndarray, "frames 4"]
    joints: Float[ndarray, "frames 6 3"]  # rad
    u: Float[ndarray, "frames 2"]
    velocity: Float[ndarray, "frames 2"]  # multiples of 0.05 m/s
    contact: Bool[ndarray, " frames"]


class _Views(NamedTuple):
    """Camera, robot and eyes of each image to render."""

    time: Array
    camera_position: Array  # of the third-person camera
    camera_rotation: Array
    target: Array
    starts: Array  # of the robot's capsules
    ends: Array
    eye_positions: Array
    eye_rotations: Array
    room: arena.Arena


def write_video(
    path: Path | str,
    record: Record,
    room: Room | arena.Arena,
    robot: closed_loop.Params | None = None,
    *,
    index: int | None = None,
    seconds: float = 10.0,
) -> Path:
    """Write an MP4 video of one walk of a record and return its path.

    The video shows the part of the walk that `selection.select_segment` selects.

    Args:
        path: of the video file.
        record: recorded walks, axes (robot, frame), or one walk, axis (frame,).
        room: the rooms of the walks (`lgmdjax.rollout`), or a single room for all of them.
        robot: the robot that walked, whose camera renders the eyes' images; the pretrained robot by default.
        index: number of the robot to show; by default that of `selection.select_walk`.
        seconds: duration of the video, at twice real speed; it is shorter if the walk is.

    ```python
    import jax
    import lgmdjax as lj

    rooms = lj.random_rooms(jax.random.key(0), 4)
    record = lj.rollout(lj.load_robot(), rooms, seconds=30)
    lj.write_video("walk.mp4", record, rooms)
    ```
    """
    robot = robot or assembly.load_robot()
    write_trace(Path(path), *choose_trace(record, room, robot, index), seconds, body=robot.body)
    return Path(path)


def choose_trace(
    record: Record, room: Room | arena.Arena, robot: closed_loop.Params, index: int | None = None
) -> tuple[WalkTrace, arena.Arena, camera.Params]:
    """Return the walk that `write_video` shows, its room, and the camera of the eyes; arguments as there."""
    walk, scene = selection.choose_walk(record, room, index)
    trace = WalkTrace(*(getattr(walk, name) for name in WalkTrace._fields))
    return trace, scene, robot.camera


def write_trace(
    target: Path | BinaryIO,
    trace: WalkTrace,
    room: arena.Arena,
    eyes: camera.Params,
    seconds: float = 10.0,
    *,
    body: Body | None = None,
) -> int:
    """Write an MP4 video of a segment of a walk (`selection.select_segment`); return the number of images.

    Args:
        target: path of the file, or a binary stream.
        trace: the walk.
        room: the room of the walk, or a batch with the room of each frame.
        eyes: camera of the eyes. Images are rendered in full width, and dimmed where the LGMDs do not see them.
        seconds: duration of the video; it is shorter if the walk is.
        body: of the robot that walked; the package's if None.
    """
    _check(trace)
    frames = selection.select_segment(trace.position, trace.velocity, round(seconds * VIDEO_RATE) * FRAME_STRIDE)
    views, robot = _views(trace, room, frames[::FRAME_STRIDE], body)
    page = _Page(trace, frames, (eyes.width, eyes.height))
    with video_io.open_writer(target, *VIDEO_SIZE, VIDEO_RATE) as write:
        for index, (view, eye_images) in enumerate(_render(views, robot, eyes)):
            write(page.compose(view, eye_images, frames[index * FRAME_STRIDE], eyes))
    return len(views.time)


def _check(trace: WalkTrace) -> None:
    frames = len(trace.time)
    widths = {"position": (3,), "quaternion": (4,), "joints": (6, 3), "u": (2,), "velocity": (2,)}
    for name, series in trace._asdict().items():
        shape = (frames, *widths.get(name, ()))
        if np.shape(series) != shape or not np.all(np.isfinite(series)) or not frames:
            raise InputError(
                f"expected a walk with finite {name} of shape {shape}, got {np.shape(series)}; choose another walk, or "
                "delete the run's evaluate folder and run `lgmdjax evaluate`"
            )


def _views(
    trace: WalkTrace, room: arena.Arena, rows: Int[ndarray, " n"], of: Body | None = None
) -> tuple[_Views, RobotCapsules]:
    """Compute the poses of cameras, eyes and limbs in the chosen frames, and their rooms.

    The camera is farther from a robot of one's own that is larger than the package's.
    """
    body = robot_shape.body_geometry(to_qpos(trace, rows), of)
    far = robot_shape.size_ratio(of)
    position, heading = _smooth(trace)
    forward = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=-1)[rows]
    target = position[rows]
    camera_position = target + far * (np.array([0, 0, CAMERA_ABOVE]) - CAMERA_BEHIND * forward)
    to_single = partial(jnp.asarray, dtype=jnp.float32)
    views = _Views(
        time=to_single(trace.time[rows]),
        camera_position=to_single(camera_position),
        camera_rotation=to_single(look_at(camera_position, target + LOOK_AHEAD * forward)),
        target=to_single(target),
        starts=to_single(body.starts),
        ends=to_single(body.ends),
        eye_positions=to_single(body.eye_positions),
        eye_rotations=to_single(body.eye_rotations),
        room=_rooms(room, rows),
    )
    return views, RobotCapsules(views.starts[0], views.ends[0], to_single(body.radii), to_single(body.colours))


def _rooms(room: arena.Arena, rows: Int[ndarray, " n"]) -> arena.Arena:
    """Return the room of each of the chosen frames, in single precision."""
    if np.ndim(room.bounds) == 1:
        rows, room = np.zeros_like(rows), jax.tree.map(lambda leaf: np.asarray(leaf)[None], room)
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[rows], jnp.float32), room)


def _smooth(trace: WalkTrace) -> tuple[Float[ndarray, "frames 3"], Float[ndarray, " frames"]]:
    """Smooth positions over a second and headings over two, but not across a reset, for a steady camera."""
    heading = np.unwrap(geometry.yaw(trace.quaternion))
    position, starts = trace.position.copy(), np.flatnonzero(selection.detect_resets(trace.position)) + 1
    for segment in np.split(np.arange(len(heading)), starts):
        position[segment] = ndimage.uniform_filter1d(trace.position[segment], 31, axis=0, mode="nearest")
        heading[segment] = ndimage.gaussian_filter1d(heading[segment], 20, mode="nearest")
    return position, heading


def look_at(eye: Float[ndarray, "n 3"], at: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
    """Return camera rotations with x from `eye` towards `at` and y level to the left."""
    forward = (at - eye) / np.linalg.norm(at - eye, axis=-1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left, axis=-1, keepdims=True)
    return np.stack([forward, left, np.cross(forward, left)], axis=-1)


def to_qpos(trace: WalkTrace, rows: Int[ndarray, " n"]) -> Float[ndarray, "n 25"]:
    """Return the chosen frames of a walk in MuJoCo's coordinates (qpos)."""
    joints = trace.joints[rows].reshape(len(rows), -1)
    return np.concatenate([trace.position[rows], trace.quaternion[rows], joints], axis=1)


def _render(
    views: _Views, robot: RobotCapsules, eyes: camera.Params
) -> Iterator[tuple[UInt8[ndarray, "height width 3"], UInt8[ndarray, "2 rows columns"]]]:
    """Render the views in chunks of one size, two at a time; the last chunk is padded."""
    count = len(views.time)
    params, whole = third_person.Params(), replace(eyes, overlap=1.0, ground=0.0)

    def render_chunk(first: int) -> tuple[ndarray, ndarray]:
        rows = np.minimum(np.arange(first, first + IMAGES_PER_CALL), count - 1)
        view, eye_images = _render_views(jax.tree.map(lambda leaf: leaf[rows], views), robot, params=params, eyes=whole)
        return np.asarray(view)[: count - first], np.asarray(eye_images)[: count - first]

    with ThreadPoolExecutor(2) as pool:
        for view, eye_images in pool.map(render_chunk, range(0, count, IMAGES_PER_CALL)):
            yield from zip(view, eye_images, strict=True)


@partial(jax.jit, static_argnames=("params", "eyes"))
def _render_views(
    views: _Views, robot: RobotCapsules, *, params: third_person.Params, eyes: camera.Params
) -> tuple[UInt8[Array, "n h w 3"], UInt8[Array, "n 2 rows columns"]]:
    """Render a chunk: third-person images, and images of both eyes. All videos share one program."""

    def render(view: _Views) -> tuple[Array, Array]:
        scene = arena.at_time(view.room, view.time)
        posed = robot._replace(starts=view.starts, ends=view.ends)
        viewpoint = Viewpoint(view.camera_position, view.camera_rotation)
        image = third_person.render_view(params, scene, viewpoint, posed, view.target)
        eye_images = camera.render(eyes, scene, view.eye_positions, view.eye_rotations)
        return (255 * image).astype(jnp.uint8), jnp.clip(eye_images, 0, 255).astype(jnp.uint8)

    return jax.lax.map(render, views)


class _Page:
    """The page of the video: plotted once with and once without its curves, then composed with each image."""

    def __init__(self, trace: WalkTrace, frames: Int[ndarray, " n"], eye_size: tuple[int, int]) -> None:
        time = trace.time[frames]
        self.contact = ndimage.maximum_filter1d(trace.contact.astype(float), 2 * FRAME_STRIDE) > 0
        series = trace.u[frames], trace.velocity[frames]
        self.blank, _ = _plot_page(time, series, eye_size, curves=False)
        self.full, columns = _plot_page(time, series, eye_size, curves=True)
        self.column = dict(zip(frames.tolist(), np.round(columns).astype(int).tolist(), strict=True))

    def compose(
        self,
        view: UInt8[ndarray, "h w 3"],
        eye_images: UInt8[ndarray, "2 rows columns"],
        frame: int,
        eyes: camera.Params,
    ) -> UInt8[ndarray, "height width 3"]:
        """Compose one image of the video: views, and curves up to the frame; red border around a contact."""
        page, now, top = self.blank.copy(), self.column[frame], CURVE_BOXES[0][1] - 8
        page[top:, :now] = self.full[top:, :now]
        bottom = CURVE_BOXES[1][1] + CURVE_BOXES[1][3]
        page[CURVE_BOXES[0][1] : bottom, now - 1 : now + 1] = _rgb(DARK)
        _paste(page, view, VIEW_BOX, RED if self.contact[frame] else None)
        for side, (image, box, colour) in enumerate(
            zip(eye_images, EYE_BOXES, (LEFT_COLOUR, RIGHT_COLOUR), strict=True)
        ):
            field = {"overlap": eyes.overlap, "ground": eyes.ground}
            dimmed = (DIMMING * image).astype(np.uint8)
            hemifield.crop(dimmed, side, **field)[:] = hemifield.crop(image, side, **field)
            _paste(page, np.repeat(dimmed[..., None], 3, axis=-1), box, colour)
        return page


def _plot_page(
    time: ndarray, series: tuple[ndarray, ndarray], eye_size: tuple[int, int], *, curves: bool
) -> tuple[UInt8[ndarray, "h w 3"], ndarray]:
    """Plot titles, axes and optionally the curves of u and v; return the page and the column [px] of each time."""
    with matplotlib.rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(VIDEO_SIZE[0] / 100, VIDEO_SIZE[1] / 100), dpi=100)
        _add_titles(figure, f"{eye_size[0]} × {eye_size[1]} pixels")
        axes = [figure.add_axes(_fraction(box)) for box in CURVE_BOXES]
        # u is mostly in the lower part of its range; the axis ends at its maximum.
        top = max(0.6, 0.5 + 1.1 * (float(series[0].max()) - 0.5))
        axes[0].set(ylim=(0.5 - 0.05 * (top - 0.5), top), title="LGMD outputs u", xticklabels=[])
        axes[1].set(ylim=(-1.15, 2.15), yticks=(-1, 0, 1, 2))
        axes[1].set_title("commanded velocities v [0.05 m/s], over time [s]")
        for panel, both in zip(axes, series, strict=True):
            panel.set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1)
            panel.spines[:].set_color(LIGHT_GREY)
            panel.title.set_fontsize(8.5)
            for side, colour in enumerate((LEFT_COLOUR, RIGHT_COLOUR) if curves else ()):
                panel.plot(time, both[:, side], color=colour, linewidth=1.3)
        axes[0].locator_params(axis="y", nbins=3)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=100, facecolor="white")
        columns = axes[0].transData.transform(np.stack([time, 0 * time], axis=-1))[:, 0]
    return np.asarray(Image.open(buffer).convert("RGB")).copy(), columns


def _add_titles(figure: Figure, eye_size: str) -> None:
    titles = "third-person view, at twice real speed", f"left eye, {eye_size}", f"right eye, {eye_size}"
    for box, title in zip((VIEW_BOX, *EYE_BOXES), titles, strict=True):
        _add_text(figure, box[0], box[1] - 7, title)
    for index, line in enumerate(("Dimmed: outside the hemifield of this", "eye's collision detector.")):
        _add_text(figure, EYE_BOXES[1][0], 552 + 18 * index, line, color="#555555")


def _add_text(figure: Figure, x: int, y: int, text: str, *, color: str = DARK) -> None:
    figure.text(x / VIDEO_SIZE[0], 1 - y / VIDEO_SIZE[1], text, va="baseline", fontsize=9.5, color=color)


def _fraction(box: Box) -> tuple[float, float, float, float]:
    """Convert a box in pixels into matplotlib's fractions of the figure."""
    x, y, width, height = box
    return x / VIDEO_SIZE[0], 1 - (y + height) / VIDEO_SIZE[1], width / VIDEO_SIZE[0], height / VIDEO_SIZE[1]


def _paste(page: ndarray, image: ndarray, box: Box, border: str | None) -> None:
    """Paste an image into its box, scaled to fit, optionally with a coloured border."""
    x, y, width, height = box
    if border:
        page[y - 3 : y + height + 3, x - 3 : x + width + 3] = _rgb(border)
    page[y : y + height, x : x + width] = np.asarray(
        Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC)
    )


def _rgb(colour: str) -> ndarray:
    return (255 * np.array(to_rgb(colour))).astype(np.uint8)
