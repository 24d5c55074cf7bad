"""The imitation loss of whole frames: its derivative by three routes, what each choice of it holds, and who counts."""

import shutil
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slopes import QUICKLY_COMPILED, Routes, along, direction

from lgmdjax.body import hexapod
from lgmdjax.control import navigator, policies
from lgmdjax.detectors import lgmd
from lgmdjax.learning import finetuning, rollout_gradient
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.locomotion import cpg
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly, closed_loop, room_batches, sharding
from lgmdjax.world import arena


@pytest.fixture(scope="module", autouse=True)
def quickly():
    """Compile the gradient of a crowd without optimising it, here and in what follows it."""
    how = {"static_argnames": "settings", "donate_argnames": "states", "compiler_options": QUICKLY_COMPILED}
    with pytest.MonkeyPatch.context() as patch:
        program: Any = rollout_gradient.gradient
        patch.setattr(rollout_gradient, "gradient", jax.jit(program.__wrapped__, **how))
        yield


@pytest.fixture(scope="module")
def params():
    """A robot that looks and walks, its thresholds smooth.

    To compile the less, its rhythm takes one Runge-Kutta step, and its eyes sort few prisms.
    """
    return closed_loop.assemble(
        navigator.create(jax.random.key(3)),
        detector=lgmd.Params(threshold=0.5, suppression=30.0, suppression_width=10.0, smooth=True),
        rhythm=cpg.Params(substeps=1),
        eyes=camera.Params(width=48, height=36, overlap=0.6, slots=2, bands=2),
    )


def before_a_box(ahead: float) -> closed_loop.Room:
    """A start with a box to the left, so far ahead [m]."""
    boxes = arena.place([[ahead, 0.4]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    scene = arena.empty_room((5.0, 4.0), boxes=boxes)
    return closed_loop.Room(arena=scene, starts=jnp.zeros((1, 3)), key=jax.random.key(0))


@pytest.fixture(scope="module")
def room():
    return before_a_box(0.75)


@pytest.fixture(scope="module")
def model():
    return hexapod.softened(hexapod.build())


@pytest.fixture(scope="module")
def walked(params, room, model):
    """Ten frames: where they end, what they left behind, and the gradient through the controller alone."""
    settings = rollout_gradient.Settings(frames=10, through="controller")
    walk = jax.jit(jax.grad(rollout_gradient.loss, has_aux=True), static_argnums=5, compiler_options=QUICKLY_COMPILED)
    start = closed_loop.init(params, model, room, policies.LEARNED)
    gradient, (end, record) = walk(params.controller, params, model, room, start, settings)
    return start, end, record, gradient


@pytest.fixture(scope="module")
def routes(params, model, room, walked):
    """The error of 15 frames' commands, each frame by its own weight."""

    def told(nerves, weights):
        settings = rollout_gradient.Settings(frames=len(weights))
        _, (_, record) = rollout_gradient.loss(nerves, params, model, room, walked[1], settings)
        return weights @ jnp.mean((record.velocity - record.label) ** 2, axis=-1)

    return Routes(told)


@pytest.mark.slow
def test_15_frames_through_everything_have_one_derivative_by_three_routes(params, routes):
    weights = jnp.asarray(np.full(15, 1 / 15))
    routes.assert_agree(params.controller, weights, step=1e-7)
    routes.assert_every_leaf_agrees(params.controller, weights)


def test_one_whole_frame_has_one_derivative_by_three_routes(params, routes):
    """From one command to the next: legs, body, eyes, detector and network."""
    weights = jnp.asarray(np.eye(15)[1])
    routes.assert_agree(params.controller, weights)
    routes.assert_every_leaf_agrees(params.controller, weights)


def test_through_the_controller_it_is_that_of_imitation_on_what_was_recorded(params, walked):
    """The navigator alone, shown again the u of the walk, against labels that do not move."""
    start, _, record, gradient = walked

    def recorded(driver):
        senses = policies.Senses(
            u=record.u,
            feed_forward=record.feed_forward,
            excitation=record.excitation,
            distances=record.distances,
        )
        _, velocity = jax.lax.scan(partial(policies.LEARNED.step, driver), start.controller.driver, senses)
        return jnp.mean((velocity - record.label) ** 2)

    expected = jax.grad(recorded)(params.controller.driver)
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(expected.weights))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-12), gradient.driver, expected)
    others = (gradient.lgmd, gradient.cpg, gradient.shaping)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(others))


@pytest.fixture(scope="module")
def rooms():
    """The box farther away, where the rule does not ask for all of a turn: its label hangs on every millimetre."""
    return room_batches.stack([before_a_box(1.4)] * 4)


SHUT = rollout_gradient.Settings(frames=2, draw=False, through="nerves", clip=1.0)


@pytest.fixture(scope="module")
def crowd(params, model, rooms):
    """Take the gradient of a crowd of four, their eyes shut: states, nerves -> gradient, states, record."""
    dealt = jax.jit(lambda states: sharding.deal(lambda same: same, states))  # as those of a walk are
    whole = jax.tree.map(jnp.ones_like, finetuning.sizes(params.controller, ()))

    def run(states, nerves=params.controller):
        batch = dealt(jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
        return rollout_gradient.gradient(replace(params, controller=nerves), model, rooms, batch, whole, settings=SHUT)

    return run


@pytest.mark.slow
def test_through_the_nerves_it_is_the_whole_derivative_of_a_robot_with_its_eyes_shut(params, crowd, walked):
    """By differences; and it reaches the legs: where they carry the robot changes what the rule says.

    Of the detector alone it knows nothing: that still compares its last picture with the dark.
    """
    found, _, _ = crowd([walked[1]] * 4)
    slope = found.slope  # all are alike: none is cut
    tangent, step = direction(params.controller), 1e-6
    tangent = replace(tangent, lgmd=jax.tree.map(jnp.zeros_like, tangent.lgmd))
    ends = [
        crowd([walked[1]] * 4, jax.tree.map(lambda x, dx, by=by: x + by * dx, params.controller, tangent))[0].loss
        for by in (step, -step)
    ]
    np.testing.assert_allclose(along(slope, tangent), (ends[0] - ends[1]) / (2 * step), rtol=1e-5)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(slope.lgmd))
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves((slope.shaping, slope.cpg.cycle_time)))


def test_a_crowd_has_the_mean_gradient_of_those_that_are_sound(crowd, walked):
    """One of four is sick: it is left out. What is longer than the middle one is cut to that."""
    end = walked[1]
    ahead = end.data.qpos.at[0].add(0.1)
    others = [end, replace(end, data=end.data.replace(qpos=ahead)), replace(end, touched=~end.touched)]
    alone = [crowd([state] * 4)[0] for state in others]
    sick = replace(end, data=end.data.replace(qpos=end.data.qpos.at[0].set(jnp.nan)))
    found, states, record = crowd([others[0], others[1], sick, others[2]])
    assert found.lost.tolist() == [False, False, True, False]
    assert record.u.shape == (4, 2, 2) and states.frame[0] == end.frame + 2
    norms = np.array([other.norms[0] for other in alone])
    np.testing.assert_allclose(found.norms[jnp.asarray([0, 1, 3])], norms, rtol=1e-8)
    np.testing.assert_allclose(found.loss, np.mean([other.loss for other in alone]), rtol=1e-10)
    assert norms.max() > np.median(norms)
    each = np.stack([np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(other.slope)]) for other in alone])
    each *= np.minimum(1, np.median(norms) / norms)[:, None]
    slope = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(found.slope)])
    np.testing.assert_allclose(slope, each.mean(axis=0), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.noise, np.sqrt(np.sum(each.var(axis=0, ddof=1)) / 3), rtol=1e-6)


@pytest.fixture
def tune(params, model, rooms, crowd, tmp_path):
    """Tune driver and rhythm for two rooms of two windows; killed after so many of them, or not."""

    def run(killed_after=None):
        told = []

        def tell(row):
            told.append(row)
            if len(told) == killed_after:
                raise KeyboardInterrupt

        how = finetuning.Settings(windows=2, rooms=2, learning_rate=1e-3, parts=("driver", "cpg"))
        with closing(Checkpoints(tmp_path, {"tune": 1})) as saved:
            return *finetuning.tune(params, model, lambda _: rooms, SHUT, how, saved=saved, tell=tell), told

    return run


def test_tuning_changes_the_parts_asked_for_and_tells_of_every_window(params, tune):
    """By about the rate, as Adam does; the means and deviations of the data stay; all in one program."""
    program: Any = rollout_gradient.gradient
    before = program._cache_size()
    tuned, rows, told = tune()
    assert told == rows and len(rows) == 4 and np.isfinite(rows).all()
    assert all(row.lost == row.fallen == row.touches == 0 < row.norm <= row.largest for row in rows)
    assert program._cache_size() == max(before, 1)
    before, after = params.controller, tuned.controller
    jax.tree.map(np.testing.assert_array_equal, (before.lgmd, before.shaping), (after.lgmd, after.shaping))
    for name in ("input_mean", "input_scale", "output_mean", "output_scale"):
        np.testing.assert_array_equal(getattr(before.driver, name), getattr(after.driver, name))
    changed = np.abs(after.cpg.cycle_time / before.cpg.cycle_time - 1)
    assert 0 < changed < 4e-3
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (before.driver, after.driver)), strict=True))


def test_an_interrupted_tune_carries_on_from_its_last_room(tune, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        tune(killed_after=3)
    resumed, rows, told = tune()
    assert len(told) == 2 and len(rows) == 4
    shutil.rmtree(tmp_path)
    whole, again, _ = tune()
    assert rows == again
    jax.tree.map(np.testing.assert_array_equal, resumed.controller, whole.controller)


def test_a_robot_can_have_its_navigator_alone_and_smooth_thresholds():
    robot = rollout_gradient.smooth(rollout_gradient.alone(assembly.trained()))
    detector = robot.controller.lgmd
    assert detector.smooth and isinstance(robot.controller.driver, navigator.Params)
    np.testing.assert_allclose(detector.suppression_width, 0.3 * detector.suppression)
    assert all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(robot.controller))
