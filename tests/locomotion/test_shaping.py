"""The shaping networks: agreement with loops in NumPy, the printed input, valid and invalid files."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

from lgmdjax.errors import InputError
from lgmdjax.locomotion import shaping


def by_hand(params, rhythm, velocity):
    """Return the joint targets by loops over legs, units and joints."""
    angles = np.zeros((6, 3))
    for leg in range(6):
        inputs = [rhythm[leg, 0], 0.0 if params.printed_input else rhythm[leg, 1], velocity[0 if leg < 3 else 1]]
        for joint in range(3):
            angles[leg, joint] = params.b2[leg, joint]
            for unit in range(6):
                drive = params.b1[leg, unit] + sum(inputs[i] * params.w1[leg, i, unit] for i in range(3))
                angles[leg, joint] += max(0.0, drive) * params.w2[leg, unit, joint]
    return angles


@pytest.fixture
def params():
    initial = shaping.init(jax.random.key(0))
    return replace(initial, b1=jax.random.normal(jax.random.key(1), (6, 6)), b2=jnp.ones((6, 3)))


@pytest.fixture
def rhythm():
    return jax.random.normal(jax.random.key(2), (6, 2))


@pytest.mark.parametrize("printed_input", [False, True])
def test_equals_loops(params, rhythm, printed_input):
    params, velocity = params.replace(printed_input=printed_input), jnp.array([0.7, -0.4])
    np.testing.assert_allclose(shaping.apply(params, rhythm, velocity), by_hand(params, rhythm, velocity), atol=1e-12)


def test_left_legs_depend_on_the_left_velocity_only(params, rhythm):
    equal = shaping.apply(params, rhythm, jnp.array([1.0, 1.0]))
    changed = shaping.apply(params, rhythm, jnp.array([1.5, 1.0])) != equal
    assert np.any(changed[:3], axis=1).all() and not np.any(changed[3:])


def test_the_printed_input_ignores_adaptation(params, rhythm):
    other, velocity = rhythm.at[:, 1].add(1.0), jnp.ones(2)
    printed = params.replace(printed_input=True)
    np.testing.assert_array_equal(shaping.apply(printed, rhythm, velocity), shaping.apply(printed, other, velocity))
    assert np.any(shaping.apply(params, rhythm, velocity) != shaping.apply(params, other, velocity))


def test_gradient_reaches_every_weight_and_both_inputs(params, rhythm):
    def energy(params, rhythm, velocity):
        return jnp.sum(shaping.apply(params, rhythm, velocity) ** 2)

    gradients = jax.grad(energy, argnums=(0, 1, 2))(params, rhythm, jnp.ones(2))
    for leaf in jax.tree.leaves(gradients):
        assert np.all(np.isfinite(leaf)) and np.any(leaf != 0)
    printed = jax.grad(energy)(params.replace(printed_input=True), rhythm, jnp.ones(2))
    assert np.all(printed.w1[:, 1] == 0) and np.any(printed.w1[:, 0] != 0)


def test_runs_in_either_precision(precision, strict):
    angles = shaping.apply(shaping.init(jax.random.key(0)), jnp.ones((6, 2)), jnp.ones(2))
    assert angles.dtype == precision and angles.shape == (6, 3)


def test_load_returns_what_was_saved(tmp_path, params, rhythm):
    path = tmp_path / "shaping.safetensors"
    shaping.save(path, params.replace(printed_input=True), {"steps": 300, "note": "trial"})
    read = shaping.load(path)
    assert read.printed_input and read.w1.dtype == jnp.zeros(()).dtype
    for name in shaping.SHAPES:
        np.testing.assert_array_equal(getattr(read, name), np.float32(getattr(params, name)))
    metadata = shaping.read_metadata(path)
    assert (metadata["steps"], metadata["note"], metadata["literal"], metadata["version"]) == (300, "trial", True, "1")
    assert [p.name for p in tmp_path.iterdir()] == ["shaping.safetensors"]


def test_the_pretrained_networks_load_and_are_symmetric():
    networks = shaping.load_pretrained()
    assert not networks.printed_input
    np.testing.assert_array_equal(networks.w1[:3], networks.w1[:2:-1])
    np.testing.assert_array_equal(networks.w2[:3], networks.w2[:2:-1] * jnp.array([-1.0, 1.0, 1.0]))


def weights(**changed):
    return {name: np.zeros(shape, np.float32) for name, shape in shaping.SHAPES.items()} | changed


GOOD = {"format": shaping.FILE.format, "version": shaping.FILE.version, "literal": json.dumps(False)}


@pytest.mark.parametrize(
    ("contents", "header", "message"),
    [
        (weights(), GOOD | {"format": "lgmdjax.navigator"}, "expected shaping networks, got another kind"),
        (weights(), None, "expected shaping networks, got another kind"),
        (weights(), GOOD | {"version": "0"}, "expected version 1, got 0"),
        (weights(b1=np.zeros((4, 6), np.float32)), GOOD, r"'b1': \(4, 6\)"),
        ({"w1": weights()["w1"]}, GOOD, "expected weights"),
        (weights(b2=np.full((6, 3), np.nan, np.float32)), GOOD, "expected finite weights"),
    ],
)
def test_invalid_files_are_refused_in_one_line(tmp_path, contents, header, message):
    path = tmp_path / "wrong.safetensors"
    save_file(contents, path, header)
    with pytest.raises(InputError, match=message) as refusal:
        shaping.load(path)
    assert "\n" not in str(refusal.value) and str(path) in str(refusal.value)


def test_missing_and_truncated_files_are_refused(tmp_path, params):
    with pytest.raises(InputError, match="lgmdjax fit-gait"):
        shaping.load(tmp_path / "none.safetensors")
    path = tmp_path / "cut.safetensors"
    shaping.save(path, params)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="expected safetensors"):
        shaping.load(path)


def test_a_failed_save_leaves_no_file(tmp_path, params):
    with pytest.raises(InputError, match="expected a place to write to"):
        shaping.save(tmp_path / "no folder" / "shaping.safetensors", params)
    assert not list(tmp_path.iterdir())
