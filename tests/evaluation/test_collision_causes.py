"""Synthetic collisions of every cause and their mirror images; contact points against the lengths of the legs."""

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

FRAMES, LAST, WINDOW = 900, 899, 75  # the contact is in the last frame
COXA, FEMUR, TIBIA = 0.052, 0.066, 0.133  # m, as in the Mark II's firmware
HIPS = ((0.125, 0.062, 45.0), (0.0, 0.1, 90.0), (-0.125, 0.062, 135.0))  # m, deg: mounts of the left legs
STRAIGHT, LEFT, RIGHT = (1.0, 1.0), (-1.0, 2.0), (2.0, -1.0)  # commands
QUIET = {"u": (0.52, 0.52), "velocity": STRAIGHT}


def limbs() -> np.ndarray:
    """Return knees, feet and the bumper's ends of a robot in stance: rows of x, y and radius [m], computed by hand."""
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


def outermost_point(direction: float) -> tuple[np.ndarray, float]:
    """Return the robot's outermost point in a direction [rad] of its own frame, and its distance along it [m]."""
    normal, body = np.array([np.cos(direction), np.sin(direction)]), limbs()
    out = body[:, :2] @ normal + body[:, 2]
    best = np.argmax(out)
    return body[best, :2] + body[best, 2] * normal, float(out[best])


def walk(
    u: tuple[float, float] = (0.52, 0.52),
    command: tuple[float, float] = STRAIGHT,
    label: tuple[float, float] = LEFT,
    yaw: float = 0.0,
    **changes: np.ndarray,
) -> Record:
    """Return a record with frames for the baseline, straight and in turns either way, and a contact in the last frame.

    The robot stands at the origin; `u`, `command` and `label` are those of the last four seconds.
    """
    fields = {name: np.tile(value, (FRAMES, 1)) for name, value in QUIET.items()}
    for first, turn, response in ((200, LEFT, (0.74, 0.66)), (400, RIGHT, (0.66, 0.74))):
        fields["u"][first : first + 150], fields["velocity"][first : first + 150] = response, turn
    near = slice(FRAMES - 120, None)
    fields["u"] += 0.005 * np.sin(np.arange(FRAMES))[:, None]
    fields["u"][near], fields["velocity"][near] = u, command
    fields["label"], fields["distances"] = np.tile(STRAIGHT, (FRAMES, 1)), np.full((FRAMES, 2), 3.0)
    fields["label"][near], fields["distances"][near] = label, 0.4
    fields["joints"] = np.tile(hexapod.stance(), (FRAMES, 1, 1))
    fields["position"] = np.tile([0.0, 0.0, 0.1], (FRAMES, 1))
    fields["quaternion"] = np.tile([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], (FRAMES, 1))
    fields["contact"] = np.arange(FRAMES) == LAST
    return synthetic.walk(1, FRAMES, **{name: value[None] for name, value in (fields | changes).items()})


def room(direction: float, radius: float = 0.1, size: float = 20.0) -> arena.Arena:
    """Return a wide room with a cylinder that touches a robot at the origin."""
    point, _ = outermost_point(direction)
    centre = point + (radius - 0.001) * np.array([np.cos(direction), np.sin(direction)])
    return arena.empty_room((size, size), cylinders=arena.make_prisms(centre, radius, 1.0))


def corner() -> tuple[Record, arena.Arena]:
    """Return a robot in a corner of two walls, the left one a little nearer, that sees both and turns as the label."""
    yaw = np.pi / 4 - 0.1
    _, reach = outermost_point(np.pi / 2 - yaw)
    walls = np.array([-5.0, reach + 0.03, -5.0, reach - 0.001])
    inside = arena.empty_room((10.0, 10.0))
    return walk((0.8, 0.8), LEFT, yaw=yaw), inside.replace(bounds=walls.astype(inside.bounds.dtype))  # pyright: ignore


AHEAD, BEHIND = 0.6, 2.5  # rad, to the left
SCENES = {
    "tail swing": lambda: (walk((0.7, 0.6), LEFT), room(BEHIND)),
    "corner": corner,
    "did not see": lambda: (walk(), room(AHEAD)),
    "saw both sides": lambda: (walk((0.65, 0.65)), room(AHEAD)),
    "turned the other way": lambda: (walk((0.9, 0.8), LEFT, RIGHT), room(AHEAD)),
    "turned too late": lambda: (walk((0.9, 0.8), RIGHT, RIGHT), room(AHEAD)),
}


def mirror_walk(record: Record) -> Record:
    """Mirror a walk at the x axis."""
    flip = np.array([1.0, -1.0, 1.0])
    swapped = {name: getattr(record, name)[..., ::-1] for name in ("u", "distances", "label", "velocity")}
    return replace(
        record,
        position=record.position * flip,
        quaternion=record.quaternion * np.array([1.0, -1.0, 1.0, -1.0]),
        joints=record.joints[:, :, ::-1] * np.array([-1.0, 1.0, 1.0]),
        **swapped,
    )


def stack(*rooms: arena.Arena) -> arena.Arena:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rooms)


def concatenate(*records: Record) -> Record:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *records)


@pytest.mark.parametrize("cause", collision_causes.CAUSES)
def test_each_cause_and_its_mirror_image(cause):
    record, place = SCENES[cause]()
    both = collision_causes.classify(concatenate(record, mirror_walk(record)), stack(place, arena.mirror(place)))
    assert [(c.robot, c.frame, c.cause) for c in both] == [(0, LAST, cause), (1, LAST, cause)]
    here, there = both
    assert there.point == pytest.approx((here.point[0], -here.point[1]), abs=1e-6)
    assert there.bearing == pytest.approx(-here.bearing, abs=1e-5)
    assert (here.limb.split("_")[0], there.limb.split("_")[0]) == ("left", "right")
    assert (here.part, here.obstacle, here.u_rise) == (there.part, there.obstacle, pytest.approx(there.u_rise))
    assert collision_causes.count_causes(both) == {name: 2 * (name == cause) for name in collision_causes.CAUSES}


@pytest.mark.parametrize("direction", [0.3, 1.2, 1.7, 2.4, -0.5, -2.8])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_the_contact_point_is_the_robots_outermost_point(direction, yaw):
    point, reach = outermost_point(direction)
    normal = direction + yaw
    # A long box with a face perpendicular to the direction, away from the origin.
    home = np.array([3.0, -2.0])
    centre = home + (reach + 0.2) * np.array([np.cos(normal), np.sin(normal)])
    space = arena.empty_room((20.0, 20.0), boxes=arena.make_prisms(centre, [[0.2, 3.0]], 1.0, yaw=normal))
    record = walk(yaw=yaw, position=np.tile([*home, 0.1], (FRAMES, 1)))
    (found,) = collision_causes.classify(record, stack(space))
    assert np.allclose(found.point, point, atol=1e-4)
    assert found.obstacle == "box"
    assert found.part == ("front" if point[0] > 0.05 else "tail" if point[0] < -0.05 else "side")


def test_a_walk_without_contact_has_no_collisions_and_needs_no_baseline():
    record = synthetic.walk(2, 60)
    assert collision_causes.classify(record, stack(*2 * [arena.empty_room()])) == []
    assert collision_causes.count_causes([]) == dict.fromkeys(collision_causes.CAUSES, 0)


def test_frames_before_a_reset_do_not_count():
    record, is_after = walk((0.9, 0.8), LEFT, RIGHT), np.arange(FRAMES)[None] > LAST - 10
    calm = {name: np.where(is_after[..., None], value, getattr(record, name)) for name, value in QUIET.items()}
    whole = replace(record, **calm)
    cut = replace(whole, resets=is_after.astype(int))
    found = collision_causes.classify(concatenate(whole, cut), stack(room(AHEAD), room(AHEAD)))
    assert [c.cause for c in found] == ["turned the other way", "did not see"]
    assert (found[1].command_turn, found[1].u_difference) == (0, pytest.approx(0))


def test_a_corner_has_two_sides_within_the_window():
    record, place = corner()
    # With the second wall farther away there is nothing on the other side.
    wide = place.replace(bounds=place.bounds + np.array([0, 3, 0, 0], place.bounds.dtype))  # pyright: ignore
    assert collision_causes.classify(record, stack(wide))[0].cause == "turned too late"
    # If the robot faces the left wall during the whole window, that wall is ahead and the other one is behind its side.
    later, face = np.arange(FRAMES)[None, :, None] > LAST - WINDOW, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    y = float(place.bounds[3]) + 0.001 - outermost_point(0.0)[1]
    turned = replace(
        record,
        position=np.where(later, [0.0, y, 0.1], record.position),
        quaternion=np.where(later, face, record.quaternion),
    )
    (found,) = collision_causes.classify(turned, stack(place))
    assert (found.in_corner, found.obstacle, found.part) == (False, "wall", "front")


def test_moving_obstacles_are_at_their_positions_at_that_time():
    arrived = room(AHEAD)
    centre = np.asarray(arrived.cylinders.centre[0])
    moving = arena.make_prisms(centre + np.array([3.0, 0.0]), 0.1, 1.0, goal=centre[None], departs=20.0, arrives=29.0)
    (still,) = collision_causes.classify(walk(), stack(arrived))
    (found,) = collision_causes.classify(walk(), stack(replace(arrived, cylinders=moving)))
    assert (found.obstacle, found.limb) == (still.obstacle, still.limb) == ("cylinder", still.limb)
    assert found.point == pytest.approx(still.point, abs=1e-5)


def test_overhead_obstacles_are_not_touched():
    hanging = arena.make_prisms([[0.2, 0.1]], [[0.5, 0.5]], 0.8, bottom=0.7)
    (found,) = collision_causes.classify(walk(), stack(replace(room(AHEAD), boxes=hanging)))
    assert found.obstacle == "cylinder"


def test_poses_are_extrapolated_from_the_last_two_frames_or_constant_after_one():
    record = jax.tree.map(lambda leaf: leaf[0, :2], walk())
    moved = replace(record, position=np.array([[0.0, 0.0, 0.1], [0.006, 0.0, 0.1]]))
    assert np.allclose(contacts.extrapolate_substeps(moved)[:, 0], 0.006 + 0.001 * np.arange(6))
    alone = jax.tree.map(lambda leaf: leaf[1:], moved)
    assert np.allclose(contacts.extrapolate_substeps(alone)[:, 0], 0.006)


def test_distances_to_the_nearest_points_match_the_clearance():
    place = synthetic.room()
    points = np.random.default_rng(0).uniform(-4, 4, (200, 2))
    nearest = contacts.nearest_points(contacts.touchable_surfaces(place, 0.0), points)
    distance = np.linalg.norm(nearest - points[:, None], axis=-1)
    ends = jnp.asarray(points)
    expected = arena.clearance(place, ends, ends, jnp.zeros(len(points)))
    assert np.allclose(distance.min(axis=1), np.maximum(expected, 0), atol=1e-9)


def test_capsules_match_the_collision_shapes_and_the_lengths_of_the_legs():
    starts, ends, radii = contacts.collision_capsules(np.array([[0, 0, 0.1, 1, 0, 0, 0, *hexapod.stance().ravel()]]))
    assert starts.shape == ends.shape == (1, 13, 2)
    body = limbs()
    outermost = [np.max(np.concatenate([starts[0], ends[0]])[:, axis] + np.tile(radii, 2)) for axis in (0, 1)]
    assert np.allclose(outermost, np.max(body[:, :2] + body[:, 2:], axis=0), atol=1e-4)


def test_u_is_averaged_over_the_last_gait_cycle_of_the_segment():
    u = np.random.default_rng(1).uniform(0.5, 1.0, (1, 100, 2))
    resets = (np.arange(100)[None] >= 60).astype(int)
    means = collision_causes.average_over_cycle(synthetic.walk(1, 100, u=u, resets=resets))[0]
    assert np.allclose(means[40], u[0, 17:41].mean(axis=0))
    assert np.allclose(means[60], u[0, 60])
    assert np.allclose(means[83], u[0, 60:84].mean(axis=0))


def test_the_baseline_of_u_depends_on_turning():
    baseline = collision_causes.fit_baseline(walk())
    straight, *_, hard = baseline.u_levels
    assert straight == pytest.approx(0.52, abs=0.01)
    assert hard == pytest.approx(0.74, abs=0.01)
    # u of 0.72 is high for a robot that walks straight, and low for one that turns hard.
    (calm,) = collision_causes.classify(walk((0.72, 0.72)), stack(room(AHEAD)))
    (turning,) = collision_causes.classify(walk((0.72, 0.72), LEFT), stack(room(AHEAD)))
    assert (calm.cause, turning.cause) == ("saw both sides", "did not see")


def test_too_few_frames_for_a_baseline_are_an_input_error_unless_one_is_given():
    record = walk(distances=np.full((FRAMES, 2), 0.5))
    with pytest.raises(InputError, match="nothing within"):
        collision_causes.classify(record, stack(room(AHEAD)))
    (found,) = collision_causes.classify(record, stack(room(AHEAD)), collision_causes.fit_baseline(walk()))
    assert found.cause == "did not see"


def test_every_combination_of_properties_has_a_cause_and_every_cause_occurs():
    made = [
        collision_causes.Collision(
            robot=0,
            frame=0,
            limb="bumper",
            point=(ahead, 0.1),
            obstacle="wall",
            in_corner=in_corner,
            u_rise=rise,
            u_difference=difference,
            command_turn=turn,
            label_turn=label_turn,
        )
        for ahead, in_corner, rise, difference, turn, label_turn in product(
            (-0.1, 0.0, 0.1), (False, True), (-0.1, 0.1), (0.1, 1.0), (-1.0, 0.0, 1.0), (-1.0, 0.0, 1.0)
        )
    ]
    counts = collision_causes.count_causes(made)
    assert sum(counts.values()) == len(made) and all(counts.values())


def test_lost_robots_have_no_collisions():
    record = walk(ok=np.zeros(FRAMES, bool))
    assert collision_causes.classify(record, stack(room(AHEAD))) == []
