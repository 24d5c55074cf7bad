"""Keeping a heading: against a transcription of its equations in NumPy, and in the closed loop's decision."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import compass, policies
from lgmdjax.errors import InputError
from lgmdjax.simulation import assembly, closed_loop
from lgmdjax.world import arena

INTERVAL = 1 / 30
PARAMS = compass.Params(gain=1.2, max_turn=0.7, hard_turn=0.9, memory_time=3.0, drift=0.02)


def transcribed(velocities: np.ndarray, yaws: np.ndarray, wanted: float, drift: float) -> np.ndarray:
    """The equations of the module's docstring, for turns within the range of the gait."""
    memory, commanded = 0.0, []
    for frame, (velocity, yaw) in enumerate(zip(velocities, yaws, strict=True)):
        turn = velocity[1] - velocity[0]
        memory = max(memory * np.exp(-INTERVAL / 3.0), min(abs(turn) / 0.9, 1.0))
        measured = yaw + drift * INTERVAL * frame
        error = np.angle(np.exp(1j * (wanted - measured)))
        wish = (1 - memory) * np.clip(1.2 * error, -0.7, 0.7)
        commanded.append(velocity + np.array([-0.5, 0.5]) * wish)
    return np.array(commanded)


def test_it_equals_its_equations():
    rng = np.random.default_rng(0)
    turns = np.where(np.arange(300) % 90 < 20, rng.uniform(-0.5, 0.5, 300), 0.02 * rng.normal(size=300))
    velocities = 0.8 + np.array([-0.5, 0.5]) * turns[:, None]
    yaws = np.cumsum(rng.normal(size=300)) * 0.2
    state = compass.init(PARAMS, jnp.asarray(0.4), jnp.asarray(-0.5))

    def step(state, now):
        velocity, yaw = now
        return compass.step(PARAMS, state, velocity, yaw, INTERVAL)

    _, commanded = jax.lax.scan(step, state, (jnp.asarray(velocities), jnp.asarray(yaws)))
    np.testing.assert_allclose(commanded, transcribed(velocities, yaws, 0.4, -0.5 * 0.02), atol=1e-12)


def test_a_hard_turn_is_not_disturbed_and_is_remembered():
    state = compass.init(PARAMS, jnp.asarray(0.0), jnp.asarray(0.0))
    hard, straight = jnp.asarray([0.5, 1.5]), jnp.asarray([1.0, 1.0])
    state, commanded = compass.step(PARAMS, state, hard, jnp.asarray(1.0), INTERVAL)
    np.testing.assert_allclose(commanded, hard)

    def step(state, _):
        return compass.step(PARAMS, state, straight, jnp.asarray(1.0), INTERVAL)

    _, commanded = jax.lax.scan(step, state, length=400)
    wishes = np.asarray(commanded[:, 0] - commanded[:, 1])
    assert wishes[0] < 0.02
    assert np.all(np.diff(wishes) >= 0)
    np.testing.assert_allclose(wishes[-1], 0.7, rtol=0.02)  # to the right, as far as max_turn


def test_the_command_stays_within_the_range_of_the_gait():
    state = compass.init(PARAMS, jnp.asarray(0.0), jnp.asarray(0.0))
    _, commanded = compass.step(PARAMS, state, jnp.asarray([2.0, 2.0]), jnp.asarray(-2.0), INTERVAL)
    np.testing.assert_allclose(commanded, [1.3, 2.0])


@pytest.fixture(scope="module")
def blind():
    """The blind robot with a compass, in an empty room with starts of two headings."""
    robot = assembly.select_policy(assembly.with_compass(assembly.load_robot(), PARAMS), policies.BLIND)
    starts = jnp.asarray([[0.0, 0.0, 0.5], [1.0, 0.0, -2.0]])
    return robot, closed_loop.Room(arena=arena.empty_room(), starts=starts, key=jax.random.key(1))


def looking(state: closed_loop.State, yaw: float) -> closed_loop.State:
    """The state with the trunk turned to a heading."""
    quaternion = jnp.asarray([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    return replace(state, data=state.data.replace(qpos=state.data.qpos.at[3:7].set(quaternion)))


def test_the_robot_turns_back_to_the_heading_of_its_start(blind):
    robot, room = blind
    model = hexapod.build()
    state = closed_loop.init(robot, model, room, policies.SWITCH)
    observation = policies.Observation(**dict.fromkeys(("u", "feed_forward", "excitation"), jnp.zeros(2)),
                                       distances=jnp.full(2, 3.0), corridor=jnp.full(2, 3.0))  # fmt: skip
    for yaw, wish in ((0.5, 0.0), (0.0, 0.6), (1.5, -0.7)):
        decided, label = closed_loop.decide(robot, looking(state, yaw), observation, policies.SWITCH)
        turn = decided.controller.velocity[1] - decided.controller.velocity[0]
        np.testing.assert_allclose(turn, wish, atol=1e-6)
        np.testing.assert_allclose(label[0], label[1])  # the teacher's label is that without a heading
    reset = closed_loop.reset(robot, model, room, replace(state, contact=jnp.asarray(True)), policies.SWITCH)
    assert reset.heading is not None and state.heading is not None
    np.testing.assert_allclose(reset.heading.wanted, -2.0)
    assert abs(float(reset.heading.drift)) <= 0.02 and reset.heading.drift != state.heading.drift


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gain": -1.0}, "compass gain: expected a number of 0 or more, got -1.0"),
        ({"memory_time": 0.0}, "compass memory_time: expected a number above 0, got 0.0"),
        ({"drift": float("nan")}, "compass drift"),
        ({"hard_turn": float("inf")}, "compass hard_turn"),
    ],
)
def test_impossible_numbers_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        assembly.with_compass(assembly.load_robot(), compass.Params(**changes))
