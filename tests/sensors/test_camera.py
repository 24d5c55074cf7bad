"""The eyes: against 64 hard rays a pixel, where things appear, and what the parameters and gradients do."""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import camera as reference

from lgmdjax.errors import InputError
from lgmdjax.sensors import camera, hemifield
from lgmdjax.simulation import room_batches
from lgmdjax.world import arena, scenes

EYES = camera.Params()
SMALL = camera.Params(width=48, height=36)
FLIP = np.diag([1.0, -1.0, 1.0])
SPREAD = 16  # of so many columns the slow reference draws one
ROOMS = {
    "training": scenes.training_room,
    "testing": scenes.testing_room,
    "random-0": partial(scenes.random_room, jax.random.key(0)),
    "random-1": partial(scenes.random_room, jax.random.key(1)),
}


def turned(yaw=0.0, pitch=0.0, roll=0.0):
    """Rotation of a robot's trunk: yaw, then the nose down, then over to the right."""
    (c, p, r), (s, q, w) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return about_z @ np.array([[p, 0, q], [0, 1, 0], [-q, 0, p]]) @ np.array([[1, 0, 0], [0, r, -w], [0, w, r]])


def eyes_at(start, ahead=0.0, pitch=0.03, roll=-0.02):
    """Positions and rotation of both eyes of a robot that stands at (x, y, yaw), a little tilted."""
    x, y, yaw = (float(value) for value in start)
    rotation = turned(yaw, pitch, roll)
    offsets = np.array([[0.1 + ahead, 0.0325, 0.0], [0.1 + ahead, -0.0325, 0.0]])
    return np.array([x, y, 0.17]) + offsets @ rotation.T, rotation


@pytest.fixture(scope="module")
def draw():
    return jax.jit(partial(camera.render, EYES))


@pytest.fixture(scope="module")
def glance():
    return jax.jit(partial(camera.render, SMALL))


@pytest.mark.parametrize("name", ROOMS)
def test_pictures_and_their_changes_are_those_of_64_rays_a_pixel(draw, name):
    room = ROOMS[name]()
    columns = slice(1, None, SPREAD)
    ours, exact = [], []
    for ahead in (0.0, 0.002):
        positions, rotation = eyes_at(room.start, ahead)
        ours.append(np.asarray(draw(room, positions, rotation))[0][:, columns])
        exact.append(
            reference.picture(room, positions[0], rotation, EYES.width, EYES.height, EYES.fov, columns=columns)
        )
    edges = np.stack([picture.edge for picture in exact])
    error = np.abs(np.stack(ours) - np.stack([picture.grey for picture in exact]))
    change = ours[1] - ours[0], exact[1].grey - exact[0].grey
    correlation = np.corrcoef(change[0].ravel(), change[1].ravel())[0, 1]
    print(f"{name}: {error[edges].mean():.2f} grey at edges, {error.mean():.2f} overall, correlation {correlation:.3f}")
    assert edges.sum() > 80
    assert error[edges].mean() < 1.0
    assert error.mean() < 0.2
    assert correlation >= 0.9
    assert np.ptp(change[1]) > 5.0


def test_a_thin_pole_stands_where_the_equidistant_projection_puts_it(draw):
    """The angle from the axis is the distance from the middle: 170 degrees over the width, for each eye its own."""
    white = {"texture": (255.0, 0.0, 0.0, 1.0), "bottom": 0.0}
    positions = np.array([[0.0, 0.0325, 0.2], [0.0, -0.0325, 0.2]])
    for bearing in np.deg2rad([-80.0, -45.0, 0.0, 30.0, 84.0]):
        pole = arena.place([2.0 * np.array([math.cos(bearing), math.sin(bearing)])], 0.03, 1.0, **white)
        dark = arena.empty_room((20.0, 20.0), cylinders=pole, wall_texture=(20.0, 0.0, 0.0, 1.0))
        rows = np.asarray(draw(dark, positions, np.eye(3)))[:, EYES.height // 2 - 1]
        columns = np.arange(EYES.width) + 0.5
        seen = ((rows - 20.0) * columns).sum(axis=1) / (rows - 20.0).sum(axis=1)
        y = 2.0 * math.sin(bearing) - positions[:, 1]
        expected = EYES.width * (0.5 - np.arctan2(y, 2.0 * math.cos(bearing)) / math.radians(170.0))
        np.testing.assert_allclose(seen, expected, atol=0.1)


def test_the_mirrored_room_gives_mirrored_and_swapped_pictures(glance):
    room = scenes.testing_room()
    positions, rotation = eyes_at(room.start)
    picture = glance(room, positions, rotation)
    image = glance(arena.mirror(room), (positions @ FLIP)[::-1], FLIP @ rotation @ FLIP)
    np.testing.assert_allclose(image[::-1, :, ::-1], picture, atol=1e-6)


def test_a_crowd_sees_what_each_of_it_sees(glance):
    rooms = [scenes.training_room(), scenes.testing_room()]
    poses = [eyes_at(room.start) for room in rooms]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)
    positions, rotations = (jnp.stack(part) for part in zip(*poses, strict=True))
    crowd = jax.jit(jax.vmap(partial(camera.render, SMALL)))(batch, positions, rotations)
    for seen, room, pose in zip(crowd, rooms, poses, strict=True):
        np.testing.assert_allclose(seen, glance(room, *pose), atol=1e-9)


@pytest.mark.parametrize("overlap", [0.5, 0.6])
def test_overlap_cuts_the_same_columns_out(glance, overlap):
    room = scenes.indoor_scene()  # whose tiles, cut in another way, hold all there is
    pose = eyes_at(room.start)
    whole, part = glance(room, *pose), camera.render(replace(SMALL, overlap=overlap), room, *pose)
    assert part.shape == camera.shape(replace(SMALL, overlap=overlap))
    for side in (hemifield.LEFT, hemifield.RIGHT):
        np.testing.assert_allclose(part[side], hemifield.hemifield(whole[side], side, overlap), atol=1e-6)


def test_samples_are_the_mean_of_a_finer_picture():
    room = scenes.testing_room()
    pose = eyes_at(room.start)
    coarse = camera.render(replace(SMALL, samples=2), room, *pose)
    fine = camera.render(replace(SMALL, width=96, height=72), room, *pose)
    assert coarse.shape == (2, 36, 48)
    np.testing.assert_allclose(coarse, fine.reshape(2, 36, 2, 48, 2).mean(axis=(2, 4)), atol=1e-6)


def test_half_the_field_of_view_is_the_middle_at_twice_the_resolution(glance):
    room = scenes.testing_room()
    pose = eyes_at(room.start)
    zoomed = camera.render(replace(SMALL, fov=SMALL.fov / 2), room, *pose)
    averaged = np.asarray(zoomed).reshape(2, 18, 2, 24, 2).mean(axis=(2, 4))
    middle = np.asarray(glance(room, *pose))[:, 9:27, 12:36]
    assert np.abs(averaged - middle).mean() < 1.0 < np.abs(averaged - middle[:, ::-1]).mean()


def test_enough_slots_leave_nothing_out(glance):
    room = scenes.testing_room()
    pose = eyes_at(room.start)
    assert 1 < int(camera.crowding(SMALL, room, *pose)) <= SMALL.slots
    more = jax.jit(partial(camera.render, replace(SMALL, slots=SMALL.slots + 6)))(room, *pose)
    np.testing.assert_allclose(glance(room, *pose), more, atol=1e-6)


@pytest.mark.parametrize(("width", "height"), [(48, 36), (80, 60), (320, 240)])
def test_tiles_hold_what_may_show_in_them(width, height):
    """From six places of 20 random rooms; where it is most, rare poses have one more (0.2 % of them)."""
    eyes = camera.Params(width=width, height=height)
    rooms = room_batches.random_rooms(jax.random.key(3), 20)
    offsets = jnp.array([[0.1, 0.0325, 0.17], [0.1, -0.0325, 0.17]])

    def crowding(room, start):
        (x, y, yaw), zero = start, jnp.zeros(())
        c, s = jnp.cos(yaw), jnp.sin(yaw)
        rotation = jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.array([0.0, 0.0, 1.0])])
        return camera.crowding(eyes, room, jnp.stack([x, y, zero]) + offsets @ rotation.T, rotation)

    counts = jax.jit(jax.vmap(jax.vmap(crowding, (None, 0))))(rooms.arena, rooms.starts[:, :6])
    assert np.mean(np.asarray(counts) <= eyes.slots) >= 0.99
    assert np.max(counts) <= eyes.slots + 1


@pytest.mark.slow
def test_gradients_are_those_of_central_differences_in_both_modes():
    """Along the pose and along an obstacle's position, for the mean of a patterned weighting of the picture."""
    room = scenes.testing_room()
    positions, rotation = eyes_at(room.start)
    tiny = replace(SMALL, width=24, height=18, slots=3, bands=2)  # fewer make a shorter program
    weights = jnp.asarray(np.random.default_rng(0).normal(size=camera.shape(tiny)))

    def seen(positions, yaw, centre):
        moved = replace(room, boxes=replace(room.boxes, centre=centre))
        about_z = jnp.array([[jnp.cos(yaw), -jnp.sin(yaw), 0.0], [jnp.sin(yaw), jnp.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        return camera.render(tiny, moved, positions, about_z @ rotation)

    at = jnp.asarray(positions), jnp.asarray(0.0), room.boxes.centre
    both = jax.jit(lambda at, along: jax.jvp(seen, at, along))
    gradient = jax.jit(jax.grad(lambda *at: jnp.vdot(weights, seen(*at)), argnums=(0, 1, 2)))(*at)
    picture = jax.jit(seen)
    rng = np.random.default_rng(1)
    for part in range(3):
        along = [jnp.zeros_like(leaf) for leaf in at]
        along[part] = jnp.asarray(rng.normal(size=at[part].shape))
        primal, slope = both(at, tuple(along))
        np.testing.assert_allclose(primal, picture(*at), atol=1e-8)
        np.testing.assert_allclose(jnp.vdot(gradient[part], along[part]), jnp.vdot(weights, slope), rtol=1e-8)
        step = 1e-6
        ends = [picture(*(a + sign * step * b for a, b in zip(at, along, strict=True))) for sign in (1, -1)]
        difference = np.asarray(ends[0] - ends[1]) / (2 * step)
        # Where an edge enters or leaves a pixel the picture has a kink, on which differences straddle.
        close = np.isclose(slope, difference, rtol=1e-3, atol=1e-3)
        assert close.mean() > 0.999
        assert np.abs(slope).max() > 1.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0},
        {"height": 2.5},
        {"samples": True},
        {"slots": -1},
        {"bands": 9},
        {"overlap": 0.4},
        {"overlap": math.nan},
        {"fov": 0.0},
        {"fov": 6.0},
    ],
    ids=str,
)
def test_a_camera_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError, match=rf"expected .*{next(iter(wrong))}.*got"):
        camera.Params(**wrong)
