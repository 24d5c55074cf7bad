"""The film and the view from outside: the robot is where it was, always in sight, and the file plays."""

import io
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import av
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.errors import InputError
from lgmdjax.reporting import third_person, walk_video
from lgmdjax.sensors import camera
from lgmdjax.world import arena

EYES = camera.Params(width=80, height=60)
SMALL = third_person.Params(width=160, height=100, focal=125.0, rows=(30, 100), columns=(38, 122))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> walk_video.Walk:
    run = synthetic.write_run(tmp_path_factory.mktemp("runs") / "made-up", frames=300, pixels=(60, 80))
    recorded = np.load(run / "evaluate/walk.npz")
    return walk_video.Walk(*(recorded[name] for name in walk_video.Walk._fields))


@pytest.fixture(scope="module")
def decoded(walk: walk_video.Walk) -> tuple[list[np.ndarray], float]:
    """The film of one second and its rate."""
    buffer = io.BytesIO()
    assert walk_video.write(buffer, walk, synthetic.room(), EYES, seconds=1.0, overlap=0.6) == 12
    buffer.seek(0)
    with av.open(buffer, "r") as container:
        stream = container.streams.video[0]
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)], float(stream.average_rate or 0)


def test_film_has_its_pictures_size_and_rate(decoded: tuple[list[np.ndarray], float]):
    pictures, rate = decoded
    assert len(pictures) == 12
    assert {picture.shape for picture in pictures} == {(600, 960, 3)}
    assert rate == pytest.approx(12)


def test_curves_run_with_the_film(decoded: tuple[list[np.ndarray], float]):
    def ink(picture: np.ndarray) -> int:
        """Pixels of coloured curve in the lower panels."""
        x, y, width, _ = walk_video.CURVES[0]
        below = picture[y : walk_video.CURVES[1][1] + walk_video.CURVES[1][3], x : x + width].astype(int)
        return int(np.sum(np.ptp(below, axis=-1) > 60))

    drawn = [ink(picture) for picture in decoded[0]]
    assert drawn[0] < 0.1 * drawn[-1]
    assert np.mean(np.diff(drawn) >= 0) > 0.8


def test_the_robot_moves_in_the_film(decoded: tuple[list[np.ndarray], float]):
    x, y, width, height = walk_video.STAGE
    stage = [picture[y : y + height, x : x + width].astype(int) for picture in decoded[0]]
    assert all(np.abs(a - b).max() > 60 for a, b in pairwise(stage))


def test_what_the_detector_does_not_see_is_dimmed(walk: walk_video.Walk):
    white = np.full((2, 60, 80), 250, np.uint8)
    page = walk_video._Paper(walk, np.arange(60), (80, 60)).picture(
        np.zeros((100, 160, 3), np.uint8), white, 0, overlap=0.6
    )
    for (x, y, width, _), first, last in zip(walk_video.EYES, (0.0, 0.4), (0.6, 1.0), strict=True):
        row, across = page[y + 50, x : x + width, 0], np.arange(width) / width
        assert np.all(row[(across > first + 0.03) & (across < last - 0.03)] == 250)
        np.testing.assert_allclose(
            row[(across < first - 0.03) | (across > last + 0.03)], 250 * walk_video.DIMMED, atol=1
        )


def test_eyes_are_where_the_trunk_carries_them(walk: walk_video.Walk):
    _, _, positions, rotations, _, _ = walk_video.bodies(walk_video.poses(walk, np.array([0, 150])))
    for row, position, rotation in zip((0, 150), positions, rotations, strict=True):
        yaw = 2 * np.arctan2(walk.quaternion[row, 3], walk.quaternion[row, 0])
        forward, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        np.testing.assert_allclose(position[0] - position[1], 0.065 * left, atol=1e-9)
        np.testing.assert_allclose(rotation[0], np.stack([forward, left, [0, 0, 1]], axis=-1), atol=1e-9)
        assert (position[0] - walk.position[row]) @ forward > 0.1


def test_the_robot_is_always_in_the_window_that_is_cast_for_it(walk: walk_video.Walk):
    shots, body = walk_video._shots(walk, np.arange(0, 300, 10))
    view = third_person.Params()
    for eye, rotation, ends in zip(
        shots.eye, shots.rotation, jnp.concatenate([shots.starts, shots.ends], 1), strict=True
    ):
        seen = (ends - eye) @ rotation
        column = view.width / 2 - view.focal * seen[:, 1] / seen[:, 0]
        row = view.height / 2 - view.focal * seen[:, 2] / seen[:, 0]
        reach = view.focal * float(body.radii.max()) / float(seen[:, 0].min())
        assert view.columns[0] <= float(column.min()) - reach and float(column.max()) + reach <= view.columns[1]
        assert view.rows[0] <= float(row.min()) - reach and float(row.max()) + reach <= view.rows[1]


@pytest.fixture(scope="module")
def look() -> Callable[..., np.ndarray]:
    """Draw a ball of pure red at (0, 0, 0.1) in a room, from 0.9 m behind and 0.5 m above."""
    ball = third_person.Body(
        starts=jnp.array([[0.0, 0.0, 0.1]]),
        ends=jnp.array([[0.0, 0.0, 0.1]]),
        radii=jnp.array([0.06]),
        colours=jnp.array([[1.0, 0.0, 0.0]]),
    )
    eye, target = np.array([[-0.9, 0.0, 0.6]]), np.array([[0.0, 0.0, 0.1]])
    rotation = jnp.asarray(walk_video.looking(eye, target)[0])
    draw = jax.jit(partial(third_person.picture, SMALL))

    def at(room: arena.Arena, shift: float = 0.0) -> np.ndarray:
        body = ball._replace(starts=ball.starts + jnp.array([shift, 0, 0]), ends=ball.ends + jnp.array([shift, 0, 0]))
        return np.asarray(draw(room, jnp.asarray(eye[0]), rotation, body, jnp.asarray(target[0])))

    return at


def red(picture: np.ndarray) -> np.ndarray:
    return picture[..., 0] > 2 * np.maximum(picture[..., 1], picture[..., 2])


def test_a_ball_is_a_disc_in_the_middle_lit_from_above(look: Callable[..., np.ndarray]):
    picture = look(arena.empty_room())
    rows, columns = np.nonzero(red(picture))
    assert (rows.mean(), columns.mean()) == pytest.approx((49.5, 79.5), abs=2)
    # Seen under asin(0.06 / 1.03), times the focal length: 7.3 px of radius.
    assert len(rows) == pytest.approx(np.pi * 7.3**2, rel=0.12)
    assert picture[rows.min() + 2, 80, 0] > 1.3 * picture[rows.max() - 2, 80, 0]


def test_a_ball_throws_its_shadow_on_the_floor(look: Callable[..., np.ndarray]):
    room = arena.empty_room(floor_texture=(150.0, 0.0, 0.0, 0.5))
    near, far = look(room), look(room, shift=5.0)
    darker = (far - near).mean(axis=-1) * ~red(near)
    rows, columns = np.nonzero(darker > 0.02)
    assert len(rows) > 20
    assert columns.mean() == pytest.approx(79.5, abs=2)
    assert rows.mean() > 50, "straight below the ball is lower in the picture"


def test_what_stands_in_front_turns_to_glass_and_what_stands_behind_does_not(look: Callable[..., np.ndarray]):
    empty = look(arena.empty_room())
    front = look(arena.empty_room(boxes=arena.place([[-0.4, 0.0]], [[0.05, 0.4]], 0.9)))
    behind = look(arena.empty_room(boxes=arena.place([[0.3, 0.0]], [[0.05, 0.4]], 0.9)))
    assert np.sum(red(front)) > 0.9 * np.sum(red(empty))
    assert np.abs(front - empty)[45:55, 60:100].mean() > 0.02, "glass can be seen"
    assert np.median(np.abs(behind - empty)[red(empty)]) < 1e-6, "the ball hides what is behind it"
    assert np.abs(behind - empty).max() > 0.1


def test_surfaces_are_shaded_by_where_they_face(look: Callable[..., np.ndarray]):
    """A plain grey box: its top, which faces the light, is brighter than the face towards the camera."""
    plain = (128.0, 0.0, 0.0, 0.5)
    picture = look(arena.empty_room(boxes=arena.place([[0.9, 0.0]], [[0.2, 0.4]], 0.4, texture=plain)), shift=5.0)
    box = (picture[..., 2] > 1.1 * picture[..., 0])[:, 80]  # boxes are tinted blue
    rows = np.flatnonzero(box)
    assert picture[rows[1], 80].mean() > 1.2 * picture[rows[-3], 80].mean()


def test_the_stretch_with_steering_is_chosen_and_set_backs_are_avoided(walk: walk_video.Walk):
    frames = len(walk.time)
    velocity = np.full((frames, 2), 1.2)
    velocity[60:90] = (2.0, -1.0)
    velocity[180:240] = (2.0, -1.0)
    position = np.cumsum(np.full((frames, 3), [0.002, 0, 0]), axis=0)
    assert walk_video.choose(walk._replace(velocity=velocity, position=position), 60)[0] in range(165, 196)
    position[210:] += 3.0
    chosen = walk_video.choose(walk._replace(velocity=velocity, position=position), 60)
    assert np.all(np.diff(chosen) == 1)
    assert 60 in chosen and 89 in chosen
    assert walk_video.choose(walk, 10_000).tolist() == list(range(frames))


def test_a_walk_that_does_not_fit_is_refused(walk: walk_video.Walk, tmp_path: Path):
    for bad in (
        walk._replace(joints=walk.joints[:, :5]),
        walk._replace(u=walk.u * np.nan),
        walk_video.Walk(*(series[:0] for series in walk)),
    ):
        with pytest.raises(InputError, match="expected a walk"):
            walk_video.write(tmp_path / "walk.mp4", bad, synthetic.room(), EYES)
    assert not (tmp_path / "walk.mp4").exists()
