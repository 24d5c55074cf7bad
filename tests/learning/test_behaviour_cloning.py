"""The fit equals RMSprop by hand, is better with memory, resumes bit for bit, and refuses unsound input."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.control import names, navigator
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning, sequences
from lgmdjax.learning.checkpoints import Checkpoints
from lgmdjax.runtime import tracking
from lgmdjax.simulation import sharding
from lgmdjax.simulation.episodes import Walk

pytestmark = pytest.mark.optimised

EPOCHS = 20  # the same in most tests, so that they share one compiled program


def walk(seed, frames, room=0):
    """Make a synthetic walk: proximity drifts; u follows it with gait oscillation and noise, the label without them."""
    rng = np.random.default_rng(seed)
    drift = np.exp(-np.arange(120) / 30)
    noise = rng.normal(size=(2, frames + 119))
    proximity = np.stack([np.convolve(n, drift / np.linalg.norm(drift), "valid") for n in noise], axis=1)
    proximity = np.maximum(0, proximity)
    gait = 1 + 0.5 * np.sin(2 * np.pi * np.arange(frames) / 30)[:, None]
    u = 1 / (1 + np.exp(-0.6 * proximity * gait - 0.4 * np.abs(rng.normal(size=(frames, 2)))))
    label = 1.2 + 0.4 * proximity - 0.3 * proximity[:, ::-1]
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
        corridor=zeros,
        label=label,
        velocity=label,
        clearance=np.ones(frames),
        contact=never,
        is_first=never,
        resets=np.zeros(frames, int),
        ok=~never,
    )


@pytest.fixture(scope="module")
def data():
    """Training segments, test segments, and two segments of a held-out room."""
    return *sequences.split_halves([walk(s, 900) for s in range(8)]), [walk(50, 600, room=1), walk(51, 500, room=1)]


def settings(**changes: Any) -> behaviour_cloning.Settings:
    return behaviour_cloning.Settings(**{"epochs": EPOCHS, "window": 20, "streams": 16, "mirrored": False} | changes)


def same(a, b):
    """Return whether two pytrees are equal to the last bit."""
    return jax.tree.all(jax.tree.map(lambda x, y: np.array_equal(x, y, equal_nan=True), a, b))


def test_an_epoch_equals_rmsprop_by_hand():
    """Two segments in three windows of four frames.

    The state is carried between windows without its gradient, and reset at each segment. Gradients are clipped to norm
    1, and the learning rate decays like a cosine.
    """
    walks = [walk(1, 7), walk(2, 5)]
    chosen = settings(epochs=1, window=4, streams=1)
    params = navigator.create(jax.random.key(1))
    logged = []
    with tracking.add_listener(lambda step, values: logged.append((step, values))):
        fitted = behaviour_cloning.fit(params, walks, [walk(3, 9)], chosen, show_progress=False)
    assert logged == [(1, {"lstm/train_mse": fitted.train_mse[0], "lstm/test_mse": fitted.test_mse[0]})]
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
    value_and_grad = jax.jit(jax.value_and_grad(error, has_aux=True), static_argnums=2)
    for first in (0, 4, 8):
        (value, state), gradient = value_and_grad(weights, state, tuple(range(first, first + 4)))
        length = np.sqrt(sum(np.sum(np.square(g)) for g in jax.tree.leaves(gradient)))
        gradient = jax.tree.map(lambda g, length=length: g / max(1.0, length), gradient)
        rate = chosen.learning_rate * (1 + np.cos(np.pi * (first / 4) / 3)) / 2
        mean_square = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g**2, mean_square, gradient)
        step = jax.tree.map(lambda g, m, rate=rate: rate * g / jnp.sqrt(m + 1e-7), gradient, mean_square)
        weights = jax.tree.map(jnp.subtract, weights, step)
        errors.append(value)
    np.testing.assert_allclose(fitted.train_mse, [np.mean(errors)], rtol=1e-9)
    for got, expected in zip(jax.tree.leaves(fitted.params.weights), jax.tree.leaves(weights), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-10)


def test_the_lstm_beats_the_feed_forward_network_which_beats_the_mean(data):
    """Noise and gait oscillation can be averaged away over time, so memory reduces the error."""
    train, test, unseen = data
    fitted = {}
    for variant in names.VARIANTS:
        fit = behaviour_cloning.fit(
            navigator.create(jax.random.key(0), variant), train, test, settings(), show_progress=False
        )
        assert fit.train_mse.shape == fit.test_mse.shape == (EPOCHS,) and np.all(np.isfinite(fit.train_mse))
        if variant != "mean":
            assert fit.train_mse[-1] < 0.7 * fit.train_mse[0]
        fitted[variant] = fit.best
    rows = {row["variant"]: row for row in behaviour_cloning.score_variants(fitted, {"test": test, "unseen": unseen})}
    for name in ("test", "unseen"):
        errors = [rows[variant][f"{name}_mse"] for variant in ("lstm", "feed-forward", "mean")]
        assert errors[0] < 0.75 * errors[1] < 0.75 * 0.75 * errors[2], errors
        assert min(rows["lstm"][f"{name}_r2"]) > 0.6 and rows["lstm"][f"{name}_steering"] > 0.8
        assert rows["lstm-efference"][f"{name}_mse"] < errors[1]
        assert rows["mean"][f"{name}_steering"] == 0 and max(rows["mean"][f"{name}_r2"]) < 0.01


def test_turns_are_rescaled_to_vary_as_the_labels_do(data):
    """The factor is bounded above, and is at least the turn gain."""
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0)), data[0])

    def turns(velocities):
        velocities = np.concatenate(velocities)
        return np.std(velocities[:, 1] - velocities[:, 0])

    predicted, wanted = turns(behaviour_cloning.predict(params, data[2])), turns([w.label for w in data[2]])
    gain = float(wanted / predicted)
    assert gain > 1
    rescaled = behaviour_cloning.rescale_turns(params, data[2], turn_gain=1.0, max_scale=2 * gain)
    assert turns(behaviour_cloning.predict(rescaled, data[2])) == pytest.approx(wanted, rel=1e-6)
    np.testing.assert_array_equal(rescaled.output_mean, params.output_mean)
    bounded = behaviour_cloning.rescale_turns(params, data[2], turn_gain=1.0, max_scale=0.5 + gain / 2)
    np.testing.assert_allclose(bounded.output_scale, (0.5 + gain / 2) * params.output_scale)
    strong = replace(params, output_scale=3 * gain * params.output_scale)
    np.testing.assert_allclose(
        behaviour_cloning.rescale_turns(strong, data[2], turn_gain=1.3).output_scale, 1.3 * strong.output_scale
    )


def test_predictions_equal_single_steps(data):
    """Segments of unequal length in one batch give the same as each alone, step by step, from a reset state."""
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0), "lstm-efference"), data[0])
    for velocities, segment in zip(behaviour_cloning.predict(params, data[2]), data[2], strict=True):
        assert velocities.shape == (len(segment), 2)
        state, step = navigator.init(params), jax.jit(navigator.step)
        for k in range(3):
            state, velocity = step(params, state, jnp.asarray(segment.u[k]))
            np.testing.assert_allclose(velocities[k], velocity, rtol=1e-9)


def test_the_curve_has_the_errors_of_the_best_and_the_last_network(data):
    train, test, _ = data
    fit = behaviour_cloning.fit(navigator.create(jax.random.key(0)), train, test, settings(), show_progress=False)
    # In whole segments the state is reset less often than in streams, so the error is only nearly the same.
    for params, error in ((fit.params, fit.test_mse[-1]), (fit.best, fit.test_mse.min())):
        np.testing.assert_allclose(behaviour_cloning.score(params, test)["mse"], error, rtol=0.1)


def test_the_best_is_kept_when_the_test_error_rises(data):
    """With reversed labels in the test data, the error rises with every epoch after the first ones."""
    train, test, _ = data
    turned = [replace(w, label=w.label[:, ::-1]) for w in test]
    fit = behaviour_cloning.fit(navigator.create(jax.random.key(0)), train, turned, settings(), show_progress=False)
    assert fit.test_mse.argmin() < EPOCHS - 1 and not same(fit.best, fit.params)
    assert behaviour_cloning.score(fit.best, turned)["mse"] < behaviour_cloning.score(fit.params, turned)["mse"]


def test_another_number_of_devices_gives_the_same_to_rounding(data, monkeypatch):
    train, test, _ = data
    fits = []
    for least, devices in ((8, min(2, jax.local_device_count())), (1000, 1)):
        monkeypatch.setattr(sharding, "MIN_STREAMS", least)
        assert sharding.stream_device_count(16) == devices
        jax.clear_caches()  # of the program compiled for the other number
        fits.append(
            behaviour_cloning.fit(
                navigator.create(jax.random.key(0)), train, test, settings(epochs=2), show_progress=False
            )
        )
    jax.clear_caches()
    for one, other in zip(jax.tree.leaves(vars(fits[0])), jax.tree.leaves(vars(fits[1])), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_an_interrupted_fit_gives_the_same_result(data, tmp_path, monkeypatch):
    """Interrupted at its third checkpoint, and resumed twice: the same bit for bit."""
    train, test, _ = data
    params, chosen = navigator.create(jax.random.key(0)), settings()
    uninterrupted = behaviour_cloning.fit(params, train, test, chosen, show_progress=False)
    save, saved = Checkpoints.save, []
    monkeypatch.setattr(behaviour_cloning, "SAVE_EVERY", 0.0)

    def interrupted(self, step, progress):
        saved.append(step)
        if len(saved) == 3:
            raise KeyboardInterrupt
        save(self, step, progress)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show_progress=False)
    logged = {}
    with tracking.add_listener(lambda step, values: logged.update({step: values})):
        resumed = behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show_progress=False)
    assert list(logged) == list(range(3, EPOCHS + 1))  # the epochs that were not yet saved
    curve = [value for values in logged.values() for name, value in values.items() if name.endswith("fit/test_mse")]
    np.testing.assert_array_equal(curve, resumed.test_mse[2:])
    assert saved == [1, 2, 3]
    assert same(vars(resumed), vars(uninterrupted))
    finished = behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show_progress=False)
    assert same(vars(finished), vars(uninterrupted))
    assert not any(leaf.committed for leaf in jax.tree.leaves(resumed.params))  # can be combined with sharded arrays


def test_checkpoints_of_another_fit_and_damaged_ones_are_refused(data, tmp_path):
    train, test, _ = data
    params = navigator.create(jax.random.key(0), "mean")

    def fit(epochs=2, params=params, train=train):
        chosen = settings(epochs=epochs)
        return behaviour_cloning.fit(params, train, test, chosen, checkpoints=tmp_path / "fit", show_progress=False)

    fit()
    others: list[tuple[str, dict[str, Any]]] = [
        ("another epochs", {"epochs": 3}),
        ("another signs of the first weights", {"params": navigator.create(jax.random.key(0), "feed-forward")}),
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


def test_a_checkpoint_folder_that_is_a_file_is_refused(data, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="expected a folder for checkpoints"):
        behaviour_cloning.fit(
            navigator.create(jax.random.key(0), "mean"),
            data[0],
            data[1],
            settings(epochs=1),
            checkpoints=tmp_path / "file",
        )


def test_a_batch_holds_every_frame_once():
    """In order along each stream; padding is masked; mirrored streams have their sides exchanged."""
    walks = [walk(s, 50 + 7 * s) for s in range(5)]
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0)), walks)
    batch = sequences.pack(walks, np.asarray(params.output_mean), streams=3, window=20, mirrored=True)
    streams = np.moveaxis(np.asarray(batch.u), 2, 0).reshape(6, -1, 2)
    mask = np.moveaxis(np.asarray(batch.mask), 2, 0).reshape(6, -1).astype(bool)
    u = np.concatenate([w.u for w in walks])
    np.testing.assert_allclose(streams[:3][mask[:3]], u)
    np.testing.assert_allclose(streams[3:][mask[3:]], u[:, ::-1])
    is_first = np.moveaxis(np.asarray(batch.is_first), 2, 0).reshape(6, -1)
    starts = np.flatnonzero(is_first[:3][mask[:3]])
    lengths = np.cumsum([0, *map(len, walks)])[:-1]
    assert set(lengths) <= set(starts) and len(starts) <= 5 + 3
    assert (~mask).sum() < 0.1 * mask.size


def test_mirrored_data_standardise_both_sides_alike(data):
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0)), data[0], mirrored=True)
    for name in navigator.SCALES:
        left, right = getattr(params, name)
        np.testing.assert_allclose(left, right, rtol=1e-12)
    unmirrored = behaviour_cloning.standardise(params, data[0], mirrored=False)
    assert unmirrored.input_mean[0] != unmirrored.input_mean[1]
    np.testing.assert_allclose(unmirrored.output_mean, np.concatenate([w.label for w in data[0]]).mean(0))


def test_a_fit_to_mirrored_data_is_made_symmetric(data):
    """The symmetric network has less error in a held-out room than the same network without symmetry."""
    train, test, unseen = data
    fitted = behaviour_cloning.fit(
        navigator.create(jax.random.key(0)), train[:2], test[:2], settings(mirrored=True), show_progress=False
    ).best
    assert fitted.symmetric
    assert (
        behaviour_cloning.score(fitted, unseen)["mse"]
        < behaviour_cloning.score(replace(fitted, symmetric=False), unseen)["mse"]
    )
    unmirrored = behaviour_cloning.fit(
        navigator.create(jax.random.key(0)), train[:2], test[:2], settings(epochs=1), show_progress=False
    )
    assert not unmirrored.best.symmetric


def test_command_feedback_lowers_only_the_training_error(data):
    """The recorded velocity, fed back, is nearly the next label; the test is without it."""
    train, test, _ = data
    params = navigator.create(jax.random.key(0), "lstm-efference")
    own = behaviour_cloning.fit(params, train, test, settings(), show_progress=False)
    recorded = behaviour_cloning.fit(params, train, test, settings(command_feedback=True), show_progress=False)
    assert recorded.train_mse[-1] < 0.8 * own.train_mse[-1]
    assert recorded.test_mse[-1] > 1.2 * recorded.train_mse[-1]


def test_splits_separate_halves_and_rooms():
    walks = [walk(s, 40, room=s % 4) for s in range(8)]
    first, second = sequences.split_halves(walks)
    assert [len(w) for w in first + second] == [20] * 16
    np.testing.assert_array_equal(first[3].u, walks[3].u[:20])
    np.testing.assert_array_equal(second[3].u, walks[3].u[20:])
    seen, unseen = sequences.split_by_room(walks, held_out=0.3, seed=1)
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
def test_settings_out_of_range_are_refused(match, changes, data):
    with pytest.raises(InputError, match=f"training {match}: expected"):
        behaviour_cloning.fit(
            navigator.create(jax.random.key(0)), data[0], data[1], settings(**changes), show_progress=False
        )


def test_missing_and_non_finite_data_are_refused(data):
    params, train = navigator.create(jax.random.key(0)), data[0]
    with pytest.raises(InputError, match="expected frames to test on, got none"):
        behaviour_cloning.fit(params, train, [], show_progress=False)
    broken = [replace(train[0], u=np.full_like(train[0].u, np.nan))]
    with pytest.raises(InputError, match="expected finite walks to train on"):
        behaviour_cloning.fit(params, broken, train, show_progress=False)
