"""The video of a walk and the third-person view: positions of robot and eyes, visibility, and the file."""

import base64
import io
import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from walker import DATA

from lgmdjax.body import custom_robot, robot_xml
from lgmdjax.errors import InputError
from lgmdjax.reporting import inline_video, robot_shape, third_person, walk_video
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly
from lgmdjax.simulation.closed_loop import Room
from lgmdjax.world import arena

EYES = camera.Params(width=80, height=60, overlap=0.6)
SMALL = third_person.Params(width=160, height=100, focal=125.0, robot_rows=(30, 100), robot_columns=(38, 122))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> walk_video.WalkTrace:
    run = synthetic.write_run(tmp_path_factory.mktemp("runs") / "made-up", frames=300, pixels=(60, 80))
    recorded = np.load(run / "evaluate/walk.npz")
    return walk_video.WalkTrace(*(recorded[name] for name in walk_video.WalkTrace._fields))


@pytest.fixture(scope="module")
def decoded(walk: walk_video.WalkTrace) -> tuple[list[np.ndarray], float]:
    """Images of a video of one second, and its rate."""
    buffer = io.BytesIO()
    assert walk_video.write_trace(buffer, walk, synthetic.room(), EYES, seconds=1.0) == 12
    buffer.seek(0)
    with av.open(buffer, "r") as container:
        stream = container.streams.video[0]
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)], float(stream.average_rate or 0)


def test_the_video_has_the_right_number_size_and_rate_of_images(decoded: tuple[list[np.ndarray], float]):
    images, rate = decoded
    assert len(images) == 12
    assert {image.shape for image in images} == {(600, 960, 3)}
    assert rate == pytest.approx(12)


def test_another_video_is_rendered_by_the_same_program(
    decoded: tuple[list[np.ndarray], float], walk: walk_video.WalkTrace
):
    """Else each video of a process would be compiled anew, and take memory for good."""
    program: Any = walk_video._render_views
    before = program._cache_size()
    assert walk_video.write_trace(io.BytesIO(), walk, synthetic.room(), EYES, seconds=0.25) == 3
    assert program._cache_size() == before > 0


def test_curves_grow_during_the_video(decoded: tuple[list[np.ndarray], float]):
    def coloured_pixels(image: np.ndarray) -> int:
        """Count the coloured pixels of the curves."""
        x, y, width, _ = walk_video.CURVE_BOXES[0]
        curves = image[y : walk_video.CURVE_BOXES[1][1] + walk_video.CURVE_BOXES[1][3], x : x + width].astype(int)
        return int(np.sum(np.ptp(curves, axis=-1) > 60))

    counts = [coloured_pixels(image) for image in decoded[0]]
    assert counts[0] < 0.1 * counts[-1]
    assert np.mean(np.diff(counts) >= 0) > 0.8


def test_the_robot_moves_in_the_video(decoded: tuple[list[np.ndarray], float]):
    x, y, width, height = walk_video.VIEW_BOX
    views = [image[y : y + height, x : x + width].astype(int) for image in decoded[0]]
    assert all(np.abs(a - b).max() > 60 for a, b in pairwise(views))


def test_the_image_is_dimmed_outside_the_hemifield(walk: walk_video.WalkTrace):
    white = np.full((2, 60, 80), 250, np.uint8)
    page = walk_video._Page(walk, np.arange(60), (80, 60)).compose(np.zeros((100, 160, 3), np.uint8), white, 0, EYES)
    for (x, y, width, _), first, last in zip(walk_video.EYE_BOXES, (0.0, 0.4), (0.6, 1.0), strict=True):
        row, across = page[y + 50, x : x + width, 0], np.arange(width) / width
        assert np.all(row[(across > first + 0.03) & (across < last - 0.03)] == 250)
        np.testing.assert_allclose(
            row[(across < first - 0.03) | (across > last + 0.03)], 250 * walk_video.DIMMING, atol=1
        )


def test_eyes_are_fixed_to_the_trunk(walk: walk_video.WalkTrace):
    body = robot_shape.body_geometry(walk_video.to_qpos(walk, np.array([0, 150])))
    for row, position, rotation in zip((0, 150), body.eye_positions, body.eye_rotations, strict=True):
        yaw = 2 * np.arctan2(walk.quaternion[row, 3], walk.quaternion[row, 0])
        forward, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        np.testing.assert_allclose(position[0] - position[1], 0.065 * left, atol=1e-9)
        np.testing.assert_allclose(rotation[0], np.stack([forward, left, [0, 0, 1]], axis=-1), atol=1e-9)
        assert (position[0] - walk.position[row]) @ forward > 0.1


@pytest.mark.parametrize("own", [False, True])
def test_the_robot_is_always_in_its_window_of_the_image(walk: walk_video.WalkTrace, own: bool):
    body = custom_robot.read(DATA / "walker.toml").body if own else None
    rise = robot_xml.compiled(body).key("stance").qpos[2] - robot_xml.compiled().key("stance").qpos[2]
    higher = walk._replace(position=walk.position + np.array([0.0, 0.0, rise]))
    views, robot = walk_video._views(higher, synthetic.room(), np.arange(0, 300, 10), body)
    params = third_person.Params()
    ends = jnp.concatenate([views.starts, views.ends], 1)
    for position, rotation, points in zip(views.camera_position, views.camera_rotation, ends, strict=True):
        local = (points - position) @ rotation
        column = params.width / 2 - params.focal * local[:, 1] / local[:, 0]
        row = params.height / 2 - params.focal * local[:, 2] / local[:, 0]
        radius = params.focal * float(robot.radii.max()) / float(local[:, 0].min())
        first, last = params.robot_columns
        assert first <= float(column.min()) - radius and float(column.max()) + radius <= last
        first, last = params.robot_rows
        assert first <= float(row.min()) - radius and float(row.max()) + radius <= last


@pytest.fixture(scope="module")
def render_ball() -> Callable[..., np.ndarray]:
    """Return a function that renders a red ball at (0, 0, 0.1) in a room, from 0.9 m behind and 0.5 m above."""
    ball = third_person.RobotCapsules(
        starts=jnp.array([[0.0, 0.0, 0.1]]),
        ends=jnp.array([[0.0, 0.0, 0.1]]),
        radii=jnp.array([0.06]),
        colours=jnp.array([[1.0, 0.0, 0.0]]),
    )
    position, target = np.array([[-0.9, 0.0, 0.6]]), np.array([[0.0, 0.0, 0.1]])
    rotation = jnp.asarray(walk_video.look_at(position, target)[0])
    viewpoint = third_person.Viewpoint(jnp.asarray(position[0]), rotation)
    render_view = jax.jit(partial(third_person.render_view, SMALL))

    def render(room: arena.Arena, shift: float = 0.0) -> np.ndarray:
        robot = ball._replace(starts=ball.starts + jnp.array([shift, 0, 0]), ends=ball.ends + jnp.array([shift, 0, 0]))
        return np.asarray(render_view(room, viewpoint, robot, jnp.asarray(target[0])))

    return render


def is_red(image: np.ndarray) -> np.ndarray:
    return image[..., 0] > 2 * np.maximum(image[..., 1], image[..., 2])


def test_a_ball_is_rendered_as_a_disc_in_the_middle_lit_from_above(render_ball: Callable[..., np.ndarray]):
    picture = render_ball(arena.empty_room())
    rows, columns = np.nonzero(is_red(picture))
    assert (rows.mean(), columns.mean()) == pytest.approx((49.5, 79.5), abs=2)
    # The ball subtends asin(0.06 / 1.03), which times the focal length is a radius of 7.3 px.
    assert len(rows) == pytest.approx(np.pi * 7.3**2, rel=0.12)
    assert picture[rows.min() + 2, 80, 0] > 1.3 * picture[rows.max() - 2, 80, 0]


def test_a_ball_casts_a_shadow_on_the_floor(render_ball: Callable[..., np.ndarray]):
    room = arena.empty_room(floor_texture=(150.0, 0.0, 0.0, 0.5))
    near, far = render_ball(room), render_ball(room, shift=5.0)
    darker = (far - near).mean(axis=-1) * ~is_red(near)
    rows, columns = np.nonzero(darker > 0.02)
    assert len(rows) > 20
    assert columns.mean() == pytest.approx(79.5, abs=2)
    assert rows.mean() > 50, "the floor below the ball is lower in the image"


def test_a_box_in_front_becomes_transparent_and_a_box_behind_does_not(render_ball: Callable[..., np.ndarray]):
    empty = render_ball(arena.empty_room())
    front = render_ball(arena.empty_room(boxes=arena.make_prisms([[-0.4, 0.0]], [[0.05, 0.4]], 0.9)))
    behind = render_ball(arena.empty_room(boxes=arena.make_prisms([[0.3, 0.0]], [[0.05, 0.4]], 0.9)))
    assert np.sum(is_red(front)) > 0.9 * np.sum(is_red(empty))
    assert np.abs(front - empty)[45:55, 60:100].mean() > 0.02, "the transparent box is visible"
    assert np.median(np.abs(behind - empty)[is_red(empty)]) < 1e-6, "the ball hides the box behind it"
    assert np.abs(behind - empty).max() > 0.1


def test_surfaces_are_shaded_by_their_orientation(render_ball: Callable[..., np.ndarray]):
    """The top of a plain grey box, which faces the light, is brighter than the face towards the camera."""
    plain = (128.0, 0.0, 0.0, 0.5)
    picture = render_ball(
        arena.empty_room(boxes=arena.make_prisms([[0.9, 0.0]], [[0.2, 0.4]], 0.4, texture=plain)), shift=5.0
    )
    box = (picture[..., 2] > 1.1 * picture[..., 0])[:, 80]  # boxes are tinted blue
    rows = np.flatnonzero(box)
    assert picture[rows[1], 80].mean() > 1.2 * picture[rows[-3], 80].mean()


def test_a_trace_with_wrong_shapes_or_numbers_is_refused(walk: walk_video.WalkTrace, tmp_path: Path):
    for bad in (
        walk._replace(joints=walk.joints[:, :5]),
        walk._replace(u=walk.u * np.nan),
        walk_video.WalkTrace(*(series[:0] for series in walk)),
    ):
        with pytest.raises(InputError, match="expected a walk"):
            walk_video.write_trace(tmp_path / "walk.mp4", bad, synthetic.room(), EYES)
    assert not (tmp_path / "walk.mp4").exists()


def test_a_video_of_a_record_shows_one_walk_in_its_own_room(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    written = []
    monkeypatch.setattr(walk_video, "write_trace", lambda *arguments, **_: written.append(arguments))
    velocity = np.zeros((2, 300, 2))
    velocity[1, :, 0] = 1.0
    record = synthetic.walk(2, 300, velocity=velocity)
    arenas = jax.tree.map(lambda *leaves: jnp.stack(leaves), synthetic.room(), arena.mirror(synthetic.room()))
    rooms = Room(arena=arenas, starts=jnp.zeros((2, 1, 3)), key=jax.random.split(jax.random.key(0), 2))
    robot = assembly.load_robot()
    assert walk_video.write_video(tmp_path / "walk.mp4", record, rooms) == tmp_path / "walk.mp4"
    walk_video.write_video(tmp_path / "walk.mp4", record, synthetic.room(), robot, index=0, seconds=3.0)
    walk_video.write_video(tmp_path / "walk.mp4", jax.tree.map(lambda leaf: leaf[0], record), synthetic.room(), robot)
    (_, trace, mirrored, eyes, _), (_, first, room, _, seconds), (_, single, *_) = written
    np.testing.assert_array_equal(trace.velocity, velocity[1])
    assert float(mirrored.handedness) == -1 and float(room.handedness) == 1
    assert eyes == robot.camera and seconds == 3.0
    for name, series in first._asdict().items():
        np.testing.assert_array_equal(series, getattr(single, name))
    monkeypatch.setattr(
        walk_video, "write_trace", lambda target, *arguments, **_: target.write(repr(arguments[-1]).encode())
    )
    shown = inline_video.show_walk(record, rooms, robot, index=1, seconds=7.5)
    assert shown.data == b"7.5" and shown.save(tmp_path / "shown.mp4").read_bytes() == b"7.5"
    source = re.search(r'<video controls .*src="data:video/mp4;base64,(.*)"></video>', shown._repr_html_())
    assert source is not None and base64.b64decode(source[1]) == b"7.5"
    with pytest.raises(InputError, match="expected an index of one of 2 walks, got 2"):
        walk_video.write_video(tmp_path / "walk.mp4", record, rooms, robot, index=2)
