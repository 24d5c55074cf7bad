"""Finetuning in the closed loop: what it may change, for how long each learner trains, and how it is scored."""

import json
from dataclasses import asdict, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.cli import flags, study
from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.learning import dagger, finetuning, rollout_gradient
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.locomotion import shaping
from lgmdjax.pipeline import scales
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import tracking
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, recording, room_batches
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies import closed_loop_finetune
from lgmdjax.studies.settings import FinetuneSettings

EYES = CameraSettings(width=80, height=60, pooling=3, ground=0.5, falloff=2.0)  # of the pretrained robot
DAGGER = TrainSettings(eyes=EYES, epochs=1, dagger_rounds=2, round_epochs=1, robots=4, round_seconds=3.0)
SETTINGS = FinetuneSettings(
    benchmark=BenchmarkRooms(eyes=EYES, robots=2, seconds=2.0), dagger=DAGGER, demonstration_seconds=3.0, window=15,
    horizons=(5, 45), learning_rate=6e-3, clip=10.0, seeds=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


@pytest.fixture(scope="module")
def params(robot):
    return rollout_gradient.smooth_thresholds(rollout_gradient.learned_only(robot)).controller


def by_name(params) -> dict[str, np.ndarray]:
    found = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in found}


def noise_like(tree, size: float):
    generator = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: jnp.asarray(generator.normal(0, size, leaf.shape)), tree)


def test_a_joint_fit_trains_weights_and_three_constants_but_no_means_or_widths(params):
    scales = by_name(finetuning.param_scales(params, closed_loop_finetune.JOINT_PARTS))
    trained = {name for name, scale in scales.items() if np.any(scale)}
    constants = {"detector.threshold", "detector.suppression", "detector.inhibition"}
    assert trained == constants | {name for name in scales if name.startswith(("policy.weights.", "shaping."))}
    own = by_name(params)
    assert all(scales[name] == own[name] for name in constants)
    w1 = float(np.sqrt(np.mean(own["shaping.w1"] ** 2)))
    assert float(scales["shaping.w1"]) == pytest.approx(w1, abs=2e-3)


@pytest.mark.parametrize("part", ["detector.thresh", "eyes", "policy.weight"])
def test_an_unknown_parameter_is_refused(params, part):
    with pytest.raises(InputError, match=rf"expected some of .*shaping\.w1.* got {part}"):
        finetuning.param_scales(params, ("shaping", part))


def test_constants_keep_their_sign_and_zeros_after_any_update(params):
    scales = finetuning.param_scales(params, ("detector", "cpg"))
    updates = jax.tree.map(lambda leaf, scale: jnp.sign(scale) * leaf, noise_like(params, 3.0), scales)
    after = finetuning.apply_update(params, updates, scales)
    for name, leaf in by_name((params.detector, params.cpg)).items():
        np.testing.assert_array_equal(np.sign(leaf), np.sign(by_name((after.detector, after.cpg))[name]))
    assert after.detector.kernel[2, 2] == 0 and not np.any(np.diag(after.cpg.coupling))
    np.testing.assert_allclose(after.detector.threshold, params.detector.threshold * np.exp(updates.detector.threshold))
    assert after.detector.threshold_width == params.detector.threshold_width
    jax.tree.map(np.testing.assert_array_equal, (after.policy, after.shaping), (params.policy, params.shaping))


def test_a_symmetrised_gradient_keeps_the_gait_mirror_symmetric(params):
    """Mirrored CPG signals and velocities give mirrored joint angles after the update."""
    grad = finetuning.symmetrise(noise_like(params, 0.05))
    changed = finetuning.apply_update(params, grad, finetuning.param_scales(params, ("shaping",))).shaping
    assert np.abs(changed.w1 - params.shaping.w1).max() > 1e-2
    signal = jnp.asarray(np.random.default_rng(3).normal(size=(6, 2)))
    angles = shaping.apply(changed, signal, jnp.asarray([1.3, 0.4]))
    mirrored = shaping.apply(changed, signal[::-1], jnp.asarray([0.4, 1.3]))
    np.testing.assert_allclose(mirrored, angles[::-1] * np.array([-1.0, 1.0, 1.0]), atol=1e-6)
    again = finetuning.symmetrise(grad)
    jax.tree.map(np.testing.assert_allclose, again, grad)


def test_finetuned_params_go_into_the_robot_whose_thresholds_stay_hard(robot, params):
    """The robot keeps its structure, so that it runs in the compiled program of all others."""
    changed = jax.tree.map(lambda leaf: 1.01 * leaf, params)
    after = closed_loop_finetune.with_finetuned_params(robot, changed)
    assert jax.tree.structure(after) == jax.tree.structure(robot) and not after.controller.detector.smooth
    assert after.controller.detector.threshold_width == robot.controller.detector.threshold_width
    back = rollout_gradient.learned_only(after).controller
    jax.tree.map(np.testing.assert_array_equal, (back.policy, back.shaping), (changed.policy, changed.shaping))
    expected = {name: 1.01 * float(getattr(params.detector, name)) for name in lgmd.SCALARS}
    assert closed_loop_finetune.detector_constants(after) == pytest.approx(expected)


def test_summary_has_approaches_and_the_imitation_loss():
    clearance = np.full((2, 600), 0.3)
    clearance[0, 100:120], clearance[0, 200], clearance[1, 5:] = 0.05, 0.07, 0.0799
    label = np.zeros((2, 600, 2))
    label[..., 0] = 0.5  # on one side of two
    ok = np.ones((2, 600), bool)
    ok[1, 300:] = False
    label[1, 300:] = 9.0  # after the fall, does not count
    row = closed_loop_finetune.summarise(synthetic.walk(2, 600, clearance=clearance, label=label, ok=ok))
    assert row["approaches"] == 3 and row["imitation"] == pytest.approx(0.125)
    assert row["approaches_per_100_m"] == asdict(metrics.poisson_rate(3, row["distance"] / 100))


@pytest.fixture
def finetuned(monkeypatch):
    """Stand-ins for rollouts and fits; returns the arguments of every call of `finetune`."""
    calls = []

    def run_dagger(folder, robot, walks, settings, seed):
        return [*walks, settings.dagger_rounds]

    def fit_navigator(folder, walks, epochs, seed):
        learner = navigator.create(jax.random.key(seed), symmetric=True)
        return replace(learner, output_mean=jnp.full(2, float(sum(walks)))), []

    def finetune(params, model, sample_rooms, gradient_settings, settings, *, checkpoints, on_window, label):
        calls.append((params.controller, gradient_settings, settings))
        stats = finetuning.WindowStats(
            loss=0.5, signal=2.0, noise=1.0, median_norm=1.0, max_norm=3.0, nonfinite=0, fallen=0, contacts=0
        )
        on_window(stats)
        return params, [stats] * settings.rooms * settings.windows_per_room

    monkeypatch.setattr(
        recording, "record_rollouts", lambda folder, params, rooms, *_, **__: synthetic.walk(len(rooms.starts), 60)
    )
    monkeypatch.setattr(dagger, "record_demonstrations", lambda *_, **__: [])
    monkeypatch.setattr(dagger, "fit_navigator", fit_navigator)
    monkeypatch.setattr(dagger, "run", run_dagger)
    monkeypatch.setattr(finetuning, "finetune", finetune)
    return calls


def test_all_learners_train_for_the_same_time_and_have_a_row(finetuned, tmp_path):
    study.run_study("closed_loop_finetune", flags.StudyFlags(settings=SETTINGS, out=tmp_path))
    folder = tmp_path / "closed_loop_finetune-0" / "closed_loop_finetune"
    rows = json.loads((folder / "closed_loop_finetune.json").read_text())
    names = [*closed_loop_finetune.COLOURS, "everything, 5 frames", "everything, 45 frames"]
    assert sorted(row["learner"] for row in rows if row["repeat"] == 0) == sorted(names)
    assert sorted(row["learner"] for row in rows if row["repeat"] == 1) == sorted(closed_loop_finetune.COLOURS)
    curves = {(row["learner"], row["repeat"]): row["curve"]["seconds"] for row in rows if "curve" in row}
    time = DAGGER.dagger_rounds * DAGGER.robots * DAGGER.round_seconds
    for (name, _), seconds in curves.items():
        assert seconds[-1] == pytest.approx(time / 2 if name == "dagger + everything" else time)
    assert (folder / "closed_loop_finetune.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("unchecked")
def test_every_window_of_a_fit_is_logged(params, monkeypatch):
    """Two rooms of three windows, whose gradient is a stand-in."""
    found = rollout_gradient.Gradient(
        loss=jnp.asarray(0.25), grad=jax.tree.map(jnp.zeros_like, params), norms=jnp.ones(2),
        standard_error=jnp.asarray(0.5), nonfinite=jnp.zeros(2, bool),
    )  # fmt: skip
    monkeypatch.setattr(finetuning.rollout, "reset_batch", lambda *_, **__: None)
    gradient = lambda *_, **__: (found, None, synthetic.walk(2, 3))  # noqa: E731
    monkeypatch.setattr(rollout_gradient, "gradient", gradient)
    robot, logged = replace(assembly.load_robot(), controller=params), []
    unused: Any = None  # model and rooms, which the stand-ins ignore
    settings = finetuning.Settings(rooms=2, windows_per_room=3)
    with tracking.add_listener(lambda step, values: logged.append((step, values["joint/loss"], values["joint/noise"]))):
        finetuning.finetune(robot, unused, lambda _: unused, rollout_gradient.Settings(), settings, label="joint")
    assert logged == [(window, 0.25, 0.5) for window in range(1, 7)]


def test_learners_start_from_their_navigator_with_smooth_thresholds_and_equal_total_rate(finetuned, tmp_path):
    robot = assembly.with_camera(assembly.load_robot(), EYES)
    list(closed_loop_finetune.train_learners(tmp_path, robot, SETTINGS, 0, (5,)))
    assert [float(params.policy.output_mean[0]) for params, _, _ in finetuned] == [0, 0, 0, 1, 0]
    assert all(params.detector.smooth and window.clip == 10 for params, window, _ in finetuned)
    assert [window.grad_path for _, window, _ in finetuned] == ["controller", *["everything"] * 4]
    assert [settings.trainable for _, _, settings in finetuned] == [
        ("policy",), ("policy",), closed_loop_finetune.JOINT_PARTS, ("policy",), ("policy",)
    ]  # fmt: skip
    totals = [settings.learning_rate * settings.windows_per_room * settings.rooms for _, _, settings in finetuned]
    np.testing.assert_allclose(totals, 6e-3 * DAGGER.round_seconds * np.array([2, 2, 2, 1, 2]))
    assert len({jax.tree.structure(params) for params, _, _ in finetuned}) == 1


def test_rates_are_pooled_over_seeds_and_plotted_with_windows_that_are_not_finite():
    score: JsonObject = {"distance": 50.0, "collisions": 1, "approaches": 4}
    score["per_100_m"] = asdict(metrics.poisson_rate(1, 0.5))
    score["approaches_per_100_m"] = asdict(metrics.poisson_rate(4, 0.5))
    nan = float("nan")
    curve = {"loss": [0.4, nan, 0.2], "signal": [3.0, nan, 1.0], "noise": [1.0, nan, 0.0], "seconds": [8.0, 16.0, 24.0]}
    fit = {"curve": curve, "frames": 15}
    rows = [{"learner": "imitation", "repeat": repeat, **score} for repeat in range(3)]
    rows += [{"learner": "everything", "repeat": repeat, **score, **fit} for repeat in range(3)]
    rows += [{"learner": "everything, 5 frames", "repeat": 0, **score, **fit, "frames": 5}]
    pooled = closed_loop_finetune.pool_repeats(rows, "approaches")
    assert list(pooled) == ["imitation", "everything", "everything, 5 frames"]
    assert pooled["everything"] == metrics.poisson_rate(12, 1.5)
    np.testing.assert_allclose(closed_loop_finetune.signal_to_noise(rows[-1]), [3.0])
    figure = closed_loop_finetune.plot(rows)
    assert style.to_svg(figure) == style.to_svg(closed_loop_finetune.plot(rows))
    assert all(axes.lines for axes in figure.axes)


def test_rooms_of_finetuning_are_used_nowhere_else():
    numbers = (0, dagger.FIRST_LEARNER_EPISODE, dagger.TURN_GAIN_EPISODE, room_batches.BENCHMARK_EPISODE)
    assert all(abs(closed_loop_finetune.FIRST_EPISODE - number) > 10_000 for number in numbers)


def test_windows_of_the_preset_divide_a_room_evenly():
    settings = scales.STUDY_PRESETS["closed_loop_finetune"]
    assert isinstance(settings, FinetuneSettings)
    frames = settings.dagger.round_seconds * closed_loop.FRAME_RATE
    assert all(frames % window == 0 for window in (settings.window, *settings.horizons))
    assert settings.dagger.dagger_rounds % 2 == 0 and settings.seeds >= 3
    assert lgmd.with_smooth_thresholds(lgmd.Params(), rollout_gradient.SMOOTH_WIDTH).smooth
