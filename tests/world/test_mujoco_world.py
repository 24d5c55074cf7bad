"""A room as a world of C MuJoCo: exact shapes, closed meshes, other shapes within the outline, what moves."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.transfer import robot_model
from lgmdjax.world import arena, meshes, mujoco_world, photographs
from lgmdjax.world.mujoco_world import PHOTOGRAPHIC, PLAIN

HALF = np.array([0.3, 0.2])


def volume(mesh: meshes.Mesh) -> float:
    """Return the volume that a closed mesh encloses, positive if its triangles face outward."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return float(np.sum(np.cross(a, b) * c) / 6)


@pytest.mark.parametrize(
    ("mesh", "expected", "tolerance"),
    [
        (meshes.box(HALF, 0.1, 1.0, 0.7), 0.6 * 0.4 * 0.9, 1e-9),
        (meshes.cylinder(0.3, 0.0, 0.8, 0.7), np.pi * 0.09 * 0.8, 0.01),
        (meshes.sphere(0.4, 0.7), 4 / 3 * np.pi * 0.064, 0.02),
    ],
)
def test_meshes_are_closed_and_face_outward(mesh, expected, tolerance):
    assert volume(mesh) == pytest.approx(expected, rel=tolerance)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    faces = np.cross(b - a, c - a)
    assert np.all(np.sum(faces * mesh.normals[mesh.triangles[:, 0]], axis=1) > 0)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0)


def test_a_rock_is_convex_and_within_its_ellipsoid():
    rock = meshes.rock(HALF, 0.9, 0.7, np.random.default_rng(0))
    scaled = rock.vertices / [*HALF, 0.45] - [0, 0, 1]
    np.testing.assert_allclose(np.linalg.norm(scaled, axis=1), 1.0)
    assert 0.5 < volume(rock) / (4 / 3 * np.pi * 0.3 * 0.2 * 0.45) < 1


@pytest.fixture(scope="module")
def room() -> arena.Arena:
    boxes = arena.make_prisms(
        [[1.5, 1.0], [1.5, -1.0], [-1.5, 1.2]], [[0.35, 0.25], [0.3, 0.3], [0.1, 0.1]], 0.9, yaw=[0.5, -0.3, 0.0]
    )
    cylinders = arena.make_prisms(
        [[-1.5, -1.0], [0.0, 1.8]], [[0.3], [0.2]], 0.8, goal=[[-1.5, -1.0], [0.0, -1.8]], departs=1.0, arrives=3.0
    )
    return arena.empty_room((6.0, 5.0), boxes=boxes, cylinders=cylinders)


def test_contacts_are_those_of_the_prisms(room):
    """Distances of a small sphere, the rubber of a foot, to all that can be touched equal `arena.clearance`."""
    model = robot_model.build(room, PLAIN)
    data = mujoco.MjData(model)
    foot, solids = model.geom("left_front_foot").id, np.flatnonzero(mujoco_world.touchable(model))
    assert len(solids) == 9  # five obstacles and four walls
    for x, y in ((0.8, 0.7), (-0.9, -0.6), (0.9, -1.6), (-2.8, 0.0), (-1.2, 1.0)):
        data.qpos[:] = model.key("stance").qpos
        robot_model.reset(model, data, np.array([x, y, 0.0]))
        place, radius = data.geom_xpos[foot].copy(), model.geom_size[foot, 0]
        theirs = min(mujoco.mj_geomDistance(model, data, foot, int(solid), 9.0, None) for solid in solids)
        point = jnp.asarray(place[None, :2])
        ours = float(arena.clearance(room, point, point, jnp.asarray([radius]))[0])
        assert theirs == pytest.approx(ours, abs=2e-4)


def test_the_robot_touches_the_world_and_not_itself(room):
    model = robot_model.build(room, PLAIN)
    data = mujoco.MjData(model)
    robot_model.reset(model, data, np.zeros(3))
    mujoco.mj_step(model, data, 60)
    assert data.ncon >= 6
    assert np.all((data.contact.geom == model.geom("floor").id).any(axis=1))
    assert np.any(model.geom_contype[data.contact.geom] == mujoco_world.ROBOT, axis=1).all()


@pytest.mark.parametrize("seed", range(4))
def test_other_shapes_stay_within_the_outline(room, seed):
    model = robot_model.build(room, PHOTOGRAPHIC, seed=seed)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for obstacle in mujoco_world.obstacles(room):
        body = model.body(f"obstacle_{obstacle.index}")
        for geom in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
            turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom] - data.xpos[body.id]
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            local = data.xmat[body.id].reshape(3, 3).T
            middle, extent = local @ (place + turn @ centre), np.abs(local @ turn) @ half
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                first, count = (values[model.geom_dataid[geom]] for values in (model.mesh_vertadr, model.mesh_vertnum))
                points = (place + model.mesh_vert[first : first + count] @ turn.T) @ local.T
                middle, extent = 0.5 * (points.max(0) + points.min(0)), 0.5 * np.ptp(points, axis=0)
            assert np.all(np.abs(middle[:2]) + extent[:2] <= obstacle.half_size + 1e-6)


def test_shapes_of_all_kinds_occur(room):
    kinds = set()
    for seed in range(6):
        model = robot_model.build(room, PHOTOGRAPHIC, seed=seed)
        kinds |= {int(model.geom(f"obstacle_{k}").type[0]) for k in (0, 1, 12)}
    shapes = mujoco.mjtGeom
    assert {int(shapes.mjGEOM_SPHERE), int(shapes.mjGEOM_CAPSULE), int(shapes.mjGEOM_MESH)} <= kinds


def test_what_moves_is_put_where_it_is(room):
    model = robot_model.build(room, PLAIN)
    data = mujoco.MjData(model)
    for time, y in ((0.0, 1.8), (2.0, 0.0), (9.0, -1.8)):
        mujoco_world.place_obstacles(model, data, room, time)
        mujoco.mj_forward(model, data)
        assert data.xpos[model.body("obstacle_13").id, 1] == pytest.approx(y, abs=1e-6)
    assert model.nmocap == 1


def test_noise_falls_as_one_over_f():
    noise = photographs.pink_noise(np.random.default_rng(1), 256)
    amplitude = np.abs(np.fft.fft2(noise))
    f = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.fftfreq(256)[None])
    means = [np.sqrt(np.mean(amplitude[(f > low) & (f < 1.3 * low)] ** 2)) for low in (0.02, 0.04, 0.08, 0.16, 0.32)]
    slope = np.polyfit(np.log([0.02, 0.04, 0.08, 0.16, 0.32]), np.log(means), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.05)


@pytest.mark.parametrize("name", photographs.NAMES)
def test_textures_repeat_without_a_seam(name):
    picture = photographs.load(name).astype(float)
    assert picture.shape == (photographs.SIZE, photographs.SIZE)
    assert 100 < picture.mean() < 140 and picture.std() > 15
    inside = np.abs(np.diff(picture, axis=1)).mean()
    assert np.abs(picture[:, 0] - picture[:, -1]).mean() < 1.5 * inside


def test_a_photograph_without_scikit_image_is_refused(monkeypatch):
    monkeypatch.setattr(photographs, "photographs", None)
    with pytest.raises(InputError, match=r"expected scikit-image .* pip install lgmdjax\[photographs\]"):
        photographs.load("brick")
