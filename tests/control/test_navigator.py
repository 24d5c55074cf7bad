"""The network against Keras's formulas, its variants' one shape, and its file, good and bad."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import navigator as reference
from safetensors.numpy import load_file, save_file

from lgmdjax.control import navigator
from lgmdjax.errors import InputError

U = np.random.default_rng(0).uniform(0.5, 1, (40, 2))


@jax.jit
def drive(params, u):
    """Feed a sequence; velocities (frames, 2)."""
    return jax.lax.scan(lambda s, x: navigator.step(params, s, x), navigator.init(params), u)[1]


def scaled(variant, **scales):
    """Untrained, with other scales than the default, so that a mix-up shows."""
    params = navigator.create(jax.random.key(3), variant)
    return replace(
        params,
        input_mean=jnp.asarray([0.6, 0.7]),
        input_scale=jnp.asarray([0.1, 0.2]),
        output_mean=jnp.asarray([1.1, 1.3]),
        output_scale=jnp.asarray([0.5, 0.8]),
        **scales,
    )


def test_lstm_equals_keras(precision, strict):
    params = scaled("lstm")
    cell, head = params.weights["cell"], params.weights["head"]
    expected = reference.lstm(
        (U - np.asarray(params.input_mean)) / np.asarray(params.input_scale),
        np.asarray(cell["dense_i"]["kernel"]),
        np.asarray(cell["dense_h"]["kernel"]),
        np.asarray(cell["dense_h"]["bias"]),
        np.asarray(head["kernel"]),
        np.asarray(head["bias"]),
    )
    expected = np.asarray(params.output_mean) + np.asarray(params.output_scale) * expected
    tolerance = 1e-12 if precision == "float64" else 1e-5
    np.testing.assert_allclose(drive(params, jnp.asarray(U, dtype=float)), expected, atol=tolerance)


def test_starts_as_keras_does():
    """Forget bias 1, the others 0; orthogonal recurrence; inputs within Glorot's bound."""
    cell = navigator.create(jax.random.key(0)).weights["cell"]
    np.testing.assert_array_equal(cell["dense_h"]["bias"], np.repeat([0.0, 1.0, 0.0, 0.0], 32))
    recurrence = np.asarray(cell["dense_h"]["kernel"])
    np.testing.assert_allclose(recurrence @ recurrence.T, np.eye(32), atol=1e-5)
    bound = np.sqrt(6 / (2 + 128))
    assert bound * 0.9 < np.abs(cell["dense_i"]["kernel"]).max() <= bound


def test_only_the_networks_with_memory_remember():
    for variant, remembers in (("lstm", True), ("lstm-efference", True), ("feed-forward", False)):
        params = scaled(variant)
        last = [drive(params, jnp.asarray(u))[-1] for u in (U, np.concatenate([U[:20][::-1], U[20:]]))]
        assert np.any(np.abs(last[0] - last[1]) > 1e-9) == remembers


def test_efference_copy_is_the_last_velocity():
    """Only the variant that has it hears of a changed last velocity; the first one hears of the mean."""
    for variant, hears in (("lstm", False), ("feed-forward", False), ("lstm-efference", True)):
        params = scaled(variant)
        state = navigator.init(params)
        np.testing.assert_array_equal(state.velocity, params.output_mean)
        said, velocity = navigator.step(params, state, jnp.asarray(U[0]))
        np.testing.assert_array_equal(said.velocity, velocity)
        turned = replace(state, velocity=jnp.asarray([-1.0, 1.0]))
        _, other = navigator.step(params, turned, jnp.asarray(U[0]))
        assert np.any(np.abs(other - velocity) > 1e-9) == hears


@pytest.mark.parametrize("variant", navigator.VARIANTS)
def test_a_symmetric_navigator_walks_the_mirrored_walk_in_the_mirrored_world(variant, precision):
    """It is the mean of what the same network does in the world and, mirrored back, in its mirror image."""
    u, alone = jnp.asarray(U, dtype=float), scaled(variant)
    both = replace(alone, symmetric=True)
    np.testing.assert_array_equal(drive(both, u[:, ::-1]), drive(both, u)[:, ::-1])
    if variant == "lstm-efference":  # hears its own last velocity, which is the mean's
        return
    expected = (np.asarray(drive(alone, u)) + np.asarray(drive(alone, u[:, ::-1]))[:, ::-1]) / 2
    np.testing.assert_allclose(drive(both, u), expected, rtol=1e-12 if precision == "float64" else 1e-5)


def test_the_mean_is_the_mean():
    params = scaled("mean")
    np.testing.assert_array_equal(drive(params, jnp.asarray(U)), np.tile(params.output_mean, (40, 1)))


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("variant", navigator.VARIANTS)
def test_a_saved_navigator_is_the_same(tmp_path, variant, symmetric, precision):
    params, path = scaled(variant, symmetric=symmetric), tmp_path / "controller.safetensors"
    told = {"calibration": {"threshold": 4.5}, "camera": {"width": 320, "height": 240}}
    navigator.save(path, params, told)
    loaded, metadata = navigator.load(path)
    assert jax.tree.structure(loaded) == jax.tree.structure(params)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(a == b)), loaded, params))
    assert metadata["calibration"] == told["calibration"] and metadata["camera"] == told["camera"]
    assert metadata["variant"] == variant and metadata["versions"]["jax"] == jax.__version__
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    u = jnp.asarray(U, dtype=float)
    np.testing.assert_array_equal(drive(loaded, u), drive(params, u))


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "controller.safetensors"
    navigator.save(path, navigator.create(jax.random.key(0)))
    return path


def rewrite(path, header=None, **tensors):
    """Save the file again with other metadata or tensors."""
    with navigator.safe_open(path, framework="numpy") as file:
        text = dict(file.metadata())
    save_file(load_file(path) | tensors, path, text | (header or {}))


def refused(path):
    """The one line that loading it ends in."""
    with pytest.raises(InputError) as caught:
        navigator.load(path)
    line = str(caught.value)
    assert "\n" not in line and str(path) in line and "expected" in line and "got" in line and "makes one" in line
    return line


def test_a_missing_or_damaged_file_is_refused(good, tmp_path):
    refused(tmp_path / "nothing.safetensors")
    refused(tmp_path)
    whole = good.read_bytes()
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        good.write_bytes(whole[:size])
        refused(good)
    good.write_bytes(b"PK" + whole[2:])
    refused(good)


def test_another_kind_of_file_or_version_is_refused(good):
    rewrite(good, {"version": "0"})
    assert "version 2, got 0" in refused(good)
    rewrite(good, {"format": "something"})
    assert "another kind" in refused(good)
    save_file({"weights": np.zeros(3)}, good)
    assert "another kind" in refused(good)


@pytest.mark.usefixtures("unchecked")
def test_contents_that_do_not_fit_are_refused(good):
    whole = good.read_bytes()
    for broken in (
        {"header": {"variant": '"transformer"'}},
        {"header": {"variant": "lstm"}},
        {"header": {"units": "16"}},
        {"header": {"units": "-1"}},
        {"header": {"units": '"many"'}},
        {"header": {"units": "1000000000"}},
        {"input_mean": np.zeros(3)},
        {"weights.extra": np.zeros(3)},
        {"output_mean": np.full(2, np.nan)},
    ):
        good.write_bytes(whole)
        rewrite(good, **broken)
        with pytest.raises(InputError, match="expected"):
            navigator.load(good)


def test_nothing_is_left_where_nothing_can_be_written(tmp_path):
    params = navigator.create(jax.random.key(0))
    with pytest.raises(InputError, match="expected a place to write to"):
        navigator.save(tmp_path / "no" / "where.safetensors", params)
    broken = replace(params, output_mean=jnp.asarray([jnp.nan, 0.0]))
    with pytest.raises(InputError, match="expected finite weights"):
        navigator.save(tmp_path / "controller.safetensors", broken)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("unchecked")
def test_a_variant_that_is_none_is_refused():
    with pytest.raises(InputError, match=json.dumps("gru").replace('"', "'")):
        navigator.create(jax.random.key(0), "gru")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="units: expected 1 or more"):
        navigator.create(jax.random.key(0), units=0)
