"""One room in both engines from one pose: the cameras by OpenGL and by rays show the same, to less than a pixel."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.sensors import camera, camera_faults
from lgmdjax.transfer import cube_camera, robot_model
from lgmdjax.world import arena, mujoco_world

EYES = camera.Params(width=80, height=60, tile_capacity=8)
FLOOR, OBSTACLES = "floor", (0, 1, 2, 12, 13)  # boxes and cylinders by row
FACE = 256  # px; the edge of a face's pixel is a twelfth of a pixel of the eye

pytestmark = pytest.mark.usefixtures("float32")


def build_room() -> arena.Arena:
    """Return a room with boxes, one turned and one overhead, and cylinders, none in front of another."""
    boxes = arena.make_prisms(
        [[1.2, 0.9], [0.4, -1.3], [1.4, -0.5]], [[0.2, 0.3], [0.25, 0.15], [0.3, 0.2]], [0.5, 0.8, 1.3],
        yaw=[0.4, -0.7, 0.2], bottom=[0.0, 0.0, 0.9],
    )  # fmt: skip
    cylinders = arena.make_prisms([[1.9, 0.1], [-0.1, 1.5]], [[0.15], [0.3]], [0.7, 1.1])
    return arena.empty_room((6.0, 5.0), boxes=boxes, cylinders=cylinders)


def with_white(room: arena.Arena, name: str | int) -> arena.Arena:
    """Paint one obstacle, or the floor, white, and all else black."""
    black = jnp.asarray([0.0, 0.0, 0.0, 1.0])
    white = black.at[0].set(255.0)
    rows = jnp.tile(black, (2 * arena.CAPACITY, 1))
    rows = rows.at[name].set(white) if isinstance(name, int) else rows
    boxes, cylinders = rows[: arena.CAPACITY], rows[arena.CAPACITY :]
    return dataclasses.replace(
        room,
        boxes=dataclasses.replace(room.boxes, texture=boxes),
        cylinders=dataclasses.replace(room.cylinders, texture=cylinders),
        wall_texture=jnp.tile(black, (4, 1)),
        floor_texture=white if name == FLOOR else black,
        sky=jnp.asarray(0.0),
    )


@pytest.fixture(scope="module")
def robot() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the robot in the room, tilted as no gait tilts it."""
    with jax.enable_x64(False):
        model = robot_model.build(with_white(build_room(), FLOOR), mujoco_world.PLAIN, face=FACE)
    data = mujoco.MjData(model)
    robot_model.reset(model, data, np.array([-0.2, 0.05, 0.1]))
    tilt = np.array([0.999, 0.03, -0.02, 0.05])
    data.qpos[3:7] = tilt / np.linalg.norm(tilt)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture(scope="module")
def pairs(robot) -> dict[str | int, tuple[np.ndarray, np.ndarray]]:
    """Return pictures by rays and by OpenGL, 0..1, in which the floor or one obstacle is white and all else black."""
    model, data = robot
    render = jax.jit(lambda room, *poses: camera.render(EYES, room, *poses))
    found = {}
    with cube_camera.CubeCamera(model, EYES, whole=True, face=FACE) as eyes, jax.enable_x64(False):
        position, quaternion = (jnp.asarray(data.qpos[part], jnp.float32) for part in (slice(3), slice(3, 7)))
        pose = hexapod.Pose(position=position, quaternion=quaternion)
        for name in (FLOOR, *OBSTACLES):
            model.mat_rgba[:, :3] = 0.0
            model.mat_rgba[model.mat(name if name == FLOOR else f"obstacle_{name}").id, :3] = 1.0
            by_rays = np.asarray(render(with_white(build_room(), name), *hexapod.eye_poses(pose)))
            found[name] = by_rays / 255, eyes.render(data) / 255
    return found


@pytest.mark.parametrize("name", OBSTACLES)
def test_silhouettes_and_centres_of_obstacles_agree_within_a_pixel(pairs, name):
    for rays, opengl in zip(*pairs[name], strict=True):
        assert rays.sum() > 8  # it is in view
        for axis in (0, 1):  # its height in every column, its width in every row, in pixels
            assert np.abs(rays.sum(axis) - opengl.sum(axis)).max() < 0.5
        places = np.indices(rays.shape)
        centre, other = (np.sum(places * picture, axis=(1, 2)) / picture.sum() for picture in (rays, opengl))
        assert np.abs(centre - other).max() < 0.1


def test_horizons_agree_within_a_pixel(pairs):
    """The floor ends at the walls; its rows in every column, and which pixels are floor."""
    for rays, opengl in zip(*pairs[FLOOR], strict=True):
        assert 0.3 < rays.mean() < 0.6
        assert np.abs(rays.sum(axis=0) - opengl.sum(axis=0)).max() < 0.5
        assert np.abs(rays - opengl).mean() < 0.005


def test_an_eye_turned_by_a_pixel_is_noticed(robot, pairs):
    model, data = robot
    pixel = EYES.fov / EYES.width
    lens = camera_faults.LensError(turn=np.array([[0, 0, pixel], [0, 0, pixel]]))
    model.mat_rgba[:, :3] = 0.0
    model.mat_rgba[model.mat("obstacle_12").id, :3] = 1.0
    with cube_camera.CubeCamera(model, EYES, whole=True, lens=lens, face=FACE) as eyes:
        turned = eyes.render(data)[0] / 255
    straight = pairs[12][1][0]
    columns = np.arange(EYES.width)
    centre = lambda picture: (picture.sum(axis=0) @ columns) / picture.sum()  # noqa: E731
    assert centre(turned) - centre(straight) == pytest.approx(1.0, abs=0.05)  # the eye turns left, the picture right


def test_a_distorted_lens_moves_the_edge_by_its_share():
    u, v = camera_faults.distort(np.array([40.0, 20.0]), np.zeros(2), 40.0, 0.03)
    np.testing.assert_allclose(u, [41.2, 20.15])
    assert not v.any()


def test_every_pixel_is_a_mean_and_hidden_ones_are_not_drawn():
    whole = cube_camera.resampling(EYES, 0, whole=True)
    assert set(whole) == set(cube_camera.FACES)
    np.testing.assert_allclose(sum(matrix.sum(axis=1) for matrix in whole.values()), 1.0, rtol=1e-5)
    half = dataclasses.replace(EYES, overlap=0.5, ground=0.5)
    left = cube_camera.resampling(half, 0)
    assert set(left) == {"front", "left", "up"}
    seen = np.asarray(sum(matrix.sum(axis=1) for matrix in left.values())).reshape(60, 80)
    np.testing.assert_allclose(seen[:30, :40], 1.0, rtol=1e-5)
    assert seen.sum() == pytest.approx(1200)


def test_without_opengl_there_is_one_clear_line(monkeypatch, robot):
    def refuse(*_: object) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(InputError, match=r"expected OpenGL without a window.*no display.*MUJOCO_GL"):
        cube_camera.CubeCamera(robot[0], EYES)
