"""One frame, and walks made of it: mirrored, set back, frozen."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, navigator, policies
from lgmdjax.detectors import lgmd
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop, rollout, room_batches, sharding
from lgmdjax.world import arena

MIRRORED_LEGS = np.array([5, 4, 3, 2, 1, 0])
FRAMES = 20


@pytest.fixture(scope="module")
def model():
    return hexapod.build()


@pytest.fixture(scope="module")
def params():
    teacher = braitenberg.Params()
    everyone = policies.Anyone(
        seat=jnp.asarray(0),
        drivers=(
            teacher,
            navigator.create(jax.random.key(3)),
            policies.Blind(velocity=jnp.asarray([1.2, 1.2])),
            policies.Direct(rule=teacher, gain=jnp.asarray(10.0)),
            policies.Replay(velocities=jnp.asarray([[1.0, 0.5], [0.5, 1.0]])),
        ),
    )
    detector = lgmd.Params(threshold=0.5, suppression=30.0, smooth=True)
    eyes = camera.Params(width=48, height=36, overlap=0.6)
    return closed_loop.assemble(everyone, detector=detector, eyes=eyes)


@pytest.fixture(scope="module")
def room():
    """A start half a metre from a box that stands to the left; straight ahead it would be a tie, which has a side."""
    boxes = arena.place([[0.75, 0.4]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    scene = arena.empty_room((5.0, 4.0), boxes=boxes)
    return closed_loop.Room(arena=scene, starts=jnp.zeros((1, 3)), key=jax.random.key(0))


@pytest.fixture(scope="module")
def walk(params, model):
    """A compiled walk of FRAMES frames from a state, for whoever sits at the wheel."""

    @jax.jit
    def run(seat, room, state):
        own = params.controller.replace(driver=params.controller.driver.replace(seat=seat))
        return rollout.walk(params.replace(controller=own), model, room, state, policies.ANYONE, FRAMES)

    return run


@pytest.fixture(scope="module")
def put(params, model):
    """Put a robot into a room."""
    return jax.jit(lambda room: closed_loop.init(params, model, room, policies.ANYONE))


@pytest.fixture(scope="module")
def start(put, room):
    return put(room)


def seat(driver):
    return jnp.asarray(policies.ALL.index(driver))


def mirrored(state: closed_loop.State) -> closed_loop.State:
    """Begin with the other tripod, as the mirrored robot does."""
    legs = state.controller.cpg
    other = replace(legs, activation=legs.activation[MIRRORED_LEGS], adaptation=legs.adaptation[MIRRORED_LEGS])
    return replace(state, controller=replace(state.controller, cpg=other))


@pytest.mark.parametrize("driver", [policies.TEACHER, policies.DIRECT], ids=lambda driver: driver.name)
def test_mirror_the_room_and_the_commands_swap(walk, start, room, driver):
    _, record = walk(seat(driver), room, start)
    _, image = walk(seat(driver), room.replace(arena=arena.mirror(room.arena)), mirrored(start))
    for name in ("velocity", "label", "distances", "u", "excitation"):
        np.testing.assert_allclose(getattr(image, name), getattr(record, name)[:, ::-1], atol=1e-5, err_msg=name)
    np.testing.assert_allclose(image.position, np.asarray(record.position) * [1, -1, 1], atol=1e-6)
    assert np.ptp(np.asarray(record.velocity), axis=1).max() > 0.1  # it does turn


def test_teacher_turns_away_from_the_box_on_its_left(walk, start, room):
    _, record = walk(seat(policies.TEACHER), room, start)
    assert np.all(np.asarray(record.velocity)[:, 1] < np.asarray(record.velocity)[:, 0])
    np.testing.assert_array_equal(record.velocity, record.label)


def test_eyes_are_quiet_at_first_and_see_the_walk_afterwards(walk, start, room):
    _, record = walk(seat(policies.BLIND), room, start)
    np.testing.assert_array_equal(np.asarray(record.u)[0], 0.5)
    assert np.all(np.asarray(record.u)[5:].max(axis=0) > 0.5)


def test_touch_sets_the_robot_back_at_the_next_start(walk, put, room):
    inside = room.replace(starts=jnp.asarray([[0.5, 0.4, 0.0], [-1.0, 1.0, 0.5]]))
    _, record = walk(seat(policies.BLIND), inside, put(inside))
    assert bool(record.contact[0])
    assert record.setbacks.tolist() == [0] + [1] * (FRAMES - 1)
    np.testing.assert_allclose(record.position[1, :2], [-1.0, 1.0], atol=1e-9)
    np.testing.assert_array_equal(record.u[1], 0.5)  # a new place is no looming


def test_box_that_comes_is_scanned_where_it_is_and_touched_when_it_is_there(walk, put, room):
    """It stands for a tenth of a second, then comes along the way ahead at 1.2 m/s."""
    boxes = arena.place([[0.9, 0.0]], 0.2, 0.8, goal=[[0.3, 0.0]], departs=0.1, arrives=0.6)
    scene = replace(room.arena, boxes=boxes)
    coming = room.replace(arena=scene, starts=jnp.asarray([[0.0, 0.0, 0.0], [-1.0, 1.0, 0.5]]))
    _, record = walk(seat(policies.BLIND), coming, put(coming))

    touched = int(np.argmax(record.contact))
    assert touched > 3 and not record.contact[touched + 1 :].any()
    assert record.setbacks.tolist() == [0] * (touched + 1) + [1] * (FRAMES - touched - 1)
    came = 1.2 * np.clip(np.asarray(record.time) - 0.1, 0, 0.5)
    distances = np.asarray(record.distances)[: touched + 1]
    np.testing.assert_allclose(distances[0] - distances, np.stack([came, came], axis=1)[: touched + 1], atol=0.05)
    assert record.ok.all()


def test_robot_that_is_not_finite_is_frozen_and_flagged_and_passes_nothing_on(walk, start, room):
    sick = start.replace(data=start.data.replace(qvel=start.data.qvel.at[7].set(jnp.nan)))
    end, record = walk(seat(policies.BLIND), room, sick)
    assert record.ok.tolist() == [True] + [False] * (FRAMES - 1)
    assert np.all(np.isfinite(record.position))
    assert not bool(end.ok)


def test_blind_walk_without_pictures_is_the_same_walk(params, model, start, room, walk):
    _, seen = walk(seat(policies.BLIND), room, start)
    own = params.controller.replace(driver=params.controller.driver.replace(seat=seat(policies.BLIND)))
    unseen = params.replace(controller=own)
    _, record = jax.jit(lambda s: rollout.walk(unseen, model, room, s, policies.ANYONE, FRAMES, False))(start)
    np.testing.assert_allclose(record.position, seen.position, atol=1e-9)
    np.testing.assert_array_equal(record.u, 0.5)


@pytest.mark.slow
def test_chunks_of_a_crowd_are_one_walk(walk, put, params, model, room):
    """Of four, two a device, each with a start of its own."""
    starts = jnp.asarray([[[0.0, 0.0, 0.3 * k]] for k in range(4)])
    rooms = room_batches.stack([room.replace(starts=start) for start in starts])
    own = params.controller.replace(driver=params.controller.driver.replace(seat=seat(policies.TEACHER)))
    crowd = params.replace(controller=own)
    chunks = rollout.chunks(crowd, model, rooms, policies.ANYONE, FRAMES / 30, draw=False, chunk_seconds=0.4)
    short = rollout.together(list(chunks))
    assert short.time.shape == (4, FRAMES)
    np.testing.assert_allclose(short.time[0], np.arange(FRAMES) / 30)
    last = room.replace(starts=starts[3])
    _, alone = walk(seat(policies.TEACHER), last, put(last))
    np.testing.assert_allclose(short.position[3], alone.position, atol=1e-8)
    np.testing.assert_allclose(short.label[3], alone.label, atol=1e-8)


@pytest.mark.parametrize(("robots", "shares"), [(1, 1), (2, 1), (3, 1), (4, 2), (5, 2), (6, 2)])
def test_crowds_are_dealt_out_and_no_robot_is_alone_on_a_device(robots, shares):
    assert jax.local_device_count() == 2
    assert sharding.shares(robots) == shares


@pytest.mark.parametrize("robots", [1, 3, 4, 5])
def test_a_crowd_that_does_not_come_out_even_is_filled_up_and_cut(robots):
    numbers, keys = jnp.arange(robots), jax.random.split(jax.random.key(0), robots)
    work = lambda n, keys: (n**2, jax.vmap(jax.random.uniform)(keys))  # noqa: E731
    dealt = jax.jit(lambda *batches: sharding.deal(work, *batches))
    squares, luck = dealt(numbers, keys)
    np.testing.assert_array_equal(squares, np.arange(robots) ** 2)
    np.testing.assert_array_equal(luck, jax.vmap(jax.random.uniform)(keys))
