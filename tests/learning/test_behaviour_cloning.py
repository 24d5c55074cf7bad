"""The fit: its steps by hand, that memory pays, that an interrupted one ends the same, what it refuses."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.control import navigator
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning, sequences
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.simulation.episodes import Walk

EPOCHS = 20  # the same in most tests, so that they share a program


def walk(seed, frames, room=0):
    """Invent a walk: nearness drifts, u follows it with the gait and noise on top, the label without."""
    rng = np.random.default_rng(seed)
    drift = np.exp(-np.arange(120) / 30)
    noise = rng.normal(size=(2, frames + 119))
    nearness = np.stack([np.convolve(n, drift / np.linalg.norm(drift), "valid") for n in noise], axis=1)
    nearness = np.maximum(0, nearness)
    gait = 1 + 0.5 * np.sin(2 * np.pi * np.arange(frames) / 30)[:, None]
    u = 1 / (1 + np.exp(-0.6 * nearness * gait - 0.4 * np.abs(rng.normal(size=(frames, 2)))))
    label = 1.2 + 0.4 * nearness - 0.3 * nearness[:, ::-1]
    zeros, never = np.zeros((frames, 2)), np.zeros(frames, bool)
    return Walk(
        episode=0,
        robot=seed,
        room=room,
        seed=seed,
        time=np.arange(frames) / 30,
        position=np.zeros((frames, 3)),
        quaternion=np.zeros((frames, 4)),
        joints=np.zeros((frames, 6, 3)),
        u=u,
        feed_forward=zeros,
        excitation=zeros,
        distances=zeros,
        label=label,
        velocity=label,
        clearance=np.ones(frames),
        contact=never,
        fresh=never,
        setbacks=np.zeros(frames, int),
        ok=~never,
    )


@pytest.fixture(scope="module")
def data():
    """Training and test stretches, and two of a room that neither has."""
    return *sequences.halve([walk(s, 900) for s in range(8)]), [walk(50, 600, room=1), walk(51, 500, room=1)]


def settings(**changes: Any) -> behaviour_cloning.Settings:
    return behaviour_cloning.Settings(**{"epochs": EPOCHS, "window": 20, "streams": 16, "mirrored": False} | changes)


def same(a, b):
    """Whether two pytrees are equal to the last bit."""
    return jax.tree.all(jax.tree.map(lambda x, y: np.array_equal(x, y, equal_nan=True), a, b))


def test_an_epoch_equals_rmsprop_by_hand():
    """Two stretches in three windows of four frames: state carried, gradient not, anew at a stretch.

    Gradients are cut to length 1, and the rate falls like a cosine.
    """
    walks = [walk(1, 7), walk(2, 5)]
    chosen = settings(epochs=1, window=4, streams=1)
    params = navigator.create(jax.random.key(1))
    fitted = behaviour_cloning.fit(params, walks, [walk(3, 9)], chosen, show=False)
    start = behaviour_cloning.standardise(params, walks, mirrored=False)
    u, label = (np.concatenate([getattr(w, name) for w in walks]) for name in ("u", "label"))

    def error(weights, state, frames):
        squares = 0.0
        for k in frames:
            state = navigator.init(start) if k in (0, 7) else state
            state, velocity = navigator.step(replace(start, weights=weights), state, jnp.asarray(u[k]))
            squares += jnp.sum((velocity - label[k]) ** 2)
        return squares / (2 * len(frames)), state

    weights, state, errors = start.weights, navigator.init(start), []
    mean_square = jax.tree.map(jnp.zeros_like, weights)
    slope = jax.jit(jax.value_and_grad(error, has_aux=True), static_argnums=2)
    for first in (0, 4, 8):
        (value, state), gradient = slope(weights, state, tuple(range(first, first + 4)))
        length = np.sqrt(sum(np.sum(np.square(g)) for g in jax.tree.leaves(gradient)))
        gradient = jax.tree.map(lambda g, length=length: g / max(1.0, length), gradient)
        rate = chosen.learning_rate * (1 + np.cos(np.pi * (first / 4) / 3)) / 2
        mean_square = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g**2, mean_square, gradient)
        step = jax.tree.map(lambda g, m, rate=rate: rate * g / jnp.sqrt(m + 1e-7), gradient, mean_square)
        weights = jax.tree.map(jnp.subtract, weights, step)
        errors.append(value)
    np.testing.assert_allclose(fitted.train, [np.mean(errors)], rtol=1e-9)
    for got, expected in zip(jax.tree.leaves(fitted.params.weights), jax.tree.leaves(weights), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-10)


def test_memory_pays_and_the_table_says_so(data):
    """The noise and the gait can be averaged away: LSTM beats the memoryless net, which beats the mean."""
    train, test, unseen = data
    fitted = {}
    for variant in navigator.VARIANTS:
        fit = behaviour_cloning.fit(navigator.create(jax.random.key(0), variant), train, test, settings(), show=False)
        assert fit.train.shape == fit.test.shape == (EPOCHS,) and np.all(np.isfinite(fit.train))
        if variant != "mean":
            assert fit.train[-1] < 0.7 * fit.train[0]
        fitted[variant] = fit.best
    rows = {row["variant"]: row for row in behaviour_cloning.table(fitted, {"test": test, "unseen": unseen})}
    for name in ("test", "unseen"):
        errors = [rows[variant][f"{name}_mse"] for variant in ("lstm", "feed-forward", "mean")]
        assert errors[0] < 0.75 * errors[1] < 0.75 * 0.75 * errors[2], errors
        assert min(rows["lstm"][f"{name}_r2"]) > 0.6 and rows["lstm"][f"{name}_steering"] > 0.8
        assert rows["lstm-efference"][f"{name}_mse"] < errors[1]
        assert rows["mean"][f"{name}_steering"] == 0 and max(rows["mean"][f"{name}_r2"]) < 0.01


def test_a_timid_network_is_enlivened(data):
    """Its turns then vary as the labels do, within bounds, and never less than before."""
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0)), data[0])

    def turns(velocities):
        velocities = np.concatenate(velocities)
        return np.std(velocities[:, 1] - velocities[:, 0])

    said, asked = turns(behaviour_cloning.predict(params, data[2])), turns([w.label for w in data[2]])
    gain = float(asked / said)
    assert gain > 1
    livelier = behaviour_cloning.enliven(params, data[2], caution=1.0, most=2 * gain)
    assert turns(behaviour_cloning.predict(livelier, data[2])) == pytest.approx(asked, rel=1e-6)
    np.testing.assert_array_equal(livelier.output_mean, params.output_mean)
    bounded = behaviour_cloning.enliven(params, data[2], caution=1.0, most=0.5 + gain / 2)
    np.testing.assert_allclose(bounded.output_scale, (0.5 + gain / 2) * params.output_scale)
    loud = replace(params, output_scale=3 * gain * params.output_scale)
    np.testing.assert_allclose(
        behaviour_cloning.enliven(loud, data[2], caution=1.3).output_scale, 1.3 * loud.output_scale
    )


def test_predictions_are_the_steps(data):
    """Walks of unequal length side by side answer as each alone, step by step, each from a fresh start."""
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0), "lstm-efference"), data[0])
    for velocities, stretch in zip(behaviour_cloning.predict(params, data[2]), data[2], strict=True):
        assert velocities.shape == (len(stretch), 2)
        state, step = navigator.init(params), jax.jit(navigator.step)
        for k in range(3):
            state, velocity = step(params, state, jnp.asarray(stretch.u[k]))
            np.testing.assert_allclose(velocities[k], velocity, rtol=1e-9)


def test_curves_are_errors_of_the_best_and_the_last(data):
    train, test, _ = data
    fit = behaviour_cloning.fit(navigator.create(jax.random.key(0)), train, test, settings(), show=False)
    # In whole stretches the network starts anew less often than in streams: nearly the same error.
    for params, error in ((fit.params, fit.test[-1]), (fit.best, fit.test.min())):
        np.testing.assert_allclose(behaviour_cloning.score(params, test)["mse"], error, rtol=0.1)


def test_the_best_is_kept_when_the_test_error_rises(data):
    """Labels of the test half that turn the other way: what is learned first is least wrong."""
    train, test, _ = data
    turned = [replace(w, label=w.label[:, ::-1]) for w in test]
    fit = behaviour_cloning.fit(navigator.create(jax.random.key(0)), train, turned, settings(), show=False)
    assert fit.test.argmin() < EPOCHS - 1 and not same(fit.best, fit.params)
    assert behaviour_cloning.score(fit.best, turned)["mse"] < behaviour_cloning.score(fit.params, turned)["mse"]


def test_an_interrupted_fit_ends_the_same(data, tmp_path, monkeypatch):
    """Killed while it saves for the third time; carried on twice; bit for bit."""
    train, test, _ = data
    params, chosen = navigator.create(jax.random.key(0)), settings()
    straight = behaviour_cloning.fit(params, train, test, chosen, show=False)
    save, saved = Checkpoints.save, []
    monkeypatch.setattr(behaviour_cloning, "SAVE_EVERY", 0.0)

    def killed(self, step, progress):
        saved.append(step)
        if len(saved) == 3:
            raise KeyboardInterrupt
        save(self, step, progress)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show=False)
    resumed = behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show=False)
    assert saved == [1, 2, 3]
    assert same(vars(resumed), vars(straight))
    finished = behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show=False)
    assert same(vars(finished), vars(straight))
    assert not any(leaf.committed for leaf in jax.tree.leaves(resumed.params))  # fit to drive on several devices


def test_checkpoints_of_another_fit_or_damaged_ones_are_refused(data, tmp_path):
    train, test, _ = data
    params = navigator.create(jax.random.key(0), "mean")

    def fit(epochs=2, params=params, train=train):
        chosen = settings(epochs=epochs)
        return behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show=False)

    fit()
    others: list[tuple[str, dict[str, Any]]] = [
        ("another epochs", {"epochs": 3}),
        ("another first weights", {"params": navigator.create(jax.random.key(0), "feed-forward")}),
        ("training data", {"train": train[1:]}),
    ]
    for match, changes in others:
        with pytest.raises(InputError, match=match) as caught:
            fit(**changes)
        assert "\n" not in str(caught.value)
    for file in (tmp_path / "fit").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match="expected a whole checkpoint, got") as caught:
        fit()
    assert "\n" not in str(caught.value)


def test_a_place_that_is_no_folder_is_refused(data, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="expected a folder for checkpoints"):
        behaviour_cloning.fit(
            navigator.create(jax.random.key(0), "mean"),
            data[0],
            data[1],
            settings(epochs=1),
            checkpoints=tmp_path / "file",
        )


def test_the_tape_holds_every_frame_once():
    """In order along each stream; padding counts for nothing; mirrored streams are swapped."""
    walks = [walk(s, 50 + 7 * s) for s in range(5)]
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0)), walks)
    tape = sequences.lay(walks, np.asarray(params.output_mean), streams=3, window=20, mirrored=True)
    streams = np.moveaxis(np.asarray(tape.u), 2, 0).reshape(6, -1, 2)
    counts = np.moveaxis(np.asarray(tape.counts), 2, 0).reshape(6, -1).astype(bool)
    u = np.concatenate([w.u for w in walks])
    np.testing.assert_allclose(streams[:3][counts[:3]], u)
    np.testing.assert_allclose(streams[3:][counts[3:]], u[:, ::-1])
    fresh = np.moveaxis(np.asarray(tape.fresh), 2, 0).reshape(6, -1)
    starts = np.flatnonzero(fresh[:3][counts[:3]])
    lengths = np.cumsum([0, *map(len, walks)])[:-1]
    assert set(lengths) <= set(starts) and len(starts) <= 5 + 3
    assert (~counts).sum() < 0.1 * counts.size


def test_mirrored_data_teach_both_sides_alike(data):
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0)), data[0], mirrored=True)
    for name in navigator.SCALES:
        left, right = getattr(params, name)
        np.testing.assert_allclose(left, right, rtol=1e-12)
    lonely = behaviour_cloning.standardise(params, data[0], mirrored=False)
    assert lonely.input_mean[0] != lonely.input_mean[1]
    np.testing.assert_allclose(lonely.output_mean, np.concatenate([w.label for w in data[0]]).mean(0))


def test_what_mirrored_data_teach_is_made_symmetric(data):
    """And has less error for it than the network that was fitted, in a room that it has not seen."""
    train, test, unseen = data
    fitted = behaviour_cloning.fit(
        navigator.create(jax.random.key(0)), train[:2], test[:2], settings(mirrored=True), show=False
    ).best
    assert fitted.symmetric
    assert (
        behaviour_cloning.score(fitted, unseen)["mse"]
        < behaviour_cloning.score(replace(fitted, symmetric=False), unseen)["mse"]
    )
    alone = behaviour_cloning.fit(
        navigator.create(jax.random.key(0)), train[:2], test[:2], settings(epochs=1), show=False
    )
    assert not alone.best.symmetric


def test_an_efference_copy_of_what_was_told(data):
    """`told` feeds the recorded velocity: nearly the next label, so training errs far less."""
    train, test, _ = data
    params = navigator.create(jax.random.key(0), "lstm-efference")
    own = behaviour_cloning.fit(params, train, test, settings(), show=False)
    told = behaviour_cloning.fit(params, train, test, settings(told=True), show=False)
    assert told.train[-1] < 0.8 * own.train[-1]
    assert told.test[-1] > 1.2 * told.train[-1]


def test_splits_keep_walks_and_rooms_apart():
    walks = [walk(s, 40, room=s % 4) for s in range(8)]
    first, second = sequences.halve(walks)
    assert [len(w) for w in first + second] == [20] * 16
    np.testing.assert_array_equal(first[3].u, walks[3].u[:20])
    np.testing.assert_array_equal(second[3].u, walks[3].u[20:])
    seen, unseen = sequences.split_by_room(walks, unseen=0.3, seed=1)
    rooms = {w.room for w in seen}, {w.room for w in unseen}
    assert not rooms[0] & rooms[1] and len(rooms[1]) == 1 and len(seen) + len(unseen) == 8
    assert {w.room for w in sequences.split_by_room(walks, 0.3, 1)[1]} == rooms[1]
    for fraction, some in ((0.0, walks), (0.5, walks[:1])):
        with pytest.raises(InputError, match="training: expected a fraction"):
            sequences.split_by_room(some, fraction, 0)


@pytest.mark.parametrize(
    ("match", "changes"),
    [
        ("epochs", {"epochs": 0}),
        ("window", {"window": 0}),
        ("streams", {"streams": -1}),
        ("learning_rate", {"learning_rate": float("nan")}),
    ],
)
def test_settings_without_sense_are_refused(match, changes, data):
    with pytest.raises(InputError, match=f"training {match}: expected"):
        behaviour_cloning.fit(navigator.create(jax.random.key(0)), data[0], data[1], settings(**changes), show=False)


def test_data_that_teach_nothing_are_refused(data):
    params, train = navigator.create(jax.random.key(0)), data[0]
    with pytest.raises(InputError, match="expected frames to test on, got none"):
        behaviour_cloning.fit(params, train, [], show=False)
    broken = [replace(train[0], u=np.full_like(train[0].u, np.nan))]
    with pytest.raises(InputError, match="expected finite u and v to train on"):
        behaviour_cloning.fit(params, broken, train, show=False)
