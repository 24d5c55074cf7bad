"""Collisions of every kind, made by hand, and mirrored; what touched, worked out from the lengths of the legs."""

from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.evaluation import collision_causes, contacts
from lgmdjax.simulation.closed_loop import Record
from lgmdjax.world import arena

FRAMES, LAST, BEFORE = 900, 899, 75  # the touch is in the last frame
COXA, FEMUR, TIBIA = 0.052, 0.066, 0.133  # m, as in the Mark II's firmware
HIPS = ((0.125, 0.062, 45.0), (0.0, 0.1, 90.0), (-0.125, 0.062, 135.0))  # m, deg: mounts of the left legs
STRAIGHT, LEFT, RIGHT = (1.0, 1.0), (-1.0, 2.0), (2.0, -1.0)  # commands
QUIET = {"u": (0.52, 0.52), "velocity": STRAIGHT}


def limbs() -> np.ndarray:
    """Knees, feet and the bumper's ends of a robot in stance: rows of x, y and radius [m], by hand."""
    rows = [(0.09, 0.0, 0.062), (-0.09, 0.0, 0.062)]
    for (x, y, mount), (coxa, femur, tibia) in zip(HIPS, hexapod.stance()[:3], strict=True):
        direction = np.deg2rad(mount) + coxa
        for reach, radius in (
            (COXA, 0.016),
            (COXA + FEMUR * np.cos(femur), 0.016),
            (COXA + FEMUR * np.cos(femur) + TIBIA * np.sin(femur + tibia), 0.011),
        ):
            out, aside = x + reach * np.cos(direction), y + reach * np.sin(direction)
            rows += [(out, aside, radius), (out, -aside, radius)]
    return np.array(rows)


def touching(direction: float) -> tuple[np.ndarray, float]:
    """Find the robot's outermost point in a direction [rad] of its own frame, and how far out it is [m]."""
    normal, body = np.array([np.cos(direction), np.sin(direction)]), limbs()
    out = body[:, :2] @ normal + body[:, 2]
    best = np.argmax(out)
    return body[best, :2] + body[best, 2] * normal, float(out[best])


def walk(
    u: tuple[float, float] = (0.52, 0.52),
    command: tuple[float, float] = STRAIGHT,
    asked: tuple[float, float] = LEFT,
    yaw: float = 0.0,
    **changes: np.ndarray,
) -> Record:
    """Learn what u is with nothing near, straight on and in turns either way; then stand, and touch in the last frame.

    The robot stands at the origin; `u`, `command` and `asked` are those of the last four seconds.
    """
    fields = {name: np.tile(value, (FRAMES, 1)) for name, value in QUIET.items()}
    for first, turn, told in ((200, LEFT, (0.74, 0.66)), (400, RIGHT, (0.66, 0.74))):
        fields["u"][first : first + 150], fields["velocity"][first : first + 150] = told, turn
    near = slice(FRAMES - 120, None)
    fields["u"] += 0.005 * np.sin(np.arange(FRAMES))[:, None]
    fields["u"][near], fields["velocity"][near] = u, command
    fields["label"], fields["distances"] = np.tile(STRAIGHT, (FRAMES, 1)), np.full((FRAMES, 2), 3.0)
    fields["label"][near], fields["distances"][near] = asked, 0.4
    fields["joints"] = np.tile(hexapod.stance(), (FRAMES, 1, 1))
    fields["position"] = np.tile([0.0, 0.0, 0.1], (FRAMES, 1))
    fields["quaternion"] = np.tile([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], (FRAMES, 1))
    fields["contact"] = np.arange(FRAMES) == LAST
    return synthetic.walk(1, FRAMES, **{name: value[None] for name, value in (fields | changes).items()})


def room(direction: float, radius: float = 0.1, size: float = 20.0) -> arena.Arena:
    """Put a cylinder where a robot at the origin touches it, in a wide room."""
    point, _ = touching(direction)
    centre = point + (radius - 0.001) * np.array([np.cos(direction), np.sin(direction)])
    return arena.empty_room((size, size), cylinders=arena.place(centre, radius, 1.0))


def corner() -> tuple[Record, arena.Arena]:
    """Face a corner of two walls, the left one a little nearer, seeing everything and turning as asked."""
    yaw = np.pi / 4 - 0.1
    _, reach = touching(np.pi / 2 - yaw)
    walls = np.array([-5.0, reach + 0.03, -5.0, reach - 0.001])
    inside = arena.empty_room((10.0, 10.0))
    return walk((0.8, 0.8), LEFT, yaw=yaw), inside.replace(room=walls.astype(inside.room.dtype))  # pyright: ignore


AHEAD, BEHIND = 0.6, 2.5  # rad, to the left
SCENES = {
    "tail swing": lambda: (walk((0.7, 0.6), LEFT), room(BEHIND)),
    "corner": corner,
    "did not see": lambda: (walk(), room(AHEAD)),
    "saw both sides": lambda: (walk((0.65, 0.65)), room(AHEAD)),
    "turned the other way": lambda: (walk((0.9, 0.8), LEFT, RIGHT), room(AHEAD)),
    "turned too late": lambda: (walk((0.9, 0.8), RIGHT, RIGHT), room(AHEAD)),
}


def mirrored(record: Record) -> Record:
    """Reflect a walk in the x axis."""
    flip = np.array([1.0, -1.0, 1.0])
    swapped = {name: getattr(record, name)[..., ::-1] for name in ("u", "distances", "label", "velocity")}
    return replace(
        record,
        position=record.position * flip,
        quaternion=record.quaternion * np.array([1.0, -1.0, 1.0, -1.0]),
        joints=record.joints[:, :, ::-1] * np.array([-1.0, 1.0, 1.0]),
        **swapped,
    )


def batch(*rooms: arena.Arena) -> arena.Arena:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rooms)


def crowd(*records: Record) -> Record:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *records)


@pytest.mark.parametrize("kind", collision_causes.KINDS)
def test_every_kind_and_its_mirror_image(kind):
    record, place = SCENES[kind]()
    both = collision_causes.find(crowd(record, mirrored(record)), batch(place, arena.mirror(place)))
    assert [(c.robot, c.frame, c.kind) for c in both] == [(0, LAST, kind), (1, LAST, kind)]
    here, there = both
    assert there.point == pytest.approx((here.point[0], -here.point[1]), abs=1e-6)
    assert there.bearing == pytest.approx(-here.bearing, abs=1e-5)
    assert (here.limb.split("_")[0], there.limb.split("_")[0]) == ("left", "right")
    assert (here.part, here.thing, here.rise) == (there.part, there.thing, pytest.approx(there.rise))
    assert collision_causes.count(both) == {name: 2 * (name == kind) for name in collision_causes.KINDS}


@pytest.mark.parametrize("direction", [0.3, 1.2, 1.7, 2.4, -0.5, -2.8])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_the_touching_point_is_the_robots_outermost_one(direction, yaw):
    point, reach = touching(direction)
    normal = direction + yaw
    # A long box whose face the robot meets flush, at some place far from the origin.
    home = np.array([3.0, -2.0])
    centre = home + (reach + 0.2) * np.array([np.cos(normal), np.sin(normal)])
    space = arena.empty_room((20.0, 20.0), boxes=arena.place(centre, [[0.2, 3.0]], 1.0, yaw=normal))
    record = walk(yaw=yaw, position=np.tile([*home, 0.1], (FRAMES, 1)))
    (found,) = collision_causes.find(record, batch(space))
    assert np.allclose(found.point, point, atol=1e-4)
    assert found.thing == "box"
    assert found.part == ("front" if point[0] > 0.05 else "tail" if point[0] < -0.05 else "side")


def test_a_walk_without_a_touch_has_no_collisions_even_if_nothing_can_be_measured():
    record = synthetic.walk(2, 60)
    assert collision_causes.find(record, batch(*2 * [arena.empty_room()])) == []
    assert collision_causes.count([]) == dict.fromkeys(collision_causes.KINDS, 0)


def test_frames_before_a_setback_do_not_count():
    record, put_down = walk((0.9, 0.8), LEFT, RIGHT), np.arange(FRAMES)[None] > LAST - 10
    calm = {name: np.where(put_down[..., None], told, getattr(record, name)) for name, told in QUIET.items()}
    whole = replace(record, **calm)
    cut = replace(whole, setbacks=put_down.astype(int))
    found = collision_causes.find(crowd(whole, cut), batch(room(AHEAD), room(AHEAD)))
    assert [c.kind for c in found] == ["turned the other way", "did not see"]
    assert (found[1].turn, found[1].difference) == (0, pytest.approx(0))


def test_a_corner_has_two_sides_within_the_window():
    record, place = corner()
    # With the second wall moved away there is nothing on the other side.
    wide = place.replace(room=place.room + np.array([0, 3, 0, 0], place.room.dtype))  # pyright: ignore
    assert collision_causes.find(record, batch(wide))[0].kind == "turned too late"
    # Turned towards the left wall before the window began, it has that wall ahead and the other one abeam.
    later, face = np.arange(FRAMES)[None, :, None] > LAST - BEFORE, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    y = float(place.room[3]) + 0.001 - touching(0.0)[1]
    turned = replace(
        record,
        position=np.where(later, [0.0, y, 0.1], record.position),
        quaternion=np.where(later, face, record.quaternion),
    )
    (found,) = collision_causes.find(turned, batch(place))
    assert (found.cornered, found.thing, found.part) == (False, "wall", "front")


def test_obstacles_are_where_they_were_at_the_time():
    arrived = room(AHEAD)
    centre = np.asarray(arrived.cylinders.centre[0])
    moving = arena.place(centre + np.array([3.0, 0.0]), 0.1, 1.0, goal=centre[None], departs=20.0, arrives=29.0)
    (still,) = collision_causes.find(walk(), batch(arrived))
    (found,) = collision_causes.find(walk(), batch(replace(arrived, cylinders=moving)))
    assert (found.thing, found.limb) == (still.thing, still.limb) == ("cylinder", still.limb)
    assert found.point == pytest.approx(still.point, abs=1e-5)


def test_what_hangs_overhead_is_not_touched():
    hanging = arena.place([[0.2, 0.1]], [[0.5, 0.5]], 0.8, bottom=0.7)
    (found,) = collision_causes.find(walk(), batch(replace(room(AHEAD), boxes=hanging)))
    assert found.thing == "cylinder"


def test_the_pose_goes_on_as_from_the_frame_before_or_stands_still():
    record = jax.tree.map(lambda leaf: leaf[0, :2], walk())
    moved = replace(record, position=np.array([[0.0, 0.0, 0.1], [0.006, 0.0, 0.1]]))
    assert np.allclose(contacts.substeps(moved)[:, 0], 0.006 + 0.001 * np.arange(6))
    alone = jax.tree.map(lambda leaf: leaf[1:], moved)
    assert np.allclose(contacts.substeps(alone)[:, 0], 0.006)


def test_nearest_points_are_as_far_as_the_clearance():
    place = synthetic.room()
    points = np.random.default_rng(0).uniform(-4, 4, (200, 2))
    distance = np.linalg.norm(contacts.nearest(contacts.surfaces(place, 0.0), points) - points[:, None], axis=-1)
    ends = jnp.asarray(points)
    expected = arena.clearance(place, ends, ends, jnp.zeros(len(points)))
    assert np.allclose(distance.min(axis=1), np.maximum(expected, 0), atol=1e-9)


def test_capsules_are_those_of_the_physics():
    names = [hexapod.load().geom(index).name for index in hexapod._anatomy().capsules]
    assert tuple(names) == hexapod.CAPSULES
    starts, ends, radii = contacts.capsules(np.array([[0, 0, 0.1, 1, 0, 0, 0, *hexapod.stance().ravel()]]))
    assert starts.shape == ends.shape == (1, 13, 2)
    body = limbs()
    outermost = [np.max(np.concatenate([starts[0], ends[0]])[:, axis] + np.tile(radii, 2)) for axis in (0, 1)]
    assert np.allclose(outermost, np.max(body[:, :2] + body[:, 2:], axis=0), atol=1e-4)


def test_the_average_is_of_the_last_gait_cycle_of_the_stretch():
    u = np.random.default_rng(1).uniform(0.5, 1.0, (1, 100, 2))
    setbacks = (np.arange(100)[None] >= 60).astype(int)
    means = collision_causes.averaged(synthetic.walk(1, 100, u=u, setbacks=setbacks))[0]
    assert np.allclose(means[40], u[0, 17:41].mean(axis=0))
    assert np.allclose(means[60], u[0, 60])
    assert np.allclose(means[83], u[0, 60:84].mean(axis=0))


def test_what_u_says_of_nothing_near_is_told_apart_by_turning():
    yardstick = collision_causes.measure(walk())
    straight, *_, hard = yardstick.quiet
    assert straight == pytest.approx(0.52, abs=0.01)
    assert hard == pytest.approx(0.74, abs=0.01)
    # u of 0.72 is much of a robot that walks straight, and little of one that turns hard.
    (calm,) = collision_causes.find(walk((0.72, 0.72)), batch(room(AHEAD)))
    (turning,) = collision_causes.find(walk((0.72, 0.72), LEFT), batch(room(AHEAD)))
    assert (calm.kind, turning.kind) == ("saw both sides", "did not see")


def test_too_little_walking_to_measure_by_is_an_input_error_unless_other_walks_are_given():
    record = walk(distances=np.full((FRAMES, 2), 0.5))
    with pytest.raises(InputError, match="nothing within"):
        collision_causes.find(record, batch(room(AHEAD)))
    (found,) = collision_causes.find(record, batch(room(AHEAD)), collision_causes.measure(walk()))
    assert found.kind == "did not see"


def test_every_collision_has_a_kind_that_is_known():
    made = [
        collision_causes.Collision(
            robot=0,
            frame=0,
            limb="bumper",
            point=(ahead, 0.1),
            thing="wall",
            cornered=cornered,
            rise=rise,
            difference=difference,
            turn=turn,
            asked=asked,
        )
        for ahead, cornered, rise, difference, turn, asked in product(
            (-0.1, 0.0, 0.1), (False, True), (-0.1, 0.1), (0.1, 1.0), (-1.0, 0.0, 1.0), (-1.0, 0.0, 1.0)
        )
    ]
    counts = collision_causes.count(made)
    assert sum(counts.values()) == len(made) and all(counts.values())


def test_lost_robots_do_not_touch():
    record = walk(ok=np.zeros(FRAMES, bool))
    assert collision_causes.find(record, batch(room(AHEAD))) == []
