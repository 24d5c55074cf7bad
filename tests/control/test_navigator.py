"""The network against Keras's formulas, the variants' common interface, and files, valid and invalid."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import navigator as reference
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from lgmdjax.control import names, navigator
from lgmdjax.errors import InputError

U = np.random.default_rng(0).uniform(0.5, 1, (40, 2))


@jax.jit
def run(params, u):
    """Velocities (frames, 2) for a sequence of u."""
    return jax.lax.scan(lambda s, x: navigator.step(params, s, x), navigator.init(params), u)[1]


def scaled(variant, **scales):
    """An untrained navigator with scales other than the default, so that exchanged ones are noticed."""
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
    np.testing.assert_allclose(run(params, jnp.asarray(U, dtype=float)), expected, atol=tolerance)


def test_initial_weights_are_those_of_keras():
    """Forget bias 1, other biases 0; orthogonal recurrence; input weights within Glorot's bound."""
    cell = navigator.create(jax.random.key(0)).weights["cell"]
    np.testing.assert_array_equal(cell["dense_h"]["bias"], np.repeat([0.0, 1.0, 0.0, 0.0], 32))
    recurrence = np.asarray(cell["dense_h"]["kernel"])
    np.testing.assert_allclose(recurrence @ recurrence.T, np.eye(32), atol=1e-5)
    bound = np.sqrt(6 / (2 + 128))
    assert bound * 0.9 < np.abs(cell["dense_i"]["kernel"]).max() <= bound


def test_only_recurrent_variants_depend_on_earlier_inputs():
    for variant, recurrent in (("lstm", True), ("lstm-efference", True), ("feed-forward", False)):
        params = scaled(variant)
        last = [run(params, jnp.asarray(u))[-1] for u in (U, np.concatenate([U[:20][::-1], U[20:]]))]
        assert np.any(np.abs(last[0] - last[1]) > 1e-9) == recurrent


def test_efference_copy_is_the_last_velocity():
    """Only `lstm-efference` depends on the last velocity; the first one is the mean."""
    for variant, depends in (("lstm", False), ("feed-forward", False), ("lstm-efference", True)):
        params = scaled(variant)
        state = navigator.init(params)
        np.testing.assert_array_equal(state.velocity, params.output_mean)
        after, velocity = navigator.step(params, state, jnp.asarray(U[0]))
        np.testing.assert_array_equal(after.velocity, velocity)
        turned = replace(state, velocity=jnp.asarray([-1.0, 1.0]))
        _, other = navigator.step(params, turned, jnp.asarray(U[0]))
        assert np.any(np.abs(other - velocity) > 1e-9) == depends


@pytest.mark.parametrize("variant", names.VARIANTS)
def test_a_symmetric_navigator_mirrors_its_velocity_for_mirrored_inputs(variant, precision):
    """It averages the network's outputs for the input and, mirrored back, for the mirrored input."""
    u, single = jnp.asarray(U, dtype=float), scaled(variant)
    both = replace(single, symmetric=True)
    np.testing.assert_array_equal(run(both, u[:, ::-1]), run(both, u)[:, ::-1])
    if variant == "lstm-efference":  # its next input is the averaged velocity
        return
    expected = (np.asarray(run(single, u)) + np.asarray(run(single, u[:, ::-1]))[:, ::-1]) / 2
    np.testing.assert_allclose(run(both, u), expected, rtol=1e-12 if precision == "float64" else 1e-5)


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize(
    ("variant", "fed_back"), [*((variant, False) for variant in names.VARIANTS), ("lstm-efference", True)]
)
def test_a_run_equals_single_steps(variant, fed_back, symmetric):
    """Three streams that begin again at other frames, after eight frames of walking."""
    params, rng = scaled(variant, symmetric=symmetric), np.random.default_rng(1)
    u, executed = (jnp.asarray(rng.uniform(0.5, 1, (16, 3, 2))) for _ in range(2))
    is_first = jnp.asarray(rng.uniform(size=(16, 3)) < 0.2)
    initial = navigator.init(params)

    @jax.jit
    @jax.vmap
    def frame(state, u, is_first, executed):
        state = replace(state, velocity=executed) if fed_back else state
        state = jax.tree.map(lambda a, b: jnp.where(is_first, a, b), initial, state)
        return navigator.step(params, state, u)

    states, after = (jax.tree.map(lambda x: jnp.stack([x] * 3), initial),) * 2
    expected, run_velocities = [], []
    for k in range(16):
        states, velocity = frame(states, u[k], is_first[k], executed[k])
        expected.append(velocity)
    run_half = jax.jit(navigator.run)
    for half in (slice(0, 8), slice(8, 16)):
        after, velocity = run_half(params, after, u[half], is_first[half], executed[half] if fed_back else None)
        run_velocities.extend(velocity)
    np.testing.assert_allclose(run_velocities, expected, rtol=1e-12)
    for got, wanted in zip(jax.tree.leaves(after), jax.tree.leaves(states), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-12)


def test_variant_mean_returns_the_mean():
    params = scaled("mean")
    np.testing.assert_array_equal(run(params, jnp.asarray(U)), np.tile(params.output_mean, (40, 1)))


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("variant", names.VARIANTS)
def test_a_saved_navigator_is_loaded_unchanged(tmp_path, variant, symmetric, precision):
    params, path = scaled(variant, symmetric=symmetric), tmp_path / "controller.safetensors"
    header = {"calibration": {"threshold": 4.5}, "camera": {"width": 320, "height": 240}}
    navigator.save(path, params, header)
    loaded, metadata = navigator.load(path)
    assert jax.tree.structure(loaded) == jax.tree.structure(params)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(a == b)), loaded, params))
    assert metadata["calibration"] == header["calibration"] and metadata["camera"] == header["camera"]
    assert metadata["variant"] == variant and metadata["versions"]["jax"] == jax.__version__
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    u = jnp.asarray(U, dtype=float)
    np.testing.assert_array_equal(run(loaded, u), run(params, u))


@pytest.fixture
def valid(tmp_path):
    path = tmp_path / "controller.safetensors"
    navigator.save(path, navigator.create(jax.random.key(0)))
    return path


def rewrite(path, header=None, **tensors):
    """Save the file again with changed metadata or tensors."""
    with safe_open(path, framework="numpy") as file:
        text = dict(file.metadata())
    save_file(load_file(path) | tensors, path, text | (header or {}))


def refused(path):
    """The message, of one line, that loading this file raises."""
    with pytest.raises(InputError) as caught:
        navigator.load(path)
    line = str(caught.value)
    assert "\n" not in line and str(path) in line and "expected" in line and "got" in line and "makes one" in line
    return line


def test_a_missing_or_damaged_file_is_refused(valid, tmp_path):
    refused(tmp_path / "nothing.safetensors")
    refused(tmp_path)
    whole = valid.read_bytes()
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        valid.write_bytes(whole[:size])
        refused(valid)
    valid.write_bytes(b"PK" + whole[2:])
    refused(valid)


def test_another_kind_of_file_or_version_is_refused(valid):
    rewrite(valid, {"version": "0"})
    assert "version 2, got 0" in refused(valid)
    rewrite(valid, {"format": "something"})
    assert "another kind" in refused(valid)
    save_file({"weights": np.zeros(3)}, valid)
    assert "another kind" in refused(valid)


@pytest.mark.usefixtures("unchecked")
def test_contents_of_a_wrong_shape_or_kind_are_refused(valid):
    whole = valid.read_bytes()
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
        valid.write_bytes(whole)
        rewrite(valid, **broken)
        with pytest.raises(InputError, match="expected"):
            navigator.load(valid)


def test_a_failed_save_leaves_no_file(tmp_path):
    params = navigator.create(jax.random.key(0))
    with pytest.raises(InputError, match="expected a place to write to"):
        navigator.save(tmp_path / "no" / "where.safetensors", params)
    broken = replace(params, output_mean=jnp.asarray([jnp.nan, 0.0]))
    with pytest.raises(InputError, match="expected finite weights"):
        navigator.save(tmp_path / "controller.safetensors", broken)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("unchecked")
def test_an_unknown_variant_is_refused():
    with pytest.raises(InputError, match=json.dumps("gru").replace('"', "'")):
        navigator.create(jax.random.key(0), "gru")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="units: expected 1 or more"):
        navigator.create(jax.random.key(0), units=0)
