"""The environment: Gymnasium's own check, agreement with a rollout, ends of episodes, seeds, and derivatives."""

import importlib.util
import warnings
from dataclasses import replace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import lgmdjax.environments
from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, policies
from lgmdjax.detectors import lgmd
from lgmdjax.environments import functional, gym_env, rewards
from lgmdjax.errors import InputError
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly, closed_loop, rollout, room_batches
from lgmdjax.world import arena

ID = "lgmdjax/Hexapod-v0"
FRAMES = 20
AHEAD = np.array([1.3, 1.3], np.float32)
assert lgmdjax.environments.functional is functional  # its import registers the environment


@pytest.fixture(scope="module")
def robot():
    """Small eyes, and policy direct, which turns by what they see."""
    direct = policies.DirectParams(rule=braitenberg.Params(), gain=jnp.asarray(20.0))
    return assembly.assemble(
        direct,
        detector_params=lgmd.Params(threshold=0.5, suppression=30.0),
        camera_params=camera.Params(width=32, height=24),
    )


def rooms(*starts):
    """One room with a box on the left, with these starts; always four, so that all share compiled programs."""
    boxes = arena.make_prisms([[0.75, 0.4]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    scene = arena.empty_room((5.0, 4.0), boxes=boxes)
    return room_batches.stack_rooms(
        [closed_loop.Room(arena=scene, starts=jnp.asarray(starts * (4 // len(starts))), key=jax.random.key(0))]
    )


FREE, INSIDE = (0.0, 0.0, 0.0), (0.5, 0.4, 0.0)  # half a metre from the box, and within it


@pytest.fixture(scope="module")
def make(robot):
    """Make the environment with small eyes; all share one compiled step."""

    def make(start=FREE, **changes):
        return gymnasium.make(ID, **{"robot": robot, "room": rooms(start), **changes}).unwrapped

    return make


@pytest.fixture(scope="module")
def vector(robot):
    """Two robots with lasers, whose joints are commanded, in episodes of four frames."""
    settings = {"robot": robot, "room": rooms(FREE, (-1.0, -1.0, 2.0)), "observation": "laser", "action": "joints"}
    return gymnasium.make_vec(ID, num_envs=2, seconds=4 / 30, **settings)


def test_gymnasium_finds_nothing_to_complain_of(make):
    """But that the actions have units instead of a range of -1 to 1."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized")
        check_env(make(render_mode="rgb_array", seconds=0.3))


def test_an_episode_is_a_rollout_of_the_same_robot_room_and_policy(make, robot):
    environment = make()
    u, _ = environment.reset(seed=1)
    room = environment.functional.room_of(environment.state)
    model = hexapod.build()

    @jax.jit
    def walk(room):
        state = closed_loop.init(robot, model, room, policies.DIRECT)
        return rollout.rollout(robot, model, room, state, policies.DIRECT, frames=FRAMES)[1]

    record = walk(room)
    assert np.ptp(np.asarray(record.velocity), axis=0).max() > 0.1  # the policy reacts to what it sees
    for frame in range(FRAMES - 1):
        np.testing.assert_allclose(u, record.u[frame], atol=1e-6)
        _, velocity = policies.DIRECT.step(robot.controller.policy, None, observe(jnp.asarray(u, float)))
        u, _, *ends, info = environment.step(np.asarray(velocity))
        np.testing.assert_allclose(info["position"], record.position[frame + 1], atol=1e-6)
        np.testing.assert_allclose(info["velocity"], record.velocity[frame], atol=1e-5)
        np.testing.assert_allclose(info["clearance"], record.clearance[frame], atol=1e-6)
        assert not any(ends)


def observe(u):
    zeros = jnp.zeros(2)
    return policies.Observation(u=u, feed_forward=zeros, excitation=zeros, distances=zeros, corridor=zeros)


def test_a_touch_terminates_and_costs(make):
    environment = make(INSIDE)
    environment.reset(seed=0)
    _, reward, terminated, truncated, info = environment.step(AHEAD)
    assert (terminated, truncated, bool(info["touched"]), bool(info["fell"])) == (True, False, True, False)
    assert reward == info["new_cells"] - rewards.END_COST


def test_a_fall_terminates_and_costs(make):
    environment = make()
    environment.reset(seed=0)
    data = environment.state.robot.data
    tilted = data.replace(qpos=data.qpos.at[3:7].set(jnp.asarray([np.cos(0.5), np.sin(0.5), 0, 0])))
    environment.state = replace(environment.state, robot=replace(environment.state.robot, data=tilted))
    _, reward, terminated, truncated, info = environment.step(AHEAD)
    assert (terminated, truncated, bool(info["fell"])) == (True, False, True)
    assert reward <= 1 - rewards.END_COST


def test_time_truncates(make):
    environment = make(seconds=3 / 30)
    environment.reset(seed=0)
    ends = [environment.step(AHEAD)[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_a_seed_gives_the_same_episodes_and_another_one_others(robot, make):
    several = {"room": rooms(FREE, (-1.0, 1.0, 0.5), (-1.0, -1.0, 2.0), (1.0, -1.0, 1.0))}
    first, second = make(**several), make(**several)

    def starts(environment, seed):
        environment.reset(seed=seed)
        first = int(environment.state.start)
        return [first, *(int((environment.reset(), environment.state.start)[1]) for _ in range(7))]

    assert starts(first, 5) == starts(second, 5)
    assert starts(first, 5) != starts(second, 6)
    assert len(set(starts(first, 5))) > 2


def test_a_vector_begins_the_next_episode_in_the_step_after_an_end(vector):
    assert vector.metadata["jax"] and vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    ranges, _ = vector.reset(seed=2)
    assert (
        isinstance(ranges, jax.Array)
        and ranges.shape == (2, 341)
        and vector.observation_space.contains(np.asarray(ranges))
    )
    stance = jnp.broadcast_to(jnp.asarray(hexapod.stance().ravel()), (2, 18))
    frames, truncations, rewarded = [], [], []
    for _ in range(6):
        _, reward, terminated, truncated, _ = vector.step(stance)
        frames.append(vector.state.robot.frame.tolist())
        truncations.append(truncated.tolist())
        rewarded.append(reward.tolist())
        assert not terminated.any()
    assert frames == [[n, n] for n in (1, 2, 3, 4, 0, 1)]
    assert truncations == [[n == 4] * 2 for n in (1, 2, 3, 4, 5, 6)]
    assert rewarded[4] == [0.0, 0.0]


def test_joint_commands_move_the_joints_that_they_name(vector):
    """Held at its stance the robot stands still; then the coxa of its right front leg alone turns."""
    vector.reset(seed=0)
    targets = np.tile(hexapod.stance().ravel(), (2, 1))
    targets[1, 15] += 0.2
    for _ in range(3):
        vector.step(jnp.asarray(targets))
    still, moved = np.asarray(jax.vmap(hexapod.joint_angles)(vector.state.robot.data))
    np.testing.assert_allclose(still, hexapod.stance(), atol=0.1)
    change = np.abs(moved - still)
    assert change[5, 0] > 0.05 and change[5, 0] == change.max()


@pytest.mark.extended
def test_the_derivative_of_a_reward_is_that_of_central_differences(robot):
    """Through three frames of physics and the laser's scan, by the commanded velocities."""
    environment = functional.make(robot=robot, room=rooms(FREE), observation="laser", reward="floor")

    def total(action):
        def frame(state, _):
            transition = environment.step(jax.random.key(0), state, action)
            return transition.state, transition.reward

        return jnp.sum(jax.lax.scan(frame, environment.reset(jax.random.key(0))[1], length=3)[1])

    along = jax.jit(lambda action, direction: jax.jvp(total, (action,), (direction,)))
    action, direction, step = jnp.asarray([1.1, 0.9]), jnp.asarray([1.0, 0.4]), 1e-5
    (high, _), (low, _), (_, derivative) = (along(action + n * step * direction, direction) for n in (1, -1, 0))
    np.testing.assert_allclose(derivative, (high - low) / (2 * step), rtol=1e-3)
    assert abs(float(derivative)) > 1e-5


def test_spaces_have_the_documented_bounds(robot):
    one = {"robot": robot, "room": rooms(FREE)}
    laser = functional.make(observation="laser", action="joints", **one)
    pixels = functional.make(observation="pixels", **one)
    assert gym_env.observation_space(laser).high.tolist() == [5.0] * 341
    np.testing.assert_allclose(gym_env.action_space(laser).high[:3], np.deg2rad([75, 100, 67]), rtol=1e-6)
    assert gym_env.observation_space(pixels) == gymnasium.spaces.Box(0, 255, (2, 24, 32), np.uint8)
    assert gym_env.action_space(pixels) == gymnasium.spaces.Box(-1.0, 2.0, (2,), np.float32)
    for environment in (laser, pixels):
        seen, _ = jax.eval_shape(environment.reset, jax.random.key(0))
        assert seen.shape == gym_env.observation_space(environment).shape


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observation": "smell"}, r"observation: expected one of lgmd, pixels, laser, got 'smell'"),
        ({"action": "jump"}, r"action: expected one of velocity, joints, got 'jump'"),
        ({"room": "attic"}, r"room: expected random, a batch of rooms, or one of testing, .*got 'attic'"),
        ({"reward": "praise"}, r"reward: expected cells or floor or a function of the outcome, got 'praise'"),
        ({"seconds": 0.0}, r"seconds: expected at least one frame"),
        ({"render_mode": "human"}, r"render_mode: expected None or rgb_array, got 'human'"),
    ],
)
def test_wrong_arguments_are_named(unchecked, robot, arguments, message):
    with pytest.raises(InputError, match=message):
        gym_env.HexapodEnv(**{"robot": robot, "room": rooms(FREE), **arguments})


def test_rooms_that_do_not_fit_are_refused(unchecked, robot):
    single = jax.tree.map(lambda leaf: leaf[0], rooms(FREE))
    with pytest.raises(InputError, match=r"expected a batch of rooms.*got \(4, 3\)"):
        functional.make(robot=robot, room=single)
    hall = replace(rooms(FREE), arena=jax.tree.map(lambda leaf: leaf[None], arena.empty_room((20.0, 4.0))))
    with pytest.raises(InputError, match=r"expected sides up to 16 m, got 20 m"):
        functional.make(robot=robot, room=hall)


def test_wrong_actions_are_named(make):
    environment = make()
    with pytest.raises(InputError, match=r"expected reset\(\) before step\(\)"):
        environment.step(AHEAD)
    environment.reset(seed=0)
    for wrong in (np.zeros(3), np.array([np.nan, 0.0])):
        with pytest.raises(InputError, match=r"action: expected \(2,\) finite numbers"):
            environment.step(wrong)


def test_without_gymnasium_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"expected gymnasium.*pip install 'lgmdjax\[gym\]'"):
        importlib.reload(gym_env)
