"""The study of the closed loop: what a tune may move, who practises for how long, and what is told of it."""

import json
from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.cli import study
from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.learning import dagger, finetuning, rollout_gradient
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.locomotion import shaping
from lgmdjax.pipeline import scales
from lgmdjax.reporting.figures import style
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, recording, room_batches
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies import closed_loop_finetune
from lgmdjax.studies.settings import FinetuneSettings

EYES = CameraSettings(width=80, height=60, pooling=3)
PRACTICE = TrainSettings(eyes=EYES, epochs=1, rounds=2, round_epochs=1, robots=4, round_seconds=3.0)
SETTINGS = FinetuneSettings(
    bench=BenchmarkRooms(eyes=EYES, robots=2, seconds=2.0), practice=PRACTICE, lesson_seconds=3.0, window=15,
    horizons=(5, 45), learning_rate=6e-3, clip=10.0, seeds=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def robot():
    return assembly.trained()


@pytest.fixture(scope="module")
def nerves(robot):
    return rollout_gradient.smooth(rollout_gradient.alone(robot)).controller


def by_name(nerves) -> dict[str, np.ndarray]:
    found = jax.tree_util.tree_leaves_with_path(nerves)
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in found}


def noise_like(tree, size: float):
    generator = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: jnp.asarray(generator.normal(0, size, leaf.shape)), tree)


def test_a_joint_fit_moves_weights_and_three_constants_and_no_means_or_widths(nerves):
    sizes = by_name(finetuning.sizes(nerves, closed_loop_finetune.JOINT))
    moving = {name for name, size in sizes.items() if np.any(size)}
    constants = {"lgmd.threshold", "lgmd.suppression", "lgmd.inhibition"}
    assert moving == constants | {name for name in sizes if name.startswith(("driver.weights.", "shaping."))}
    own = by_name(nerves)
    assert all(sizes[name] == own[name] for name in constants)
    w1 = float(np.sqrt(np.mean(own["shaping.w1"] ** 2)))
    assert float(sizes["shaping.w1"]) == pytest.approx(w1, abs=2e-3)


@pytest.mark.parametrize("part", ["lgmd.thresh", "eyes", "driver.weight"])
def test_a_part_that_there_is_not_is_refused(nerves, part):
    with pytest.raises(InputError, match=rf"expected some of .*shaping\.w1.* got {part}"):
        finetuning.sizes(nerves, ("shaping", part))


def test_constants_keep_their_sign_and_zeros_however_far_they_are_moved(nerves):
    sizes = finetuning.sizes(nerves, ("lgmd", "cpg"))
    changes = jax.tree.map(lambda leaf, size: jnp.sign(size) * leaf, noise_like(nerves, 3.0), sizes)
    after = finetuning.moved(nerves, changes, sizes)
    for name, leaf in by_name((nerves.lgmd, nerves.cpg)).items():
        np.testing.assert_array_equal(np.sign(leaf), np.sign(by_name((after.lgmd, after.cpg))[name]))
    assert after.lgmd.kernel[2, 2] == 0 and not np.any(np.diag(after.cpg.coupling))
    np.testing.assert_allclose(after.lgmd.threshold, nerves.lgmd.threshold * np.exp(changes.lgmd.threshold))
    assert after.lgmd.threshold_width == nerves.lgmd.threshold_width
    jax.tree.map(np.testing.assert_array_equal, (after.driver, after.shaping), (nerves.driver, nerves.shaping))


def test_a_tied_slope_leaves_a_mirrored_robot_walking_mirrored(nerves):
    """What is moved by it answers to the mirrored rhythm and velocities with the mirrored angles."""
    slope = finetuning.tied(noise_like(nerves, 0.05))
    legs = finetuning.moved(nerves, slope, finetuning.sizes(nerves, ("shaping",))).shaping
    assert np.abs(legs.w1 - nerves.shaping.w1).max() > 1e-2
    signal = jnp.asarray(np.random.default_rng(3).normal(size=(6, 2)))
    there = shaping.shape(legs, signal, jnp.asarray([1.3, 0.4]))
    mirrored = shaping.shape(legs, signal[::-1], jnp.asarray([0.4, 1.3]))
    np.testing.assert_allclose(mirrored, there[::-1] * np.array([-1.0, 1.0, 1.0]), atol=1e-6)
    again = finetuning.tied(slope)
    jax.tree.map(np.testing.assert_allclose, again, slope)


def test_what_was_tuned_comes_aboard_and_steps_stay_hard(robot, nerves):
    """In a robot of the same structure, so that the program of all others walks it."""
    changed = jax.tree.map(lambda leaf: 1.01 * leaf, nerves)
    after = closed_loop_finetune.aboard(robot, changed)
    assert jax.tree.structure(after) == jax.tree.structure(robot) and not after.controller.lgmd.smooth
    assert after.controller.lgmd.threshold_width == robot.controller.lgmd.threshold_width
    back = rollout_gradient.alone(after).controller
    jax.tree.map(np.testing.assert_array_equal, (back.driver, back.shaping), (changed.driver, changed.shaping))
    expected = {name: 1.01 * float(getattr(nerves.lgmd, name)) for name in ("threshold", "suppression", "inhibition")}
    assert closed_loop_finetune.detector(after) == pytest.approx(expected)


def test_near_approaches_and_the_error_of_commands_are_told():
    clearance = np.full((2, 600), 0.3)
    clearance[0, 100:120], clearance[0, 200], clearance[1, 5:] = 0.05, 0.07, 0.0799
    label = np.zeros((2, 600, 2))
    label[..., 0] = 0.5  # of one side of two
    ok = np.ones((2, 600), bool)
    ok[1, 300:] = False
    label[1, 300:] = 9.0  # counts no longer
    row = closed_loop_finetune.told(synthetic.walk(2, 600, clearance=clearance, label=label, ok=ok))
    assert row["approaches"] == 3 and row["imitation"] == pytest.approx(0.125)
    assert row["near"] == asdict(metrics.poisson_rate(3, row["distance"] / 100))


@pytest.fixture
def taught(monkeypatch):
    """Stand-ins for walks and fits; gives what every tune was asked for."""
    asked = []

    def practise(folder, robot, walks, settings, seed):
        return [*walks, settings.rounds]

    def learn(folder, walks, epochs, seed):
        pupil = navigator.create(jax.random.key(seed), symmetric=True)
        return replace(pupil, output_mean=jnp.full(2, float(sum(walks)))), []

    def tune(params, model, rooms, window, settings, *, saved, tell):
        asked.append((params.controller, window, settings))
        row = finetuning.Row(loss=0.5, signal=2.0, noise=1.0, norm=1.0, largest=3.0, lost=0, fallen=0, touches=0)
        tell(row)
        return params, [row] * settings.rooms * settings.windows

    monkeypatch.setattr(
        recording, "walked", lambda folder, params, rooms, *_, **__: synthetic.walk(len(rooms.starts), 60)
    )
    monkeypatch.setattr(dagger, "lesson", lambda *_: [])
    monkeypatch.setattr(dagger, "learn", learn)
    monkeypatch.setattr(dagger, "practise", practise)
    monkeypatch.setattr(finetuning, "tune", tune)
    return asked


def test_all_pupils_practise_for_the_same_time_and_are_told_of(taught, tmp_path):
    study.command("closed_loop_finetune")(SETTINGS, out=tmp_path)
    folder = tmp_path / "closed_loop_finetune-0" / "closed_loop_finetune"
    rows = json.loads((folder / "closed_loop_finetune.json").read_text())
    named = [*closed_loop_finetune.COLOURS, "everything, 5 frames", "everything, 45 frames"]
    assert sorted(row["pupil"] for row in rows if row["start"] == 0) == sorted(named)
    assert sorted(row["pupil"] for row in rows if row["start"] == 1) == sorted(closed_loop_finetune.COLOURS)
    curves = {(row["pupil"], row["start"]): row["curve"]["seconds"] for row in rows if "curve" in row}
    time = PRACTICE.rounds * PRACTICE.robots * PRACTICE.round_seconds
    for (name, _), seconds in curves.items():
        assert seconds[-1] == pytest.approx(time / 2 if name == "dagger + everything" else time)
    assert (folder / "closed_loop_finetune.png").read_bytes().startswith(b"\x89PNG")


def test_pupils_are_tuned_from_the_right_navigator_with_smooth_steps_and_an_even_pace(taught, tmp_path):
    robot = assembly.with_eyes(assembly.trained(), EYES)
    list(closed_loop_finetune.pupils(tmp_path, robot, SETTINGS, 0, (5,)))
    assert [float(nerves.driver.output_mean[0]) for nerves, _, _ in taught] == [0, 0, 0, 1, 0]
    assert all(nerves.lgmd.smooth and window.clip == 10 for nerves, window, _ in taught)
    assert [window.through for _, window, _ in taught] == ["controller", *["everything"] * 4]
    assert [settings.parts for _, _, settings in taught] == [("driver",)] * 2 + [closed_loop_finetune.JOINT] + [
        ("driver",)
    ] * 2
    most = [settings.learning_rate * settings.windows * settings.rooms for _, _, settings in taught]
    np.testing.assert_allclose(most, 6e-3 * PRACTICE.round_seconds * np.array([2, 2, 2, 1, 2]))
    assert len({jax.tree.structure(nerves) for nerves, _, _ in taught}) == 1


def test_rates_are_pooled_over_starts_and_drawn_with_what_is_not_finite():
    score = {"distance": 50.0, "collisions": 1, "approaches": 4}
    score |= {"per_100_m": asdict(metrics.poisson_rate(1, 0.5)), "near": asdict(metrics.poisson_rate(4, 0.5))}
    nan = float("nan")
    curve = {"loss": [0.4, nan, 0.2], "signal": [3.0, nan, 1.0], "noise": [1.0, nan, 0.0], "seconds": [8.0, 16.0, 24.0]}
    tuned = {"curve": curve, "frames": 15}
    rows = [{"pupil": "imitation", "start": start, **score} for start in range(3)]
    rows += [{"pupil": "everything", "start": start, **score, **tuned} for start in range(3)]
    rows += [{"pupil": "everything, 5 frames", "start": 0, **score, **tuned, "frames": 5}]
    pooled = closed_loop_finetune.pooled(rows, "approaches")
    assert list(pooled) == ["imitation", "everything", "everything, 5 frames"]
    assert pooled["everything"] == metrics.poisson_rate(12, 1.5)
    np.testing.assert_allclose(closed_loop_finetune.trust(rows[-1]), [3.0])
    figure = closed_loop_finetune.draw(rows)
    assert style.to_svg(figure) == style.to_svg(closed_loop_finetune.draw(rows))
    assert all(axes.lines for axes in figure.axes)


def test_rooms_of_a_tune_are_met_nowhere_else():
    numbers = (0, dagger.OWN_WALKS, dagger.TRYOUT, room_batches.BENCH)
    assert all(abs(closed_loop_finetune.ROOMS - number) > 10_000 for number in numbers)


def test_default_windows_go_into_a_room_evenly():
    settings = scales.GRADIENTS["closed_loop_finetune"]
    frames = settings.practice.round_seconds * closed_loop.FRAME_RATE
    assert all(frames % window == 0 for window in (settings.window, *settings.horizons))
    assert settings.practice.rounds % 2 == 0 and settings.seeds >= 3
    assert lgmd.smoothed(lgmd.Params(), rollout_gradient.WIDTH).smooth
