"""The live simulation's inputs: what the controls change, and that no change needs another program."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from reference import lgmd as reference

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.control.policies import Observation
from lgmdjax.detectors import lgmd
from lgmdjax.reporting.playback import LAYER_WHITE
from lgmdjax.reporting.room_shape import centres_of
from lgmdjax.simulation import assembly, room_batches
from lgmdjax.viewer import edits, live, live_step
from lgmdjax.viewer.messages import Controls

OBSERVATION = Observation(
    u=jnp.array([0.7, 0.55]),
    feed_forward=jnp.zeros(2),
    excitation=jnp.zeros(2),
    distances=jnp.array([0.9, 1.4]),
    corridor=jnp.array([0.9, 1.4]),
)


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


@pytest.fixture(scope="module")
def room():
    return jax.tree.map(lambda leaf: leaf[0], room_batches.random_rooms(jax.random.key(0), 1))


def velocity(robot, controls: Controls) -> np.ndarray:
    params = live_step.steer(robot, controls).controller.policy
    state = live_step.STEERED.init(params, jax.random.key(0))
    return np.asarray(live_step.STEERED.step(params, state, OBSERVATION)[1])


@pytest.mark.parametrize("policy", policies.POLICIES, ids=lambda policy: policy.name)
def test_without_gains_a_policy_commands_what_it_always_does(robot, policy):
    own = robot.controller.policy.policies[policies.POLICIES.index(policy)]
    expected = policy.step(own, policy.init(own, jax.random.key(0)), OBSERVATION)[1]
    np.testing.assert_allclose(velocity(robot, Controls(policy=policy.name)), expected, atol=1e-6)


def test_turn_gain_and_speed_scale_turn_and_mean_within_the_range_of_the_gait(robot):
    left, right = velocity(robot, Controls(policy="teacher"))
    mean, turn = (left + right) / 2, right - left
    slower = velocity(robot, Controls(policy="teacher", turn_gain=0.5, speed=0.8))
    np.testing.assert_allclose([slower.mean(), slower[1] - slower[0]], [0.8 * mean, 0.5 * turn], atol=1e-6)
    harder = velocity(robot, Controls(policy="teacher", turn_gain=3.0, speed=2.0))
    assert harder.max() <= 2 + 1e-9 and harder.min() >= -1 - 1e-9 and abs(harder[1] - harder[0]) > abs(turn)


def test_the_detectors_get_the_constants_of_the_controls(robot):
    detector = live_step.steer(robot, Controls(threshold=3.0, inhibition=0.7)).controller.detector
    assert (float(detector.threshold), float(detector.inhibition)) == (3.0, 0.7)
    assert float(detector.suppression) == float(robot.controller.detector.suppression)


def test_no_control_needs_another_program(robot, room):
    """A program is compiled for shapes and types (`export_cache`), so these may not depend on any control."""

    def types(*trees: object) -> object:
        return jax.tree.structure(trees), [str(jax.typeof(leaf)) for leaf in jax.tree.leaves(trees)]

    model = hexapod.build()
    params = live_step.steer(robot, Controls())
    state = live_step.start(params, model, room)
    before = types(params, room, state)
    other = live_step.steer(robot, Controls(policy="blind", threshold=1.0, suppression=9.0, inhibition=0.2, speed=0.5))
    moved = replace(room, arena=edits.move(edits.move(room.arena, 0, 1.0, 1.0), 13, 0.5, -1.0))
    placed = live_step.place(params, model, room, state, jnp.array([1.0, -0.5, 2.0]))
    assert types(other, moved, placed) == before
    for name in ("random", "dynamic"):
        assert types(live.sample_room(name, 3)) == types(room)
    np.testing.assert_allclose(placed.data.qpos[:2], [1.0, -0.5], atol=1e-6)
    yaw = 2 * np.arctan2(float(placed.data.qpos[6]), float(placed.data.qpos[3]))
    assert yaw == pytest.approx(2.0, abs=1e-6) and bool(placed.is_first) and not bool(placed.contact)


def test_moving_an_obstacle_moves_it_alone(room):
    boxes = len(room.arena.boxes.top)
    for index in (1, boxes + 2):
        moved = edits.move(room.arena, index, 0.25, -0.75)
        expected = centres_of(room.arena)
        expected[index] = 0.25, -0.75
        np.testing.assert_allclose(centres_of(moved), expected, rtol=1e-6)


def test_layers_are_those_of_the_paper():
    generator = np.random.default_rng(1)
    frames = generator.uniform(0, 12, (4, 6, 8))
    params = lgmd.Params(inhibition=0.3)
    state = lgmd.init(params, jnp.asarray(frames[0]))
    for frame in frames[1:3]:
        state, _ = lgmd.step(params, state, jnp.asarray(frame))
    after, _ = lgmd.step(params, state, jnp.asarray(frames[3]))
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (state, after))
    layers = np.asarray(live_step._layers(params, both[0].difference, both[1], jnp.asarray(False)))
    expected = reference.lgmd(frames, 6.0, 20.0, 0.3)[-1]
    for layer, name, factor in zip(layers[0], "EIS", (1.0, 0.3, 1.0), strict=True):
        value = expected[name] if name == "S" else factor * np.abs(expected[name])
        assert np.abs(layer - 255 * np.clip(value / LAYER_WHITE, 0, 1)).max() <= 1
    np.testing.assert_array_equal(layers[1], layers[0][:, :, ::-1])  # the right LGMD sees its picture mirrored


def test_an_unknown_room_is_one_line():
    with pytest.raises(Exception, match="expected the name of a room, got 'nowhere'; choose one of random, testing"):
        live.sample_room("nowhere", 0)


def test_a_kept_walk_is_read_with_every_move_of_an_obstacle(room, robot, tmp_path, monkeypatch):
    films = []
    monkeypatch.setattr("lgmdjax.reporting.walk_video.write_trace", lambda *arguments, **_: films.append(arguments))
    record = synthetic.walk(1, 30)
    recording = edits.LiveRecording(room.arena)
    arena = room.arena
    for frame in range(30):
        if frame in (10, 11, 20):
            arena = edits.move(arena, 2, 0.1 * frame, -1.0)
        recording.append(jax.tree.map(lambda leaf, frame=frame: leaf[0, frame], record), centres_of(arena))
    folder = recording.write(tmp_path / "kept", robot, "learned", {"room": "random", "seed": 0})
    assert [path.name for path in folder.glob("*.parquet")] == ["chunk-00000.parquet"]
    from lgmdjax.simulation import episodes

    live_header = episodes.read_parameters(folder)["live"]
    read, centres = edits.read_edits(live_header, 30, folder)
    np.testing.assert_allclose(centres, np.stack(recording.centres), rtol=1e-6)
    np.testing.assert_allclose(read.boxes.half_size, room.arena.boxes.half_size, rtol=1e-6)
    assert films[0][2].bounds.shape == (30, 4)  # the film has the room of each frame
    with pytest.raises(Exception, match="expected an empty or a new folder"):
        recording.write(folder, robot, "learned", {"room": "random", "seed": 0})
