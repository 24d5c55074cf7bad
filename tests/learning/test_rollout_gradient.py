"""Gradients of the imitation loss: three routes agree, `grad_path` holds what it says, fine-tuning resumes."""

import shutil
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import FAST_COMPILE, DerivativeCheck, inner_product, random_direction

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
def fast_compile():
    """Compile the gradient of a batch with fewer optimisations."""
    options = {"static_argnames": "settings", "donate_argnames": "states", "compiler_options": FAST_COMPILE}
    with pytest.MonkeyPatch.context() as patch:
        program: Any = rollout_gradient.gradient
        patch.setattr(rollout_gradient, "gradient", jax.jit(program.__wrapped__, **options))
        yield


@pytest.fixture(scope="module")
def params():
    """Return a robot with smooth thresholds.

    To compile faster, its CPG takes one Runge-Kutta step, and its cameras have few obstacles in a tile.
    """
    return assembly.assemble(
        navigator.create(jax.random.key(3)),
        detector_params=lgmd.Params(threshold=0.5, suppression=30.0, suppression_width=10.0, smooth=True),
        cpg_params=cpg.Params(substeps=1),
        camera_params=camera.Params(width=48, height=36, overlap=0.6, tile_capacity=2, bands=2),
    )


def before_a_box(ahead: float) -> closed_loop.Room:
    """Return a room with a box to the left, at a distance ahead [m]."""
    boxes = arena.make_prisms([[ahead, 0.4]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    scene = arena.empty_room((5.0, 4.0), boxes=boxes)
    return closed_loop.Room(arena=scene, starts=jnp.zeros((1, 3)), key=jax.random.key(0))


@pytest.fixture(scope="module")
def room():
    return before_a_box(0.75)


@pytest.fixture(scope="module")
def model():
    return hexapod.soften_contacts(hexapod.build())


@pytest.fixture(scope="module")
def rolled_out(params, room, model):
    """Roll out ten frames; return first and last state, record, and the gradient through the controller alone."""
    settings = rollout_gradient.Settings(frames=10, grad_path="controller")
    grad = jax.jit(
        jax.grad(rollout_gradient.loss, has_aux=True), static_argnames="settings", compiler_options=FAST_COMPILE
    )
    start = closed_loop.init(params, model, room, policies.LEARNED)
    gradient, (end, record) = grad(params.controller, params, model, room, start, settings=settings)
    return start, end, record, gradient


@pytest.fixture(scope="module")
def check(params, model, room, rolled_out):
    """Check derivatives of the commands' error over 15 frames, each with a weight of its own."""

    def weighted_error(controller_params, weights):
        settings = rollout_gradient.Settings(frames=len(weights))
        _, (_, record) = rollout_gradient.loss(controller_params, params, model, room, rolled_out[1], settings=settings)
        return weights @ jnp.mean((record.velocity - record.label) ** 2, axis=-1)

    return DerivativeCheck(weighted_error)


@pytest.mark.slow
def test_three_routes_agree_over_15_frames(params, check):
    weights = jnp.asarray(np.full(15, 1 / 15))
    check.assert_agree(params.controller, weights, step=1e-7)
    check.assert_every_leaf_agrees(params.controller, weights)


def test_three_routes_agree_over_one_frame(params, check):
    """From one command to the next: legs, body, cameras, detector and network."""
    weights = jnp.asarray(np.eye(15)[1])
    check.assert_agree(params.controller, weights)
    check.assert_every_leaf_agrees(params.controller, weights)


def test_the_gradient_through_the_controller_is_that_of_imitation_on_the_recorded_walk(params, rolled_out):
    """The navigator alone, on the recorded u, with constant labels."""
    start, _, record, gradient = rolled_out

    def imitation_loss(policy_params):
        observations = policies.Observation(
            u=record.u,
            feed_forward=record.feed_forward,
            excitation=record.excitation,
            distances=record.distances,
            corridor=record.corridor,
        )
        _, velocity = jax.lax.scan(partial(policies.LEARNED.step, policy_params), start.controller.policy, observations)
        return jnp.mean((velocity - record.label) ** 2)

    expected = jax.grad(imitation_loss)(params.controller.policy)
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(expected.weights))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-12), gradient.policy, expected)
    others = (gradient.detector, gradient.cpg, gradient.shaping)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(others))


@pytest.fixture(scope="module")
def rooms():
    """Return rooms with the box farther away, where the label is below the hardest turn and depends on the distance."""
    return room_batches.stack_rooms([before_a_box(1.4)] * 4)


WITHOUT_RENDERING = rollout_gradient.Settings(frames=2, render=False, grad_path="body", clip=1.0)


@pytest.fixture(scope="module")
def batch_gradient(params, model, rooms):
    """Return a function that takes the gradient of four robots without rendering, from a list of states."""
    shard = jax.jit(lambda states: sharding.shard_robots(lambda same: same, states))  # as a rollout leaves them
    scales = jax.tree.map(jnp.ones_like, finetuning.param_scales(params.controller, ()))

    def run(states, controller_params=params.controller):
        batch = shard(jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
        return rollout_gradient.gradient(
            replace(params, controller=controller_params), model, rooms, batch, scales, settings=WITHOUT_RENDERING
        )

    return run


@pytest.mark.extended
@pytest.mark.slow
def test_the_gradient_through_the_body_is_complete_without_rendering(params, batch_gradient, rolled_out):
    """It equals central differences, and reaches the legs, since the label depends on where the robot is.

    The detector is left out: it still compares its last image with black.
    """
    found, _, _ = batch_gradient([rolled_out[1]] * 4)
    grad = found.grad  # all norms are equal, so none is clipped
    tangent, step = random_direction(params.controller), 1e-6
    tangent = replace(tangent, detector=jax.tree.map(jnp.zeros_like, tangent.detector))
    ends = [
        batch_gradient([rolled_out[1]] * 4, jax.tree.map(lambda x, dx, by=by: x + by * dx, params.controller, tangent))[
            0
        ].loss
        for by in (step, -step)
    ]
    np.testing.assert_allclose(inner_product(grad, tangent), (ends[0] - ends[1]) / (2 * step), rtol=1e-5)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(grad.detector))
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves((grad.shaping, grad.cpg.cycle_time)))


@pytest.mark.extended
def test_a_batch_has_the_mean_gradient_of_its_finite_robots(batch_gradient, rolled_out):
    """One robot of four is not finite and is left out; gradients are clipped to the median norm."""
    end = rolled_out[1]
    ahead = end.data.qpos.at[0].add(0.1)
    others = [end, replace(end, data=end.data.replace(qpos=ahead)), replace(end, contact=~end.contact)]
    alone = [batch_gradient([state] * 4)[0] for state in others]
    broken = replace(end, data=end.data.replace(qpos=end.data.qpos.at[0].set(jnp.nan)))
    found, states, record = batch_gradient([others[0], others[1], broken, others[2]])
    assert found.nonfinite.tolist() == [False, False, True, False]
    assert record.u.shape == (4, 2, 2) and states.frame[0] == end.frame + 2
    norms = np.array([other.norms[0] for other in alone])
    np.testing.assert_allclose(found.norms[jnp.asarray([0, 1, 3])], norms, rtol=1e-8)
    np.testing.assert_allclose(found.loss, np.mean([other.loss for other in alone]), rtol=1e-10)
    assert norms.max() > np.median(norms)
    each = np.stack([np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(other.grad)]) for other in alone])
    each *= np.minimum(1, np.median(norms) / norms)[:, None]
    grad = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(found.grad)])
    np.testing.assert_allclose(grad, each.mean(axis=0), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.standard_error, np.sqrt(np.sum(each.var(axis=0, ddof=1)) / 3), rtol=1e-6)


@pytest.fixture
def finetune(params, model, rooms, batch_gradient, tmp_path):
    """Return a function that fine-tunes policy and CPG in two rooms of two windows, interrupted or not."""

    def run(interrupt_after=None):
        reported = []

        def on_window(row):
            reported.append(row)
            if len(reported) == interrupt_after:
                raise KeyboardInterrupt

        settings = finetuning.Settings(windows_per_room=2, rooms=2, learning_rate=1e-3, trainable=("policy", "cpg"))
        with closing(Checkpoints(tmp_path, {"test": 1})) as saved:
            found = finetuning.finetune(
                params, model, lambda _: rooms, WITHOUT_RENDERING, settings, checkpoints=saved, on_window=on_window
            )
        return *found, reported

    return run


@pytest.mark.extended
def test_fine_tuning_changes_trainable_parameters_and_reports_every_window(params, finetune):
    """By about the learning rate, as Adam does; scaling constants stay; one program serves all windows."""
    program: Any = rollout_gradient.gradient
    before = program._cache_size()
    tuned, rows, reported = finetune()
    assert reported == rows and len(rows) == 4 and np.isfinite(rows).all()
    assert all(row.nonfinite == row.fallen == row.contacts == 0 < row.median_norm <= row.max_norm for row in rows)
    assert program._cache_size() == max(before, 1)
    before, after = params.controller, tuned.controller
    jax.tree.map(np.testing.assert_array_equal, (before.detector, before.shaping), (after.detector, after.shaping))
    for name in ("input_mean", "input_scale", "output_mean", "output_scale"):
        np.testing.assert_array_equal(getattr(before.policy, name), getattr(after.policy, name))
    changed = np.abs(after.cpg.cycle_time / before.cpg.cycle_time - 1)
    assert 0 < changed < 4e-3
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (before.policy, after.policy)), strict=True))


@pytest.mark.extended
def test_interrupted_fine_tuning_resumes_after_its_last_room(finetune, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        finetune(interrupt_after=3)
    resumed, rows, reported = finetune()
    assert len(reported) == 2 and len(rows) == 4
    shutil.rmtree(tmp_path)
    whole, again, _ = finetune()
    assert rows == again
    jax.tree.map(np.testing.assert_array_equal, resumed.controller, whole.controller)


def test_a_robot_with_its_navigator_only_and_smooth_thresholds():
    robot = rollout_gradient.smooth_thresholds(rollout_gradient.learned_only(assembly.load_robot()))
    detector = robot.controller.detector
    assert detector.smooth and isinstance(robot.controller.policy, navigator.Params)
    np.testing.assert_allclose(detector.suppression_width, 0.3 * detector.suppression)
    assert all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(robot.controller))
