"""The shaping networks: the map against loops in NumPy, the paper's input, files good and bad."""

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
    """One leg, one unit, one joint after the other."""
    angles = np.zeros((6, 3))
    for leg in range(6):
        inputs = [rhythm[leg, 0], 0.0 if params.literal else rhythm[leg, 1], velocity[0 if leg < 3 else 1]]
        for joint in range(3):
            angles[leg, joint] = params.b2[leg, joint]
            for unit in range(6):
                drive = params.b1[leg, unit] + sum(inputs[i] * params.w1[leg, i, unit] for i in range(3))
                angles[leg, joint] += max(0.0, drive) * params.w2[leg, unit, joint]
    return angles


@pytest.fixture
def params():
    drawn = shaping.init(jax.random.key(0))
    return replace(drawn, b1=jax.random.normal(jax.random.key(1), (6, 6)), b2=jnp.ones((6, 3)))


@pytest.fixture
def rhythm():
    return jax.random.normal(jax.random.key(2), (6, 2))


@pytest.mark.parametrize("literal", [False, True])
def test_equals_loops(params, rhythm, literal):
    params, velocity = params.replace(literal=literal), jnp.array([0.7, -0.4])
    np.testing.assert_allclose(shaping.shape(params, rhythm, velocity), by_hand(params, rhythm, velocity), atol=1e-12)


def test_left_legs_hear_the_left_velocity_only(params, rhythm):
    still = shaping.shape(params, rhythm, jnp.array([1.0, 1.0]))
    changed = shaping.shape(params, rhythm, jnp.array([1.5, 1.0])) != still
    assert np.any(changed[:3], axis=1).all() and not np.any(changed[3:])


def test_the_papers_input_is_deaf_to_adaptation(params, rhythm):
    other, velocity = rhythm.at[:, 1].add(1.0), jnp.ones(2)
    deaf = params.replace(literal=True)
    np.testing.assert_array_equal(shaping.shape(deaf, rhythm, velocity), shaping.shape(deaf, other, velocity))
    assert np.any(shaping.shape(params, rhythm, velocity) != shaping.shape(params, other, velocity))


def test_gradient_reaches_every_weight_and_both_inputs(params, rhythm):
    def energy(params, rhythm, velocity):
        return jnp.sum(shaping.shape(params, rhythm, velocity) ** 2)

    gradients = jax.grad(energy, argnums=(0, 1, 2))(params, rhythm, jnp.ones(2))
    for leaf in jax.tree.leaves(gradients):
        assert np.all(np.isfinite(leaf)) and np.any(leaf != 0)
    deaf = jax.grad(energy)(params.replace(literal=True), rhythm, jnp.ones(2))
    assert np.all(deaf.w1[:, 1] == 0) and np.any(deaf.w1[:, 0] != 0)


def test_runs_in_either_precision(precision, strict):
    angles = shaping.shape(shaping.init(jax.random.key(0)), jnp.ones((6, 2)), jnp.ones(2))
    assert angles.dtype == precision and angles.shape == (6, 3)


def test_a_file_brings_back_the_networks(tmp_path, params, rhythm):
    path = tmp_path / "shaping.safetensors"
    shaping.save(path, params.replace(literal=True), {"steps": 300, "note": "trial"})
    read = shaping.load(path)
    assert read.literal and read.w1.dtype == jnp.zeros(()).dtype
    for name in shaping.SHAPES:
        np.testing.assert_array_equal(getattr(read, name), np.float32(getattr(params, name)))
    said = shaping.metadata(path)
    assert (said["steps"], said["note"], said["literal"], said["version"]) == (300, "trial", True, "1")
    assert [p.name for p in tmp_path.iterdir()] == ["shaping.safetensors"]


def test_the_packaged_networks_load_and_are_mirrored():
    networks = shaping.taught()
    assert not networks.literal
    np.testing.assert_array_equal(networks.w1[:3], networks.w1[:2:-1])
    np.testing.assert_array_equal(networks.w2[:3], networks.w2[:2:-1] * jnp.array([-1.0, 1.0, 1.0]))


def weights(**changed):
    return {name: np.zeros(shape, np.float32) for name, shape in shaping.SHAPES.items()} | changed


GOOD = {"format": shaping.FORMAT, "version": shaping.VERSION, "literal": json.dumps(False)}


@pytest.mark.parametrize(
    ("contents", "header", "said"),
    [
        (weights(), GOOD | {"format": "lgmdjax.navigator"}, "expected shaping networks, got another kind"),
        (weights(), None, "expected shaping networks, got another kind"),
        (weights(), GOOD | {"version": "0"}, "expected version 1, got 0"),
        (weights(b1=np.zeros((4, 6), np.float32)), GOOD, r"'b1': \(4, 6\)"),
        ({"w1": weights()["w1"]}, GOOD, "expected weights"),
        (weights(b2=np.full((6, 3), np.nan, np.float32)), GOOD, "expected finite weights"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path, contents, header, said):
    path = tmp_path / "wrong.safetensors"
    save_file(contents, path, header)
    with pytest.raises(InputError, match=said) as refusal:
        shaping.load(path)
    assert "\n" not in str(refusal.value) and str(path) in str(refusal.value)


def test_missing_and_cut_files_are_refused(tmp_path, params):
    with pytest.raises(InputError, match="lgmdjax fit-gait"):
        shaping.load(tmp_path / "none.safetensors")
    path = tmp_path / "cut.safetensors"
    shaping.save(path, params)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="expected safetensors"):
        shaping.load(path)


def test_nothing_half_written_where_writing_fails(tmp_path, params):
    with pytest.raises(InputError, match="expected a place to write to"):
        shaping.save(tmp_path / "no folder" / "shaping.safetensors", params)
    assert not list(tmp_path.iterdir())
