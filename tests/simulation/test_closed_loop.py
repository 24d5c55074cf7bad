"""The closed loop: mirror symmetry, resets, moving obstacles, faults, and rollouts of batches."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, navigator, policies
from lgmdjax.detectors import emd, lgmd, scaled
from lgmdjax.errors import InputError
from lgmdjax.sensors import camera, camera_faults
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches, sharding
from lgmdjax.world import arena

MIRRORED_LEGS = np.array([5, 4, 3, 2, 1, 0])
FRAMES = 20


@pytest.fixture(scope="module")
def model():
    return hexapod.build()


@pytest.fixture(scope="module")
def params():
    teacher = braitenberg.Params()
    switch = policies.PolicySwitch(
        active=jnp.asarray(0),
        policies=(
            teacher,
            navigator.create(jax.random.key(3)),
            policies.BlindParams(velocity=jnp.asarray([1.2, 1.2])),
            policies.DirectParams(rule=teacher, gain=jnp.asarray(10.0)),
            policies.ReplayParams(velocities=jnp.asarray([[1.0, 0.5], [0.5, 1.0]])),
        ),
    )
    return assembly.assemble(
        switch,
        detector_params=lgmd.Params(threshold=0.5, suppression=30.0, smooth=True),
        camera_params=camera.Params(width=48, height=36, overlap=0.6),
    )


@pytest.fixture(scope="module")
def room():
    """Half a metre from a box on the left; a box straight ahead would be a tie, which is not symmetric.

    All rooms have two starts, so that all rollouts are one program.
    """
    boxes = arena.make_prisms([[0.75, 0.4]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    scene = arena.empty_room((5.0, 4.0), boxes=boxes)
    return closed_loop.Room(arena=scene, starts=jnp.zeros((2, 3)), key=jax.random.key(0))


@pytest.fixture(scope="module")
def run(params, model):
    """A compiled rollout of FRAMES frames from a state, for any policy, with pictures or without."""

    @jax.jit
    def run(active, room, state, render):
        robot = activated(params, active)
        return rollout.rollout(robot, model, room, state, policies.SWITCH, frames=FRAMES, render=render)

    return lambda policy, room, state, render=True: run(policies.POLICIES.index(policy), room, state, render)


@pytest.fixture(scope="module")
def init(params, model):
    """The state of a robot at the first start of a room."""
    return jax.jit(lambda room: closed_loop.init(params, model, room, policies.SWITCH))


@pytest.fixture(scope="module")
def start(init, room):
    return init(room)


def activated(params: closed_loop.Params, active) -> closed_loop.Params:
    """The robot with the policy of this index active; `assembly.select_policy` takes no traced one."""
    switch = replace(params.controller.policy, active=active)
    return replace(params, controller=replace(params.controller, policy=switch))


def mirrored(state: closed_loop.State) -> closed_loop.State:
    """The same state with the other tripod first, as in the mirrored robot."""
    rhythm = state.controller.cpg
    other = replace(rhythm, activation=rhythm.activation[MIRRORED_LEGS], adaptation=rhythm.adaptation[MIRRORED_LEGS])
    return replace(state, controller=replace(state.controller, cpg=other))


@pytest.mark.parametrize("policy", [policies.TEACHER, policies.DIRECT], ids=lambda policy: policy.name)
def test_mirrored_room_swaps_the_velocities(run, start, room, policy):
    _, record = run(policy, room, start)
    _, image = run(policy, room.replace(arena=arena.mirror(room.arena)), mirrored(start))
    for name in ("velocity", "label", "distances", "u", "excitation"):
        np.testing.assert_allclose(getattr(image, name), getattr(record, name)[:, ::-1], atol=1e-5, err_msg=name)
    np.testing.assert_allclose(image.position, np.asarray(record.position) * [1, -1, 1], atol=1e-6)
    assert np.ptp(np.asarray(record.velocity), axis=1).max() > 0.1  # it does turn


def test_teacher_turns_away_from_the_box_on_its_left(run, start, room):
    _, record = run(policies.TEACHER, room, start)
    assert np.all(np.asarray(record.velocity)[:, 1] < np.asarray(record.velocity)[:, 0])
    np.testing.assert_array_equal(record.velocity, record.label)


def test_detectors_are_silent_in_the_first_frame_and_respond_later(run, start, room):
    _, record = run(policies.BLIND, room, start)
    np.testing.assert_array_equal(np.asarray(record.u)[0], 0.5)
    assert np.all(np.asarray(record.u)[5:].max(axis=0) > 0.5)


def test_contact_resets_the_robot_to_the_next_start(run, init, room):
    inside = room.replace(starts=jnp.asarray([[0.5, 0.4, 0.0], [-1.0, 1.0, 0.5]]))
    _, record = run(policies.BLIND, inside, init(inside))
    assert bool(record.contact[0])
    assert record.resets.tolist() == [0] + [1] * (FRAMES - 1)
    assert record.is_first.tolist() == [True, True] + [False] * (FRAMES - 2)
    np.testing.assert_allclose(record.position[1, :2], [-1.0, 1.0], atol=1e-9)
    np.testing.assert_array_equal(record.u[1], 0.5)  # no response to the change of place


def test_moving_box_is_scanned_and_touched_where_it_is(run, init, room):
    """It stands for a tenth of a second, then approaches head-on at 1.2 m/s."""
    boxes = arena.make_prisms([[0.9, 0.0]], 0.2, 0.8, goal=[[0.3, 0.0]], departs=0.1, arrives=0.6)
    scene = replace(room.arena, boxes=boxes)
    approaching = room.replace(arena=scene, starts=jnp.asarray([[0.0, 0.0, 0.0], [-1.0, 1.0, 0.5]]))
    _, record = run(policies.BLIND, approaching, init(approaching))

    touched = int(np.argmax(record.contact))
    assert touched > 3 and not record.contact[touched + 1 :].any()
    assert record.resets.tolist() == [0] * (touched + 1) + [1] * (FRAMES - touched - 1)
    travelled = 1.2 * np.clip(np.asarray(record.time) - 0.1, 0, 0.5)
    distances = np.asarray(record.distances)[: touched + 1]
    np.testing.assert_allclose(
        distances[0] - distances, np.stack([travelled, travelled], axis=1)[: touched + 1], atol=0.05
    )
    assert record.ok.all()


def test_robot_that_is_not_finite_is_frozen_and_flagged(run, start, room):
    """Its record stays finite."""
    broken = start.replace(data=start.data.replace(qvel=start.data.qvel.at[7].set(jnp.nan)))
    end, record = run(policies.BLIND, room, broken)
    assert record.ok.tolist() == [True] + [False] * (FRAMES - 1)
    assert np.all(np.isfinite(record.position))
    assert not bool(end.ok)


def test_blind_rollout_is_the_same_without_rendering(start, room, run):
    _, rendered = run(policies.BLIND, room, start)
    _, record = run(policies.BLIND, room, start, render=False)
    np.testing.assert_allclose(record.position, rendered.position, atol=1e-9)
    np.testing.assert_array_equal(record.u, 0.5)


def faulty(room: closed_loop.Room, **faults: float) -> closed_loop.Room:
    leaves = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.int32 if isinstance(leaf, int) else float), faults)
    return replace(room, faults=replace(camera_faults.Params(), **leaves))


def test_responses_rest_until_the_first_late_picture_and_are_those_of_late_pictures(params, model, room, monkeypatch):
    """With pictures that are two frames late; those of the scene are replaced by noise."""
    grey = params.camera.width / camera_faults.SENSOR_WIDTH  # to which pictures are rounded
    noise = jax.random.uniform(jax.random.key(7), (8, *camera.image_shape(params.camera)), minval=0, maxval=9)
    pictures = grey * jnp.round(noise / grey)
    ranges = jnp.full(params.laser.rays, 5.0)
    monkeypatch.setattr(closed_loop, "sense", lambda params, scene, state, render: (pictures[state.frame], ranges))

    @jax.jit
    def see(room):
        def frame(state, _):
            after, seen = closed_loop.observe(params, room.arena, state, True, room.faults)
            return replace(after, frame=state.frame + 1, is_first=jnp.asarray(False)), seen.excitation

        return jax.lax.scan(frame, closed_loop.init(params, model, room, policies.SWITCH), length=8)[1]

    clear, late = see(room), see(faulty(room, latency=2))
    np.testing.assert_array_equal(late[:3], 0)
    assert np.all(np.asarray(clear)[1:] > 0)
    np.testing.assert_allclose(late[2:], clear[:-2], rtol=1e-6)


def test_a_robot_that_does_not_see_in_every_frame_has_no_faulty_cameras(params, model, room):
    seldom = replace(params, frame_stride=jnp.asarray(2))
    with pytest.raises(InputError, match="expected a robot that sees in every frame in rooms with camera faults"):
        closed_loop.init(seldom, model, faulty(room, noise=1.0), policies.SWITCH)


@pytest.mark.extended
def test_another_detector_steers_with_faulty_cameras(params, model, room):
    """Of four robots, two on each device, the last without noise; `make test` covers the parts."""
    inside = scaled.Params(model=emd, detector=emd.Params(), contrast=4.0, pooling=2)
    robot = assembly.with_detector(
        activated(params, jnp.asarray(policies.POLICIES.index(policies.DIRECT))), scaled, inside
    )
    noise = jnp.asarray([1.0, 1.0, 1.0, 0.0])
    rooms = room_batches.stack_rooms([faulty(room, noise=float(level)) for level in noise])
    rooms = replace(rooms, key=jax.random.split(jax.random.key(1), 4))
    chunks = rollout.rollout_chunks(robot, model, rooms, policies.SWITCH, FRAMES / 30, chunk_seconds=FRAMES / 30)
    record = rollout.concatenate_time(list(chunks))
    assert record.ok.all() and np.all(record.feed_forward == 0) and np.all(record.u[:, 0] == 0.5)
    u = record.u[:, 5:]
    assert np.all(u.max(axis=(1, 2)) > 0.5)
    assert len({float(each.sum()) for each in u}) == 4  # noise of their own
    assert np.ptp(record.velocity) > 0


@pytest.mark.slow
def test_chunks_of_a_batch_are_one_rollout(run, init, params, model, room):
    """Of four robots, two on each device, each with a start of its own."""
    starts = jnp.asarray([[[0.0, 0.0, 0.3 * k]] * 2 for k in range(4)])
    rooms = room_batches.stack_rooms([room.replace(starts=start) for start in starts])
    teacher = activated(params, jnp.asarray(policies.POLICIES.index(policies.TEACHER)))
    chunks = rollout.rollout_chunks(
        teacher, model, rooms, policies.SWITCH, FRAMES / 30, render=False, chunk_seconds=0.4
    )
    record = rollout.concatenate_time(list(chunks))
    assert record.time.shape == (4, FRAMES)
    np.testing.assert_allclose(record.time[0], np.arange(FRAMES) / 30)
    last = room.replace(starts=starts[3])
    _, single = run(policies.TEACHER, last, init(last))
    np.testing.assert_allclose(record.position[3], single.position, atol=1e-8)
    np.testing.assert_allclose(record.label[3], single.label, atol=1e-8)


@pytest.mark.parametrize(("robots", "devices"), [(1, 1), (2, 1), (3, 1), (4, 2), (5, 2), (6, 2)])
def test_each_device_gets_at_least_two_robots(robots, devices):
    assert jax.local_device_count() == 2
    assert sharding.device_count(robots) == devices


@pytest.mark.parametrize("robots", [1, 3, 4, 5])
def test_uneven_batches_are_padded_and_cut(robots):
    numbers, keys = jnp.arange(robots), jax.random.split(jax.random.key(0), robots)
    work = lambda n, keys: (n**2, jax.vmap(jax.random.uniform)(keys))  # noqa: E731
    sharded = jax.jit(lambda *batches: sharding.shard_robots(work, *batches))
    squares, samples = sharded(numbers, keys)
    np.testing.assert_array_equal(squares, np.arange(robots) ** 2)
    np.testing.assert_array_equal(samples, jax.vmap(jax.random.uniform)(keys))
