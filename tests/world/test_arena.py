"""Rooms: what stands where, how near it is, and that a robot can always start."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from reference import arena as reference
from slopes import assert_three_ways_agree

from lgmdjax.errors import InputError
from lgmdjax.world import arena, scenes

FIXED = {
    "training": scenes.training_room,
    "testing": scenes.testing_room,
    "tube": scenes.tube_scene,
    "indoor": scenes.indoor_scene,
    "outdoor": scenes.outdoor_scene,
    "dynamic": scenes.dynamic_scene,
}
clearance = jax.jit(arena.clearance)
margins = jax.jit(arena.margins, static_argnames="ahead")
random_rooms = jax.jit(jax.vmap(scenes.random_room, in_axes=(0, None)))
free_poses = jax.jit(arena.free_poses, static_argnames="count")
tangents = jax.jit(arena.tangents)
KEYS = jax.random.split(jax.random.key(0), 32)


def row(rooms: arena.Arena, index: int) -> arena.Arena:
    return jax.tree.map(lambda leaf: leaf[index], rooms)


def random_capsules(room: arena.Arena, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Leg-sized capsules all over the room, as high as a robot, some of them balls or upright."""
    rng = np.random.default_rng(seed)
    x_min, x_max, y_min, y_max = np.asarray(room.room)
    starts = rng.uniform((x_min, y_min, 0.05), (x_max, y_max, 0.3), (count, 3))
    ends = np.clip(starts + rng.normal(scale=(0.15, 0.15, 0.05), size=(count, 3)), [-9, -9, 0.05], [9, 9, 0.3])
    ends[:5] = starts[:5]
    ends[5:10, :2] = starts[5:10, :2]
    return starts, ends, rng.uniform(0.01, 0.05, count)


def count(prisms: arena.Prisms) -> int:
    return int(np.sum(~np.asarray(arena.is_parked(prisms))))


def gaps(room: arena.Arena) -> list[float]:
    """Ways between every two obstacles, and from obstacles to walls, by points 5 mm apart on outlines."""
    room, nothing = jax.tree.map(np.asarray, (room, arena.parked(1)))
    outlines, shapes = [], []
    angles = np.linspace(0.0, 2 * np.pi, 400)
    for prisms, kind in ((room.boxes, "boxes"), (room.cylinders, "cylinders")):
        for i in np.flatnonzero(~np.asarray(arena.is_parked(prisms))):
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
            shapes.append(dataclasses.replace(room, room=np.array([-99.0, 99.0, -99.0, 99.0]), **rest))
    walls = dataclasses.replace(room, boxes=nothing, cylinders=nothing)
    to_walls = [reference.point_to_room(walls, points).min() for points in outlines]
    pairs = [(i, j) for i in range(len(shapes)) for j in range(i)]
    return to_walls + [reference.point_to_room(shapes[i], outlines[j]).min() for i, j in pairs]


def test_clearance_is_that_of_points_along_the_capsule() -> None:
    """Where nothing overlaps; for the depth of an overlap the deepest point is not the shortest way out."""
    room = jax.tree.map(np.asarray, scenes.indoor_scene())
    starts, ends, radii = random_capsules(room, 400)
    ours = np.asarray(clearance(room, starts, ends, radii))
    lines = [reference.segment(p, q) for p, q in zip(starts[:, :2], ends[:, :2], strict=True)]
    theirs = np.array([reference.point_to_room(room, line).min() for line in lines]) - radii
    np.testing.assert_array_equal(ours < 0, theirs < 0)
    apart = theirs > 0
    np.testing.assert_allclose(ours[apart], theirs[apart], atol=1e-4)
    assert (ours <= theirs + 1e-12).all()
    assert 5 < np.sum(theirs < 0) < 100


def test_clearance_is_mujocos_distance() -> None:
    """To every obstacle and wall of the training room; MuJoCo's depth of an overlap is not the least."""
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


def test_depth_is_the_shortest_shift_that_parts_a_capsule_from_a_box() -> None:
    """Over all directions n: the box's reach along n, less the capsule's the other way."""
    rng = np.random.default_rng(3)
    yaw, half, centre = 0.4, np.array([0.3, 0.2]), np.array([0.5, -0.3])
    room = arena.empty_room((9.0, 9.0), boxes=arena.place(centre[None], half, 1.0, yaw=yaw))
    starts = np.append(centre, 0.1) + rng.uniform(-0.3, 0.3, (200, 3))
    ends = starts + rng.normal(scale=0.2, size=(200, 3))
    angles = np.linspace(0.0, 2 * np.pi, 20_000)
    n = np.stack([np.cos(angles), np.sin(angles)])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half @ turn.T + centre
    capsule = np.minimum(starts[:, :2] @ n, ends[:, :2] @ n)
    shift = np.min(np.max(corners @ n, axis=0) - capsule, axis=1) + 0.03
    ours = np.asarray(clearance(room, starts, ends, np.full(200, 0.03)))
    inside = shift > 0.03
    assert inside.sum() > 100
    np.testing.assert_allclose(ours[inside], -shift[inside], atol=1e-4)


def test_what_hangs_overhead_cannot_be_touched() -> None:
    room = arena.empty_room(boxes=arena.place([[0.0, 0.0]], 0.5, 0.8, bottom=0.7))
    assert float(clearance(room, np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))[0]) == 3.0


def test_clearance_and_tangents_have_finite_slopes_where_there_are_corners() -> None:
    """Balls and upright capsules on a cylinder's axis, a box's corner and middle; one through the axis."""
    room = arena.empty_room(boxes=arena.place([[1.0, 1.0]], 0.2, 1.0), cylinders=arena.place([[-1.0, 0.0]], 0.2, 1.0))
    starts = jnp.asarray([[-1.0, 0.0, 0.1], [-1.2, 0.0, 0.1], [0.8, 0.8, 0.1], [1.0, 1.0, 0.1], [0.5, 0.8, 0.1]])
    ends = starts.at[1, 0].set(-0.8).at[3, 2].set(0.3).at[4, 0].set(0.8)

    def total(starts: jax.Array, ends: jax.Array, room: arena.Arena) -> jax.Array:
        return jnp.sum(arena.clearance(room, starts, ends, jnp.full(5, 0.05)))

    def turned(starts: jax.Array, ends: jax.Array, room: arena.Arena) -> jax.Array:
        normals, offsets = arena.tangents(room, starts, ends)
        return jnp.sum(normals * offsets[:, None])

    for told in (total, turned):
        slopes = jax.jit(jax.grad(told, argnums=(0, 1, 2)))(starts, ends, room)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
    normals, _ = tangents(room, starts, ends)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_clearance_grows_as_fast_as_the_robot_backs_off() -> None:
    room = arena.empty_room((9.0, 9.0), cylinders=arena.place([[1.0, 1.0]], 0.2, 1.0))
    one = lambda p: arena.clearance(room, p[None], p[None], jnp.zeros(1))[0]  # noqa: E731
    slope = jax.jit(jax.grad(one))(jnp.zeros(3))
    np.testing.assert_allclose(slope, [-np.sqrt(0.5), -np.sqrt(0.5), 0.0], atol=1e-12)


def test_tangents_know_walls_and_leave_out_what_hangs_overhead() -> None:
    room = scenes.indoor_scene()
    starts, ends = jnp.asarray([[0.6, 1.2], [0.6, 2.0]]), jnp.asarray([[0.7, 1.2], [0.6, 2.8]])
    normals, offsets = tangents(room, starts, ends)
    # The table's top would be the nearest to both; one of its legs comes next to the first. The other ends by the wall.
    np.testing.assert_allclose(normals, [[0.8, 0.6], [0.0, -1.0]], atol=1e-12)
    np.testing.assert_allclose(offsets, [0.8 * 0.4 + 0.6 * 1.05 + 0.025, -3.0], atol=1e-12)


def farthest(room: arena.Arena, normal: np.ndarray) -> np.ndarray:
    """Tell how far each thing of a room reaches in a direction: corners of boxes, rims of cylinders, walls' faces."""
    inward = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    reaches = np.where(inward @ normal > 1 - 1e-9, room.room * [1, -1, 1, -1], np.inf).tolist()
    for row in np.flatnonzero(~arena.is_parked(room.boxes)):
        c, s = np.cos(room.boxes.yaw[row]), np.sin(room.boxes.yaw[row])
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * room.boxes.half_size[row] @ [[c, s], [-s, c]]
        reaches.append(np.max((room.boxes.centre[row] + corners) @ normal))
    for row in np.flatnonzero(~arena.is_parked(room.cylinders)):
        reaches.append(room.cylinders.centre[row] @ normal + room.cylinders.half_size[row, 0])
    return np.array(reaches)


def test_tangents_part_each_segment_from_what_it_would_touch_first() -> None:
    """Wherever it lies, in an obstacle too: they touch one thing, from which the segment is as far as from the line."""
    room = jax.tree.map(np.asarray, scenes.testing_room())
    rng = np.random.default_rng(2)
    starts = rng.uniform(-3.8, 3.8, (600, 2))
    ends = starts + rng.uniform(-0.15, 0.15, (600, 2))
    normals, offsets = map(np.asarray, tangents(room, jnp.asarray(starts), jnp.asarray(ends)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    cut = 0
    for start, end, normal, offset in zip(starts, ends, normals, offsets, strict=True):
        assert np.abs(farthest(room, normal) - offset).min() < 1e-9
        there = reference.point_to_room(room, reference.segment(start, end)).min()
        known = min(normal @ start, normal @ end) - offset
        if there > 0:
            assert known == pytest.approx(there, abs=1e-5)
            continue
        # Cut, it is free once it is shifted as far as the line says, and not before.
        way = -known * normal
        ends_apart = [
            reference.point_to_room(room, reference.segment(start, end) + by * way).min() for by in (0.9, 1.1)
        ]
        assert ends_apart[0] < 0 < ends_apart[1]
        cut += 1
    assert cut > 10


def test_of_two_things_equally_near_the_tangent_is_of_one() -> None:
    """In the middle between walls, and on the diagonal of a corner."""
    at = jnp.asarray([[0.0, 0.0], [2.5, 2.5]])
    normals, offsets = tangents(arena.empty_room((6.0, 6.0)), at, at)
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0)
    np.testing.assert_allclose(offsets, [-3.0, -3.0])


def test_tangents_turn_and_move_with_the_segment_as_differences_say() -> None:
    """Before a corner of a box and before a cylinder, about which the line turns."""
    boxes, pole = arena.place([[1.0, 0.0]], 0.2, 1.0, yaw=0.3), arena.place([[0.0, 1.0]], 0.2, 1.0)
    room = arena.empty_room((9.0, 9.0), boxes=boxes, cylinders=pole)

    def told(segments):
        normals, offsets = arena.tangents(room, *segments)
        return jnp.sum(jnp.sin(offsets)) + jnp.sum(jnp.cos(normals + offsets[:, None]))

    segments = jnp.asarray([[[0.6, 0.35], [-0.1, 0.5]], [[0.7, 0.5], [0.2, 0.6]]])
    assert_three_ways_agree(told, segments)


@pytest.mark.parametrize(("time", "x"), [(0.0, 1.0), (2.0, 1.0), (3.0, 2.0), (4.0, 3.0), (9.0, 3.0)])
def test_obstacles_move_from_departure_to_arrival(time: float, x: float) -> None:
    boxes = arena.place([[1.0, 0.0], [0.0, 1.0]], 0.2, 1.0, goal=[[3.0, 0.0], [0.0, 1.0]], departs=2.0, arrives=4.0)
    room = arena.at(arena.empty_room((9.0, 9.0), boxes=boxes), time)
    np.testing.assert_allclose(room.boxes.centre[:2], [[x, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(arena.at(room, 99.0).boxes.centre, room.boxes.centre)


def test_obstacles_jump_where_departure_is_arrival() -> None:
    boxes = arena.place([[1.0, 0.0]], 0.2, 1.0, goal=[[3.0, 0.0]], departs=2.0, arrives=2.0)
    room = arena.empty_room((9.0, 9.0), boxes=boxes)
    xs = [float(arena.at(room, time).boxes.centre[0, 0]) for time in (1.9, 2.0)]
    assert xs == [1.0, 3.0]
    slope = jax.grad(lambda time: arena.at(room, time).boxes.centre[0, 0])(2.0)
    assert np.isfinite(slope)


def test_the_mirror_keeps_distances_and_comes_back() -> None:
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
def test_ways_are_wide_enough_or_closed(name: str) -> None:
    room = arena.validate(FIXED[name]())
    ways = np.array(gaps(room))
    assert ((ways >= scenes.GAP - 1e-3) | (ways <= 0.0)).all(), np.sort(ways[(ways > 0) & (ways < 0.8)])
    assert 10 <= count(room.boxes) + count(room.cylinders) <= 16


@pytest.mark.parametrize("name", FIXED)
def test_a_robot_can_start_and_walk_off_in_every_room(name: str) -> None:
    room = arena.validate(FIXED[name]())
    assert float(margins(room, room.start[None])[0]) > 0.45
    if name == "testing":
        np.testing.assert_array_equal(room.start[:2], [0.0, 2.5])


def test_the_scenes_are_as_the_paper_tells() -> None:
    tube = scenes.tube_scene(0.3)
    np.testing.assert_allclose(tube.cylinders.centre[0], [1.25, 0.3])
    assert float(tube.room[1]) == 3.0
    assert float(tube.wall_texture[1, 1]) == 0.0
    indoor = scenes.indoor_scene()
    assert float(indoor.boxes.centre[0, 0] - indoor.boxes.half_size[0, 0]) == pytest.approx(1.2)
    assert np.asarray(indoor.boxes.centre)[1, 1] < 0 < np.asarray(indoor.boxes.centre)[2, 1]
    before, after = scenes.dynamic_scene(), arena.at(scenes.dynamic_scene(), 60.0)
    ahead = margins(before, np.zeros((1, 3)), ahead=2.0), margins(after, np.zeros((1, 3)), ahead=2.0)
    assert float(ahead[0][0]) > 1.0 > 0.0 > float(ahead[1][0])


def test_random_rooms_are_sound_and_no_two_the_same() -> None:
    rooms = random_rooms(KEYS, 0.25)
    arena.validate(rooms)
    starts = jax.jit(jax.vmap(lambda room: arena.margins(room, room.start[None])[0]))(rooms)
    assert (np.asarray(starts) >= 0.45).all()
    for index in range(4):
        assert min(gaps(row(rooms, index))) >= scenes.GAP - 1e-3
    assert len(np.unique(np.asarray(rooms.boxes.centre[:, 0]), axis=0)) == 32
    sides = np.asarray(rooms.room[:, 1::2] - rooms.room[:, ::2])
    assert ((sides >= 6.0) & (sides <= 8.0)).all()


def test_density_is_obstacles_a_square_metre_until_the_room_is_full() -> None:
    def per_area(density: float) -> float:
        rooms = random_rooms(KEYS, density)
        area = np.sum(np.prod(np.asarray(rooms.room)[:, 1::2] - np.asarray(rooms.room)[:, ::2], axis=1))
        return (count(rooms.boxes) + count(rooms.cylinders)) / float(area)

    assert per_area(0.0) == 0.0
    assert per_area(0.1) == pytest.approx(0.1, rel=0.15)
    assert per_area(0.2) == pytest.approx(0.2, rel=0.1)
    assert 0.2 < per_area(0.4) < 0.3


def test_a_key_means_the_same_room_at_any_precision(float32: None) -> None:
    rooms = random_rooms(KEYS, 0.25)
    assert rooms.boxes.centre.dtype == "float32"
    with jax.enable_x64(True):
        twins = random_rooms(KEYS, 0.25)
    for one, other in zip(jax.tree.leaves(rooms), jax.tree.leaves(twins), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


def test_free_poses_are_free_and_spread_over_the_room() -> None:
    room = scenes.training_room()
    poses = np.asarray(free_poses(jax.random.key(0), room, 200))
    assert (np.asarray(margins(room, poses)) >= 0.45).all()
    assert (np.histogram2d(*poses[:, :2].T, bins=3)[0] > 5).all()
    assert np.ptp(poses[:, 2]) > 5.5


def test_where_no_pose_is_free_the_start_is_taken() -> None:
    room = dataclasses.replace(arena.empty_room((2.0, 2.0)), start=jnp.asarray([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(free_poses(jax.random.key(0), room, 200, 2.0), [[0.1, 0.2, 0.3]] * 200)
    single = jax.jit(arena.free_pose)(jax.random.key(0), room, 2.0)
    np.testing.assert_allclose(single, [0.1, 0.2, 0.3])


def test_contrast_fades_every_texture_and_nothing_else() -> None:
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


def test_nothing_is_promoted(precision: str, strict: None) -> None:
    room = jax.eval_shape(lambda key: arena.mirror(arena.at(scenes.random_room(key), 1.0)), jax.random.key(0))
    assert {leaf.dtype.name for leaf in jax.tree.leaves(room)} == {precision}
    points = jax.ShapeDtypeStruct((3, 3), precision)
    radii = jax.ShapeDtypeStruct((3,), precision)
    assert jax.eval_shape(arena.clearance, room, points, points, radii).dtype == precision
    poses = jax.eval_shape(lambda key, room: arena.free_poses(key, room, 2), jax.random.key(0), room)
    assert poses.dtype == precision


def altered(path: str, value: object) -> arena.Arena:
    """The training room with one field, such as `boxes.top`, changed in its first row or as a whole."""
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
        ("cylinders.half_size", (0.1, 0.2), "a cylinder's radius twice"),
        ("cylinders.departs", 3.0, "arrive after they depart"),
        ("boxes.texture", (128.0, 1.5, 0.0, 0.2), "contrast of boxes in 0..1"),
        ("floor_texture", (300.0, 0.5, 0.0, 0.2), "brightness of floor in 0..255"),
        ("floor_texture", (100.0, 0.5, 0.0, 0.0), "scales of floor above 0"),
        ("room", (3.0, -3.0, -3.0, 3.0), "x_min < x_max"),
        ("wall_height", 0.1, "walls above the robot"),
        ("start", (2.05, 1.95, 0.0), "a start pose that is free"),
    ],
)
def test_bad_rooms_are_refused_in_one_line(path: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        arena.validate(altered(path, value))
    assert "\n" not in str(caught.value)


def test_too_many_prisms_are_refused() -> None:
    with pytest.raises(InputError, match="at most 12"):
        arena.place(np.zeros((13, 2)), 0.1, 1.0)
