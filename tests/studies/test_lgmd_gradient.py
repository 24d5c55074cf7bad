"""The detector fitted by gradient: on made-up walks of which a known detector made the labels."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slopes
import synthetic
from reference import lgmd as reference

from lgmdjax.control import navigator
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning, dagger, lgmd_gradient_fit
from lgmdjax.learning.settings import LgmdGradientSettings
from lgmdjax.paths import PRETRAINED
from lgmdjax.reporting.figures import style
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, episodes, room_batches
from lgmdjax.studies import lgmd_gradient

ROWS, COLUMNS, FRAMES, WALKS = 6, 8, 120, 4
KNOWN = lgmd.Params(threshold=jnp.asarray(2.0), suppression=jnp.asarray(20.0), inhibition=jnp.asarray(0.4))
START = replace(KNOWN, threshold=jnp.asarray(0.5), inhibition=jnp.asarray(0.15))
SETTINGS = LgmdGradientSettings(
    minutes=0.1, seconds=3.0, epochs=1, steps=120, every=30, window=29, streams=4, learning_rate=0.03,
    navigator_rate=1e-3, seeds=1,
)  # fmt: skip


def as_walk(record, robot: int, **facts: int) -> episodes.Walk:
    fields = {name: np.asarray(leaf)[robot] for name, leaf in vars(record).items()}
    return episodes.Walk(**{"episode": 0, "robot": robot, "room": robot, "seed": 0} | facts, **fields)


def pictures(seed: int) -> np.ndarray:
    """Gratings that drift across both eyes' cells, faster and slower, (walks, frames, 2, rows, columns) [grey]."""
    generator = np.random.default_rng(seed)
    time = np.arange(FRAMES)[:, None, None, None] / 30
    row, column = np.mgrid[:ROWS, :COLUMNS]
    films = []
    for _ in range(WALKS):
        drift = np.cumsum(0.25 * (1 + np.sin(2 * np.pi * time / [[[2.1]], [[3.3]]] + generator.uniform(0, 6))), axis=0)
        films.append(128 + 12 * np.sin(column + drift) * np.cos(0.7 * row + generator.uniform(0, 6)))
    return np.array(films) + generator.normal(0, 0.5, (WALKS, FRAMES, 2, ROWS, COLUMNS))


@pytest.fixture(scope="module")
def pilot() -> lgmd_gradient_fit.Pilot:
    pupil = navigator.create(jax.random.key(3), units=4, symmetric=True)
    return lgmd_gradient_fit.Pilot(detector=START, navigator=replace(pupil, input_mean=jnp.full(2, 0.6)))


@pytest.fixture(scope="module")
def data(pilot):
    """Walks to fit to and walks to test on, with what the cells saw; labelled by the pilot, its detector as it was."""

    def some(seed: int):
        fresh = np.zeros((WALKS, FRAMES), bool)
        fresh[:, 0] = True
        cells = lgmd_gradient_fit.changes(pictures(seed), fresh)
        u = np.asarray(lgmd_gradient_fit.watch(KNOWN, cells))
        record = synthetic.walk(WALKS, FRAMES, u=u, fresh=fresh, distances=1 + u)
        walks = [as_walk(record, robot) for robot in range(WALKS)]
        label = behaviour_cloning.predict(pilot.navigator, walks)
        return [replace(walk, label=v) for walk, v in zip(walks, label, strict=True)], cells

    return some(0), some(1)


def film(data, seed: int = 0) -> lgmd_gradient_fit.Film:
    walks, cells = data[0]
    return lgmd_gradient_fit.film(walks, cells, SETTINGS.streams, SETTINGS.window, np.random.default_rng(seed))


def test_u_of_changes_is_that_of_the_paper_on_the_pictures():
    """By the transcription of the equations; anew where a robot was put down."""
    seen, fresh = pictures(5)[:1, :14], np.zeros((1, 14), bool)
    fresh[0, 8] = True
    u = np.asarray(lgmd_gradient_fit.watch(START, lgmd_gradient_fit.changes(seen, fresh)))[0]
    for eye in range(2):
        for part in (slice(0, 8), slice(8, 14)):
            rows = reference.lgmd(seen[0, part, eye], 0.5, 20.0, 0.15)
            np.testing.assert_allclose(u[part, eye], [0.5, *(row["u"] for row in rows)], atol=1e-6)
    assert np.ptp(u) > 0.05


def test_a_film_shows_every_stretch_with_its_own_cells(data):
    """What the detector that was there says of the film's cells is the u that was recorded with its labels."""
    reel = film(data)
    counts = np.asarray(reel.tape.counts) > 0
    assert counts.sum() == sum(len(stretch) for stretch in episodes.stretches(data[0][0])) == WALKS * (FRAMES - 2)
    np.testing.assert_allclose(lgmd_gradient_fit.respond(KNOWN, reel.cells)[counts], reel.tape.u[counts], atol=1e-6)
    assert not np.array_equal(reel.tape.u, film(data, seed=1).tape.u)


def test_gradient_equals_differences_for_every_constant(pilot, data):
    window = jax.tree.map(lambda leaf: leaf[0], film(data))
    pilot = replace(pilot, detector=replace(START, suppression=jnp.asarray(8.0)))
    states = lgmd_gradient_fit.start(pilot.navigator, SETTINGS.streams)
    routes = slopes.Routes(lambda tuned: lgmd_gradient_fit.loss({"detector": tuned}, pilot, states, window, 0.3)[0])
    tuned = lgmd_gradient_fit.parts(pilot)["detector"]
    gradient = routes.assert_agree(tuned)
    routes.assert_every_leaf_agrees(tuned)
    kernel = np.asarray(gradient["kernel"])
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)
    np.testing.assert_allclose(kernel, kernel[:, ::-1], atol=1e-12)


def test_the_detector_that_made_the_labels_is_approached(pilot, data):
    """With hard steps, on walks that were not fitted to."""
    test = data[1]
    judge = lambda pilot: {"choice": lgmd_gradient.score(pilot, *test)["mse"]}  # noqa: E731
    fitted, rows = lgmd_gradient_fit.fit(pilot, film(data), ("detector",), SETTINGS, judge)
    assert [row["step"] for row in rows] == [0, 30, 60, 90, 120]
    least = min(row["choice"] for row in rows)
    assert least < 0.2 * rows[0]["choice"] and judge(fitted)["choice"] == pytest.approx(least)
    assert rows[-1]["loss"] < rows[1]["loss"]
    assert float(fitted.detector.threshold) > 1.2 * START.threshold
    lgmd.check(lgmd_gradient_fit.normal(fitted.detector))
    jax.tree.map(np.testing.assert_array_equal, fitted.navigator, pilot.navigator)


def test_without_parts_nothing_is_fitted(pilot, data):
    fitted, rows = lgmd_gradient_fit.fit(pilot, film(data), (), SETTINGS, lambda pilot: {"choice": 1.0})
    assert [row["step"] for row in rows] == [0]
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), fitted, pilot)


def test_a_normal_detector_says_the_same(data):
    odd = replace(START, kernel=1.7 * START.kernel + 0.05 * jnp.arange(25.0).reshape(5, 5) / 25)
    normal = lgmd_gradient_fit.normal(odd)
    assert float(normal.kernel.sum()) == pytest.approx(np.sum(lgmd.KERNEL))
    np.testing.assert_allclose(
        lgmd_gradient_fit.watch(normal, data[0][1]), lgmd_gradient_fit.watch(odd, data[0][1]), atol=1e-6
    )


def test_parts_are_of_every_episode_and_drawn_in_the_rooms_walked_in(monkeypatch):
    """Practice numbers its rooms by episode and robots: the pictures here are the numbers of the rooms drawn in."""
    record = synthetic.walk(6, 200, u=np.full((6, 200, 2), 0.5))
    practice = [as_walk(record, k, episode=dagger.OWN_WALKS, room=dagger.OWN_WALKS * 6 + k) for k in range(6)]
    lesson = [as_walk(record, k, episode=1, room=4 + k) for k in range(4)]
    picked = lgmd_gradient.pick([*lesson, *practice], replace(SETTINGS, minutes=0.2), seed=0)
    assert [(robots, len(parts)) for robots, parts in picked] == [(4, 2), (6, 2)]
    assert {len(walk) for _, parts in picked for walk in parts} == {90}
    asked, drawn = [], []

    def rooms_of(*which):
        asked.append(which)
        return SimpleNamespace(arena=jnp.arange(which[2]))

    def draw(eyes, rooms, record):
        drawn.append(np.asarray(rooms).tolist())
        return np.zeros((*record.time.shape, 2, 6, 8))

    monkeypatch.setattr(room_batches, "rooms_of", rooms_of)
    monkeypatch.setattr(lgmd_gradient.rerender, "walks", draw)
    robot = assembly.trained()
    walks, cells = lgmd_gradient.look(robot, picked, CameraSettings(width=8, height=6))
    assert asked == [(0, 1, 4), (0, dagger.OWN_WALKS, 6)]
    assert drawn == [[walk.robot for walk in parts] for _, parts in picked]
    assert [walk.room for walk in walks] == [walk.room for _, parts in picked for walk in parts]
    assert len(cells.change) == 4


def test_other_pictures_than_those_seen_are_refused():
    u = np.random.default_rng(0).uniform(0.5, 0.7, (2, 60, 2))
    walks = [as_walk(synthetic.walk(2, 60, u=u), robot) for robot in range(2)]
    lgmd_gradient.require_same(walks, u + 1e-5, lgmd_gradient.ALIKE)
    with pytest.raises(InputError, match="draw again what the robots saw"):
        lgmd_gradient.require_same(walks, u[::-1], lgmd_gradient.AKIN)


def test_without_a_run_there_is_nothing_to_fit_to(tmp_path):
    inputs: dict[str, Path] = {"fit-gait": PRETRAINED, "train": PRETRAINED}
    with pytest.raises(InputError, match="expected a run"):
        lgmd_gradient.work(tmp_path, inputs, SETTINGS, 0)


def test_rows_can_be_drawn():
    told = {"mse": 0.3, "steering": 0.7, "nearness": 0.75}
    row = {"train": told, "test": told, "seconds": 1.0, "detector": lgmd_gradient.constants(START)}
    curve = [
        {"step": 0, "loss": None, "choice": 0.4, "test": 0.4},
        {"step": 30, "loss": 0.3, "choice": 0.3, "test": 0.3},
    ]
    rows = [
        row | {"method": method, "start": start, "curve": curve if names else curve[:1]}
        for start in range(2)
        for method, names in lgmd_gradient.METHODS.items()
    ]
    figure = lgmd_gradient.draw(rows)
    assert style.to_svg(figure) == style.to_svg(lgmd_gradient.draw(rows))
    assert figure.axes[0].lines and figure.axes[1].patches
