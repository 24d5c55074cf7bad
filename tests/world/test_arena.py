"""Rooms: positions of obstacles, clearance, separating lines, and free start poses."""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from derivatives import assert_derivatives_agree
from reference import arena as reference

from lgmdjax.errors import InputError
from lgmdjax.simulation import room_batches
from lgmdjax.world import arena, obstacles, scenes

FIXED = {
    "training": scenes.training_room,
    "testing": scenes.testing_room,
    "tube": scenes.tube_scene,
    "indoor": scenes.indoor_scene,
    "outdoor": scenes.outdoor_scene,
    "dynamic": scenes.dynamic_scene,
}
clearance = jax.jit(arena.clearance)
pose_clearances = jax.jit(arena.pose_clearances, static_argnames="ahead")
random_rooms = jax.jit(jax.vmap(scenes.random_room, in_axes=(0, None)))
sample_free_poses = jax.jit(arena.sample_free_poses, static_argnames="count")
separating_lines = jax.jit(arena.separating_lines)
KEYS = jax.random.split(jax.random.key(0), 32)


def row(rooms: arena.Arena, index: int) -> arena.Arena:
    return jax.tree.map(lambda leaf: leaf[index], rooms)


def random_capsules(room: arena.Arena, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample capsules of the size of a leg all over the room, up to the robot's height; some are spheres or upright."""
    rng = np.random.default_rng(seed)
    x_min, x_max, y_min, y_max = np.asarray(room.bounds)
    starts = rng.uniform((x_min, y_min, 0.05), (x_max, y_max, 0.3), (count, 3))
    ends = np.clip(starts + rng.normal(scale=(0.15, 0.15, 0.05), size=(count, 3)), [-9, -9, 0.05], [9, 9, 0.3])
    ends[:5] = starts[:5]
    ends[5:10, :2] = starts[5:10, :2]
    return starts, ends, rng.uniform(0.01, 0.05, count)


def count(prisms: arena.Prisms) -> int:
    return int(np.sum(~np.asarray(arena.is_inactive(prisms))))


def gaps(room: arena.Arena) -> list[float]:
    """Return the gaps between obstacles and walls and between obstacles, from points 5 mm apart on their outlines."""
    room, nothing = jax.tree.map(np.asarray, (room, arena.inactive(1)))
    outlines, shapes = [], []
    angles = np.linspace(0.0, 2 * np.pi, 400)
    for prisms, kind in ((room.boxes, "boxes"), (room.cylinders, "cylinders")):
        for i in np.flatnonzero(~np.asarray(arena.is_inactive(prisms))):
            half, yaw = np.asarray(prisms.half_size[i]), float(prisms.yaw[i])
            if kind == "boxes":
                corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * half
                points = np.concatenate([reference.segment(*pair) for pair in itertools.pairwise(corners)])
            else:
                points = half * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            outlines.append(points @ turn.T + np.asarray(prisms.centre[i]))
            rest = {"boxes": nothing, "cylinders": nothing}
            rest[kind] = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], prisms)
            shapes.append(dataclasses.replace(room, bounds=np.array([-99.0, 99.0, -99.0, 99.0]), **rest))
    walls = dataclasses.replace(room, boxes=nothing, cylinders=nothing)
    to_walls = [reference.point_to_room(walls, points).min() for points in outlines]
    pairs = [(i, j) for i in range(len(shapes)) for j in range(i)]
    return to_walls + [reference.point_to_room(shapes[i], outlines[j]).min() for i, j in pairs]


def test_clearance_equals_that_of_points_along_the_capsule() -> None:
    """Where nothing overlaps. The depth of an overlap is the shortest shift, not the depth of the deepest point."""
    room = jax.tree.map(np.asarray, scenes.indoor_scene())
    starts, ends, radii = random_capsules(room, 400)
    ours = np.asarray(clearance(room, starts, ends, radii))
    lines = [reference.segment(p, q) for p, q in zip(starts[:, :2], ends[:, :2], strict=True)]
    theirs = np.array([reference.point_to_room(room, line).min() for line in lines]) - radii
    np.testing.assert_array_equal(ours < 0, theirs < 0)
    is_apart = theirs > 0
    np.testing.assert_allclose(ours[is_apart], theirs[is_apart], atol=1e-4)
    assert (ours <= theirs + 1e-12).all()
    assert 5 < np.sum(theirs < 0) < 100


def test_clearance_equals_mujocos_distance() -> None:
    """Without overlap; MuJoCo's depth of an overlap is not that of the shortest shift."""
    room = scenes.training_room()
    starts, ends, radii = random_capsules(room, 250, seed=1)
    capsule = '<body mocap="true" name="capsule"><geom name="capsule" type="capsule" size="1 1"/></body>'
    model, data = reference.load(reference.to_mjcf(room).replace("</worldbody>", capsule + "</worldbody>"))
    probe = model.geom("capsule").id
    others = [i for i in range(model.ngeom) if i not in (probe, model.geom("floor").id)]
    theirs = []
    for start, end, radius in zip(starts, ends, radii, strict=True):
        model.geom_size[probe, :2] = radius, np.linalg.norm(end - start) / 2 + 1e-9
        data.mocap_pos[0] = (start + end) / 2
        axis = end - start if np.any(end != start) else np.array([0.0, 0.0, 1.0])
        mujoco.mju_quatZ2Vec(data.mocap_quat[0], axis / np.linalg.norm(axis))
        mujoco.mj_kinematics(model, data)
        theirs.append(min(mujoco.mj_geomDistance(model, data, probe, i, 10.0, None) for i in others))
    ours, theirs = np.asarray(clearance(room, starts, ends, radii)), np.array(theirs)
    assert np.sum(ours < 0) > 10
    np.testing.assert_array_equal(ours < 0, theirs < 0)
    np.testing.assert_allclose(ours[ours > 0], theirs[ours > 0], atol=1e-5)


def test_depth_is_the_shortest_shift_that_separates_a_capsule_from_a_box() -> None:
    """The shift is searched over all directions n: the extent of the box along n minus that of the capsule along -n."""
    rng = np.random.default_rng(3)
    yaw, half, centre = 0.4, np.array([0.3, 0.2]), np.array([0.5, -0.3])
    room = arena.empty_room((9.0, 9.0), boxes=arena.make_prisms(centre[None], half, 1.0, yaw=yaw))
    starts = np.append(centre, 0.1) + rng.uniform(-0.3, 0.3, (200, 3))
    ends = starts + rng.normal(scale=0.2, size=(200, 3))
    angles = np.linspace(0.0, 2 * np.pi, 20_000)
    n = np.stack([np.cos(angles), np.sin(angles)])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half @ turn.T + centre
    capsule = np.minimum(starts[:, :2] @ n, ends[:, :2] @ n)
    shift = np.min(np.max(corners @ n, axis=0) - capsule, axis=1) + 0.03
    ours = np.asarray(clearance(room, starts, ends, np.full(200, 0.03)))
    overlaps = shift > 0.03
    assert overlaps.sum() > 100
    np.testing.assert_allclose(ours[overlaps], -shift[overlaps], atol=1e-4)


def test_overhead_obstacles_do_not_count() -> None:
    room = arena.empty_room(boxes=arena.make_prisms([[0.0, 0.0]], 0.5, 0.8, bottom=0.7))
    assert float(clearance(room, np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))[0]) == 3.0


def test_gradients_of_clearance_and_separating_lines_are_finite_at_corners() -> None:
    """For points and upright capsules on a cylinder's axis and at corner and centre of a box, and for one across it."""
    room = arena.empty_room(
        boxes=arena.make_prisms([[1.0, 1.0]], 0.2, 1.0), cylinders=arena.make_prisms([[-1.0, 0.0]], 0.2, 1.0)
    )
    starts = jnp.asarray([[-1.0, 0.0, 0.1], [-1.2, 0.0, 0.1], [0.8, 0.8, 0.1], [1.0, 1.0, 0.1], [0.5, 0.8, 0.1]])
    ends = starts.at[1, 0].set(-0.8).at[3, 2].set(0.3).at[4, 0].set(0.8)

    def total(starts: jax.Array, ends: jax.Array, room: arena.Arena) -> jax.Array:
        return jnp.sum(arena.clearance(room, starts, ends, jnp.full(5, 0.05)))

    def line_sum(starts: jax.Array, ends: jax.Array, room: arena.Arena) -> jax.Array:
        normals, offsets = arena.separating_lines(room, starts, ends)
        return jnp.sum(normals * offsets[:, None])

    for function in (total, line_sum):
        gradients = jax.jit(jax.grad(function, argnums=(0, 1, 2)))(starts, ends, room)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    normals, _ = separating_lines(room, starts, ends)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_clearance_grows_at_the_rate_of_the_distance() -> None:
    room = arena.empty_room((9.0, 9.0), cylinders=arena.make_prisms([[1.0, 1.0]], 0.2, 1.0))
    one = lambda p: arena.clearance(room, p[None], p[None], jnp.zeros(1))[0]  # noqa: E731
    gradient = jax.jit(jax.grad(one))(jnp.zeros(3))
    np.testing.assert_allclose(gradient, [-np.sqrt(0.5), -np.sqrt(0.5), 0.0], atol=1e-12)


def test_separating_lines_include_walls_and_exclude_overhead_obstacles() -> None:
    room = scenes.indoor_scene()
    starts, ends = jnp.asarray([[0.6, 1.2], [0.6, 2.0]]), jnp.asarray([[0.7, 1.2], [0.6, 2.8]])
    normals, offsets = separating_lines(room, starts, ends)
    # The table top would be nearest to both, but is overhead. Next to the first is a table leg, to the second a wall.
    np.testing.assert_allclose(normals, [[0.8, 0.6], [0.0, -1.0]], atol=1e-12)
    np.testing.assert_allclose(offsets, [0.8 * 0.4 + 0.6 * 1.05 + 0.025, -3.0], atol=1e-12)


def farthest(room: arena.Arena, normal: np.ndarray) -> np.ndarray:
    """Return the extent of each obstacle and wall in a direction."""
    inward = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    reaches = np.where(inward @ normal > 1 - 1e-9, room.bounds * [1, -1, 1, -1], np.inf).tolist()
    for row in np.flatnonzero(~arena.is_inactive(room.boxes)):
        c, s = np.cos(room.boxes.yaw[row]), np.sin(room.boxes.yaw[row])
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * room.boxes.half_size[row] @ [[c, s], [-s, c]]
        reaches.append(np.max((room.boxes.centre[row] + corners) @ normal))
    for row in np.flatnonzero(~arena.is_inactive(room.cylinders)):
        reaches.append(room.cylinders.centre[row] @ normal + room.cylinders.half_size[row, 0])
    return np.array(reaches)


def test_separating_lines_touch_the_nearest_obstacle() -> None:
    """Segment and obstacle are as far apart as segment and line, also where they overlap."""
    room = jax.tree.map(np.asarray, scenes.testing_room())
    rng = np.random.default_rng(2)
    starts = rng.uniform(-3.8, 3.8, (600, 2))
    ends = starts + rng.uniform(-0.15, 0.15, (600, 2))
    normals, offsets = map(np.asarray, separating_lines(room, jnp.asarray(starts), jnp.asarray(ends)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    overlaps = 0
    for start, end, normal, offset in zip(starts, ends, normals, offsets, strict=True):
        assert np.abs(farthest(room, normal) - offset).min() < 1e-9
        expected = reference.point_to_room(room, reference.segment(start, end)).min()
        distance = min(normal @ start, normal @ end) - offset
        if expected > 0:
            assert distance == pytest.approx(expected, abs=1e-5)
            continue
        # An overlapping segment is free once it is shifted to the line, and not before.
        shift = -distance * normal
        shifted = [
            reference.point_to_room(room, reference.segment(start, end) + factor * shift).min() for factor in (0.9, 1.1)
        ]
        assert shifted[0] < 0 < shifted[1]
        overlaps += 1
    assert overlaps > 10


def test_of_two_equally_near_walls_one_is_chosen() -> None:
    """At the centre between walls, and on the diagonal of a corner."""
    points = jnp.asarray([[0.0, 0.0], [2.5, 2.5]])
    normals, offsets = separating_lines(arena.empty_room((6.0, 6.0)), points, points)
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0)
    np.testing.assert_allclose(offsets, [-3.0, -3.0])


def test_derivatives_of_separating_lines_agree() -> None:
    """Near a corner of a box and near a cylinder, where the line rotates with the segment."""
    boxes, pole = arena.make_prisms([[1.0, 0.0]], 0.2, 1.0, yaw=0.3), arena.make_prisms([[0.0, 1.0]], 0.2, 1.0)
    room = arena.empty_room((9.0, 9.0), boxes=boxes, cylinders=pole)

    def line_sum(segments):
        normals, offsets = arena.separating_lines(room, *segments)
        return jnp.sum(jnp.sin(offsets)) + jnp.sum(jnp.cos(normals + offsets[:, None]))

    segments = jnp.asarray([[[0.6, 0.35], [-0.1, 0.5]], [[0.7, 0.5], [0.2, 0.6]]])
    assert_derivatives_agree(line_sum, segments)


@pytest.mark.parametrize(("time", "x"), [(0.0, 1.0), (2.0, 1.0), (3.0, 2.0), (4.0, 3.0), (9.0, 3.0)])
def test_obstacles_move_from_departure_to_arrival(time: float, x: float) -> None:
    boxes = arena.make_prisms(
        [[1.0, 0.0], [0.0, 1.0]], 0.2, 1.0, goal=[[3.0, 0.0], [0.0, 1.0]], departs=2.0, arrives=4.0
    )
    room = arena.at_time(arena.empty_room((9.0, 9.0), boxes=boxes), time)
    np.testing.assert_allclose(room.boxes.centre[:2], [[x, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(arena.at_time(room, 99.0).boxes.centre, room.boxes.centre)


def test_obstacles_jump_if_departure_equals_arrival() -> None:
    boxes = arena.make_prisms([[1.0, 0.0]], 0.2, 1.0, goal=[[3.0, 0.0]], departs=2.0, arrives=2.0)
    room = arena.empty_room((9.0, 9.0), boxes=boxes)
    xs = [float(arena.at_time(room, time).boxes.centre[0, 0]) for time in (1.9, 2.0)]
    assert xs == [1.0, 3.0]
    gradient = jax.grad(lambda time: arena.at_time(room, time).boxes.centre[0, 0])(2.0)
    assert np.isfinite(gradient)


def test_mirroring_preserves_distances_and_is_its_own_inverse() -> None:
    room = scenes.testing_room()
    starts, ends, radii = random_capsules(room, 100)
    flip = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(
        clearance(room, starts, ends, radii),
        clearance(arena.mirror(room), starts * flip, ends * flip, radii),
        atol=1e-12,
    )
    twice = arena.mirror(arena.mirror(room))
    for before, after in zip(jax.tree.leaves(room), jax.tree.leaves(twice), strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("name", ["training", "testing"])
def test_gaps_are_wide_enough_or_closed(name: str) -> None:
    room = arena.validate(FIXED[name]())
    widths = np.array(gaps(room))
    assert ((widths >= scenes.MIN_GAP - 1e-3) | (widths <= 0.0)).all(), np.sort(widths[(widths > 0) & (widths < 0.8)])
    assert 10 <= count(room.boxes) + count(room.cylinders) <= 16


@pytest.mark.parametrize("name", FIXED)
def test_start_pose_of_every_room_is_free(name: str) -> None:
    room = arena.validate(FIXED[name]())
    assert float(pose_clearances(room, room.start[None])[0]) > 0.45
    if name == "testing":
        np.testing.assert_array_equal(room.start[:2], [0.0, 2.5])


def test_scenes_match_the_text_of_the_paper() -> None:
    tube = scenes.tube_scene(0.3)
    np.testing.assert_allclose(tube.cylinders.centre[0], [1.25, 0.3])
    assert float(tube.bounds[1]) == 3.0
    assert float(tube.wall_texture[1, 1]) == 0.0
    indoor = scenes.indoor_scene()
    assert float(indoor.boxes.centre[0, 0] - indoor.boxes.half_size[0, 0]) == pytest.approx(1.2)
    assert np.asarray(indoor.boxes.centre)[1, 1] < 0 < np.asarray(indoor.boxes.centre)[2, 1]
    before, after = scenes.dynamic_scene(), arena.at_time(scenes.dynamic_scene(), 60.0)
    ahead = pose_clearances(before, np.zeros((1, 3)), ahead=2.0), pose_clearances(after, np.zeros((1, 3)), ahead=2.0)
    assert float(ahead[0][0]) > 1.0 > 0.0 > float(ahead[1][0])


def test_random_rooms_are_valid_and_all_different() -> None:
    rooms = random_rooms(KEYS, 0.25)
    arena.validate(rooms)
    starts = jax.jit(jax.vmap(lambda room: arena.pose_clearances(room, room.start[None])[0]))(rooms)
    assert (np.asarray(starts) >= 0.45).all()
    for index in range(4):
        assert min(gaps(row(rooms, index))) >= scenes.MIN_GAP - 1e-3
    assert len(np.unique(np.asarray(rooms.boxes.centre[:, 0]), axis=0)) == 32
    sides = np.asarray(rooms.bounds[:, 1::2] - rooms.bounds[:, ::2])
    assert ((sides >= 6.0) & (sides <= 8.0)).all()


def test_density_is_obstacles_per_square_metre_until_the_room_is_full() -> None:
    def per_area(density: float) -> float:
        rooms = random_rooms(KEYS, density)
        area = np.sum(np.prod(np.asarray(rooms.bounds)[:, 1::2] - np.asarray(rooms.bounds)[:, ::2], axis=1))
        return (count(rooms.boxes) + count(rooms.cylinders)) / float(area)

    assert per_area(0.0) == 0.0
    assert per_area(0.1) == pytest.approx(0.1, rel=0.15)
    assert per_area(0.2) == pytest.approx(0.2, rel=0.1)
    assert 0.2 < per_area(0.4) < 0.3


def test_a_key_gives_the_same_room_in_both_precisions(float32: None) -> None:
    rooms = random_rooms(KEYS, 0.25)
    assert rooms.boxes.centre.dtype == "float32"
    with jax.enable_x64(True):
        doubles = random_rooms(KEYS, 0.25)
    for one, other in zip(jax.tree.leaves(rooms), jax.tree.leaves(doubles), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


def test_sampled_poses_are_free_and_spread_over_the_room() -> None:
    room = scenes.training_room()
    poses = np.asarray(sample_free_poses(jax.random.key(0), room, 200))
    assert (np.asarray(pose_clearances(room, poses)) >= 0.45).all()
    assert (np.histogram2d(*poses[:, :2].T, bins=3)[0] > 5).all()
    assert np.ptp(poses[:, 2]) > 5.5


def test_sampled_pose_is_the_start_if_none_is_free() -> None:
    room = dataclasses.replace(arena.empty_room((2.0, 2.0)), start=jnp.asarray([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(sample_free_poses(jax.random.key(0), room, 200, 2.0), [[0.1, 0.2, 0.3]] * 200)
    single = jax.jit(arena.sample_free_pose)(jax.random.key(0), room, 2.0)
    np.testing.assert_allclose(single, [0.1, 0.2, 0.3])


def test_contrast_scales_every_texture_and_nothing_else() -> None:
    full, plain = scenes.outdoor_scene(), scenes.outdoor_scene(contrast=0.0)
    for textures in (
        plain.boxes.texture,
        plain.cylinders.texture,
        plain.wall_texture,
        plain.floor_texture[None],
    ):
        np.testing.assert_array_equal(textures[:, 1], 0.0)
    assert float(np.min(full.boxes.texture[:, 1])) > 0.0
    np.testing.assert_array_equal(np.delete(full.wall_texture, 1, axis=1), np.delete(plain.wall_texture, 1, axis=1))
    np.testing.assert_array_equal(full.boxes.centre, plain.boxes.centre)


def test_a_key_changes_the_textures_of_a_fixed_room_only() -> None:
    one, other = scenes.training_room(), scenes.training_room(KEYS[5])
    np.testing.assert_array_equal(one.boxes.centre, other.boxes.centre)
    assert (np.asarray(one.boxes.texture) != np.asarray(other.boxes.texture)).all()


def test_no_dtype_is_promoted(precision: str, strict: None) -> None:
    room = jax.eval_shape(lambda key: arena.mirror(arena.at_time(scenes.random_room(key), 1.0)), jax.random.key(0))
    assert {leaf.dtype.name for leaf in jax.tree.leaves(room)} == {precision}
    points = jax.ShapeDtypeStruct((3, 3), precision)
    radii = jax.ShapeDtypeStruct((3,), precision)
    assert jax.eval_shape(arena.clearance, room, points, points, radii).dtype == precision
    poses = jax.eval_shape(lambda key, room: arena.sample_free_poses(key, room, 2), jax.random.key(0), room)
    assert poses.dtype == precision


def altered(path: str, value: object) -> arena.Arena:
    """Return the training room with one field changed: of prisms (`boxes.top`) the first row, else the whole field."""
    room = scenes.training_room()
    first, _, second = path.partition(".")
    if not second:
        return dataclasses.replace(room, **{first: jnp.asarray(value, dtype=float)})
    prisms = getattr(room, first)
    leaf = getattr(prisms, second).at[0].set(jnp.asarray(value, dtype=float))
    return dataclasses.replace(room, **{first: dataclasses.replace(prisms, **{second: leaf})})


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("boxes.centre", (np.nan, 0.0), "finite numbers in boxes.centre"),
        ("boxes.half_size", (-0.1, 0.2), "positive sizes of boxes"),
        ("boxes.top", 0.2, "boxes from the floor to above 0.35 m"),
        ("cylinders.bottom", 0.2, "cylinders from the floor to above 0.35 m"),
        ("cylinders.half_size", (0.1, 0.2), "the radius of a cylinder twice"),
        ("cylinders.departs", 3.0, "cylinders with arrives >= departs"),
        ("boxes.texture", (128.0, 1.5, 0.0, 0.2), "contrast of boxes in 0..1"),
        ("floor_texture", (300.0, 0.5, 0.0, 0.2), "brightness of floor in 0..255"),
        ("floor_texture", (100.0, 0.5, 0.0, 0.0), "scales of floor above 0"),
        ("bounds", (3.0, -3.0, -3.0, 3.0), "x_min < x_max"),
        ("wall_height", 0.1, "walls higher than the robot"),
        ("start", (2.05, 1.95, 0.0), "a free start pose"),
    ],
)
def test_invalid_rooms_are_rejected_with_one_line(path: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        arena.validate(altered(path, value))
    assert "\n" not in str(caught.value)


def test_too_many_prisms_are_rejected() -> None:
    with pytest.raises(InputError, match="at most 12"):
        arena.make_prisms(np.zeros((13, 2)), 0.1, 1.0)


def test_raised_obstacles_are_overhead_and_all_others_stay_as_they_are():
    """The share is kept over many rooms; a raised obstacle is out of the robot's reach, and no padding is raised."""
    rooms = room_batches.random_rooms(jax.random.key(5), 16).arena
    raise_some = jax.vmap(partial(scenes.raise_obstacles, share=0.25))
    raised = raise_some(rooms, jax.random.split(jax.random.key(6), 16))
    arena.validate(raised)
    counts = np.zeros(2, int)
    for before, after in ((rooms.boxes, raised.boxes), (rooms.cylinders, raised.cylinders)):
        overhead, active = np.asarray(arena.is_overhead(after)), ~np.asarray(obstacles.is_inactive(before))
        assert not np.any(overhead & ~active)
        counts += np.array([overhead.sum(), active.sum()])
        for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
            np.testing.assert_array_equal(np.asarray(a)[~overhead], np.asarray(b)[~overhead])
    assert 0.15 < counts[0] / counts[1] < 0.37
