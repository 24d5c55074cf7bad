"""The LGMD fitted by gradient, on synthetic walks whose labels come from a known detector."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import derivatives
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from reference import lgmd as reference

from lgmdjax.control import lstm, navigator
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning, dagger, lgmd_gradient_fit
from lgmdjax.learning.settings import LgmdGradientSettings
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import tracking
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, episodes, room_batches
from lgmdjax.studies import lgmd_gradient

ROWS, COLUMNS, FRAMES, WALKS = 6, 8, 120, 4
KNOWN = lgmd.Params(threshold=jnp.asarray(2.0), suppression=jnp.asarray(20.0), inhibition=jnp.asarray(0.4))
START = replace(KNOWN, threshold=jnp.asarray(0.5), inhibition=jnp.asarray(0.15))
SETTINGS = LgmdGradientSettings(
    minutes=0.1, seconds=3.0, epochs=1, steps=120, eval_every=30, window=29, streams=4, learning_rate=0.03,
    navigator_learning_rate=1e-3, seeds=1,
)  # fmt: skip


def as_walk(record, robot: int, **facts: int) -> episodes.Walk:
    fields = {name: np.asarray(leaf)[robot] for name, leaf in vars(record).items()}
    return episodes.Walk(**{"episode": 0, "robot": robot, "room": robot, "seed": 0} | facts, **fields)


def pictures(seed: int) -> np.ndarray:
    """Gratings that drift with varying speed, (walks, frames, 2, rows, columns) [grey]."""
    generator = np.random.default_rng(seed)
    time = np.arange(FRAMES)[:, None, None, None] / 30
    row, column = np.mgrid[:ROWS, :COLUMNS]
    gratings = []
    for _ in range(WALKS):
        drift = np.cumsum(0.25 * (1 + np.sin(2 * np.pi * time / [[[2.1]], [[3.3]]] + generator.uniform(0, 6))), axis=0)
        gratings.append(128 + 12 * np.sin(column + drift) * np.cos(0.7 * row + generator.uniform(0, 6)))
    return np.array(gratings) + generator.normal(0, 0.5, (WALKS, FRAMES, 2, ROWS, COLUMNS))


@pytest.fixture(scope="module")
def params() -> lgmd_gradient_fit.LgmdNavigator:
    untrained = navigator.create(jax.random.key(3), units=4, symmetric=True)
    return lgmd_gradient_fit.LgmdNavigator(detector=START, navigator=replace(untrained, input_mean=jnp.full(2, 0.6)))


@pytest.fixture(scope="module")
def data(params):
    """Training walks and test walks with their frame differences; the known detector and the navigator label them."""

    def labelled(seed: int):
        is_first = np.zeros((WALKS, FRAMES), bool)
        is_first[:, 0] = True
        differences = lgmd_gradient_fit.frame_differences(pictures(seed), is_first)
        u = np.asarray(lgmd_gradient_fit.respond_walks(KNOWN, differences))
        record = synthetic.walk(WALKS, FRAMES, u=u, is_first=is_first, distances=1 + u)
        walks = [as_walk(record, robot) for robot in range(WALKS)]
        label = behaviour_cloning.predict(params.navigator, walks)
        return [replace(walk, label=v) for walk, v in zip(walks, label, strict=True)], differences

    return labelled(0), labelled(1)


def batch_of(data, seed: int = 0) -> lgmd_gradient_fit.LgmdBatch:
    generator = np.random.default_rng(seed)
    return lgmd_gradient_fit.pack_walks(*data[0], streams=SETTINGS.streams, window=SETTINGS.window, generator=generator)


def test_u_of_frame_differences_equals_the_papers_equations():
    """Compared with the transcription of the equations, which starts again after a reset."""
    seen, is_first = pictures(5)[:1, :14], np.zeros((1, 14), bool)
    is_first[0, 8] = True
    u = np.asarray(lgmd_gradient_fit.respond_walks(START, lgmd_gradient_fit.frame_differences(seen, is_first)))[0]
    for eye in range(2):
        for part in (slice(0, 8), slice(8, 14)):
            rows = reference.lgmd(seen[0, part, eye], 0.5, 20.0, 0.15)
            np.testing.assert_allclose(u[part, eye], [0.5, *(row["u"] for row in rows)], atol=1e-6)
    assert np.ptp(u) > 0.05


def test_a_batch_has_every_segment_with_its_own_frame_differences(data):
    """The known detector's response to the batch is the u that the walks recorded."""
    batch = batch_of(data)
    mask = np.asarray(batch.sequences.mask) > 0
    assert mask.sum() == sum(map(len, episodes.segments(data[0][0]))) == WALKS * (FRAMES - 2)
    u = lgmd_gradient_fit.respond(KNOWN, batch.differences)
    np.testing.assert_allclose(u[mask], batch.sequences.u[mask], atol=1e-6)
    assert not np.array_equal(batch.sequences.u, batch_of(data, seed=1).sequences.u)


def test_gradient_agrees_in_three_ways_for_every_constant(params, data, monkeypatch):
    """`lstm.scan` has no forward mode; its derivative is tested beside it."""
    monkeypatch.setattr(lstm, "scan", lambda *arguments: lstm._scan(*arguments)[0])
    window = jax.tree.map(lambda leaf: leaf[0], batch_of(data))
    params = replace(params, detector=replace(START, suppression=jnp.asarray(8.0)))
    states = lgmd_gradient_fit.init_states(params.navigator, SETTINGS.streams)
    check = derivatives.DerivativeCheck(
        lambda fitted: lgmd_gradient_fit.loss({"detector": fitted}, params, states, window, 0.3)[0]
    )
    fitted = lgmd_gradient_fit.to_fit_params(params)["detector"]
    gradient = check.assert_agree(fitted)
    check.assert_every_leaf_agrees(fitted)
    kernel = np.asarray(gradient["kernel"])
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)
    np.testing.assert_allclose(kernel, kernel[:, ::-1], atol=1e-12)


def test_a_fit_approaches_the_detector_of_the_labels(params, data):
    """Measured with hard thresholds, on test walks."""
    test = data[1]
    evaluate = lambda params: {"choice": lgmd_gradient.score(params, *test)["mse"]}  # noqa: E731
    logged = []
    with tracking.add_listener(
        lambda step, values: logged.append((step, values["fit/choice"], values.get("fit/loss")))
    ):
        fitted, rows = lgmd_gradient_fit.fit(params, batch_of(data), ("detector",), SETTINGS, evaluate)
    assert logged == [(row["step"], row["choice"], row["loss"]) for row in rows]
    assert [row["step"] for row in rows] == [0, 30, 60, 90, 120]
    least = min(row["choice"] for row in rows)
    assert least < 0.2 * rows[0]["choice"] and evaluate(fitted)["choice"] == pytest.approx(least)
    assert rows[-1]["loss"] < rows[1]["loss"]
    assert float(fitted.detector.threshold) > 1.2 * START.threshold
    lgmd.check(lgmd_gradient_fit.normalise_kernel(fitted.detector))
    jax.tree.map(np.testing.assert_array_equal, fitted.navigator, params.navigator)


def test_without_parts_nothing_is_fitted(params, data):
    fitted, rows = lgmd_gradient_fit.fit(params, batch_of(data), (), SETTINGS, lambda params: {"choice": 1.0})
    assert [row["step"] for row in rows] == [0]
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), fitted, params)


def test_a_normalised_kernel_gives_the_same_response(data):
    odd = replace(START, kernel=1.7 * START.kernel + 0.05 * jnp.arange(25.0).reshape(5, 5) / 25)
    normalised = lgmd_gradient_fit.normalise_kernel(odd)
    assert float(normalised.kernel.sum()) == pytest.approx(np.sum(lgmd.KERNEL))
    responses = [lgmd_gradient_fit.respond_walks(detector, data[0][1]) for detector in (normalised, odd)]
    np.testing.assert_allclose(*responses, atol=1e-6)


def test_segments_come_from_every_episode_and_are_rendered_in_their_rooms(monkeypatch):
    """Learner episodes number their rooms by episode and robots; here a picture is the number of its room."""
    record = synthetic.walk(6, 200, u=np.full((6, 200, 2), 0.5))
    own = dagger.FIRST_LEARNER_EPISODE
    learner = [as_walk(record, k, episode=own, room=own * 6 + k) for k in range(6)]
    teacher = [as_walk(record, k, episode=1, room=4 + k) for k in range(4)]
    sampled = lgmd_gradient.sample_segments([*teacher, *learner], replace(SETTINGS, minutes=0.2), seed=0)
    assert [(robots, len(segments)) for robots, segments in sampled] == [(4, 2), (6, 2)]
    assert {len(walk) for _, segments in sampled for walk in segments} == {90}
    asked, rendered_rooms = [], []

    def training_rooms(*which):
        asked.append(which)
        return SimpleNamespace(arena=jnp.arange(which[2]))

    def render_walks(eyes, rooms, record):
        rendered_rooms.append(np.asarray(rooms).tolist())
        return np.zeros((*record.time.shape, 2, 6, 8))

    monkeypatch.setattr(room_batches, "training_rooms", training_rooms)
    monkeypatch.setattr(lgmd_gradient.rerender, "render_walks", render_walks)
    rendered = lgmd_gradient.rerender_segments(assembly.load_robot(), sampled, CameraSettings(width=8, height=6))
    assert asked == [(0, 1, 4), (0, own, 6)]
    assert rendered_rooms == [[walk.robot for walk in segments] for _, segments in sampled]
    assert [walk.room for walk in rendered.walks] == [walk.room for _, segments in sampled for walk in segments]
    assert len(rendered.differences.current) == 4


def test_responses_that_differ_from_the_recorded_ones_are_refused():
    u = np.random.default_rng(0).uniform(0.5, 0.7, (2, 60, 2))
    walks = [as_walk(synthetic.walk(2, 60, u=u), robot) for robot in range(2)]
    lgmd_gradient.check_responses(walks, u + 1e-5, lgmd_gradient.SAME_CAMERA_TOLERANCE)
    with pytest.raises(InputError, match="standard deviations of the recorded u"):
        lgmd_gradient.check_responses(walks, u[::-1], lgmd_gradient.OTHER_CAMERA_TOLERANCE)


def test_the_study_needs_a_run(tmp_path):
    inputs: dict[str, Path] = {"fit-gait": PRETRAINED_DIR, "train": PRETRAINED_DIR}
    with pytest.raises(InputError, match="expected a run"):
        lgmd_gradient.run(tmp_path, inputs, SETTINGS, 0)


def test_rows_can_be_plotted():
    metrics = {"mse": 0.3, "steering": 0.7, "nearness": 0.75}
    row = {"train": metrics, "test": metrics, "seconds": 1.0, "detector": lgmd_gradient.detector_constants(START)}
    curve = [
        {"step": 0, "loss": None, "choice": 0.4, "test": 0.4},
        {"step": 30, "loss": 0.3, "choice": 0.3, "test": 0.3},
    ]
    rows = [
        row | {"method": method, "repeat": repeat, "curve": curve if names else curve[:1]}
        for repeat in range(2)
        for method, names in lgmd_gradient.METHODS.items()
    ]
    figure = lgmd_gradient.plot(rows)
    assert style.to_svg(figure) == style.to_svg(lgmd_gradient.plot(rows))
    assert figure.axes[0].lines and figure.axes[1].patches
