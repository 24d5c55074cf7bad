"""Robots from files: their policies, camera and fingerprint."""

import importlib
import json
import shutil
import sys
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from lgmdjax.control import navigator, policies
from lgmdjax.control.names import POLICY_NAMES
from lgmdjax.detectors import dsn, emd, eta, grm, lgmd, scaled
from lgmdjax.errors import InputError
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.sensors.settings import CameraSettings, Resolution
from lgmdjax.simulation import assembly


@pytest.fixture(scope="module")
def robot():
    return assembly.load_robot()


def test_with_policy_replaces_the_policy_of_that_name_alone(robot):
    untrained = navigator.create(jax.random.key(1), units=3)
    before, after = (
        one.controller.policy.policies for one in (robot, assembly.with_policy(robot, "learned", untrained))
    )
    for index, name in enumerate(POLICY_NAMES):
        assert (after[index] is untrained) if name == "learned" else (after[index] is before[index])


def test_select_policy_activates_it(robot):
    for index, policy in enumerate(policies.POLICIES):
        assert int(assembly.select_policy(robot, policy).controller.policy.active) == index


def test_with_camera_changes_camera_and_pooling(robot):
    other = assembly.with_camera(robot, CameraSettings(width=80, height=60, overlap=0.7, pooling=3))
    assert (other.camera.width, other.camera.height, other.camera.overlap) == (80, 60, 0.7)
    assert other.controller.detector.pooling == 3
    assert other.controller.detector.threshold == robot.controller.detector.threshold


def test_a_robot_keeps_its_field_at_every_resolution(robot):
    """What its detectors see is what it was trained with, also where settings say nothing of it."""
    trained = assembly.with_camera(robot, CameraSettings(width=80, height=60, overlap=0.7, ground=0.25, falloff=1.5))
    finer = assembly.with_resolution(trained, CameraSettings(width=160, height=120, pooling=6, ground=0.0))
    assert assembly.camera_settings(finer) == CameraSettings(
        width=160, height=120, pooling=6, overlap=0.7, ground=0.25, falloff=1.5
    )
    assert finer.controller.detector.edges == trained.controller.detector.edges
    scaled = assembly.with_resolution(robot, assembly.scale_resolution(robot, 160))
    assert assembly.camera_settings(scaled).falloff == assembly.camera_settings(robot).falloff


@pytest.mark.parametrize("field", [{"overlap": 0.2}, {"overlap": 1.1}, {"ground": 1.0}, {"falloff": float("nan")}])
def test_an_impossible_field_is_refused_when_it_is_made(field):
    (name,) = field
    with pytest.raises(InputError, match=f"expected an? {name} of the eyes of .* got"):
        CameraSettings(width=80, height=60, **field)
    with pytest.raises(InputError, match=f"eyes.{name}: expected a finite number of"):
        assembly.read_camera_settings({"eyes": {"width": 80, "height": 60} | field})


def test_fingerprint_depends_on_every_number_and_on_the_camera(robot):
    same = assembly.load_robot()
    assert assembly.fingerprint(robot) == assembly.fingerprint(same)
    others = (
        assembly.select_policy(robot, policies.BLIND),
        assembly.with_camera(robot, CameraSettings(width=80, height=60)),
        assembly.with_policy(robot, "blind", policies.BlindParams(velocity=jnp.asarray([1.0, 1.0]))),
        replace(robot, head_sway=jnp.asarray(1.0)),
    )
    assert len({assembly.fingerprint(one) for one in (robot, *others)}) == 5


def test_another_detector_is_part_of_the_robot(robot):
    models: tuple[Any, ...] = (emd, dsn)
    for model in models:
        other = assembly.with_detector(robot, model)
        assert other.controller.detector_model is model
        assert jax.tree.structure(other.controller.detector) == jax.tree.structure(model.Params())
        assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(other.controller.detector))
    with pytest.raises(InputError, match="detector eta: expected init and step for a frame"):
        assembly.with_detector(robot, eta)
    with pytest.raises(InputError, match="lgmd threshold"):
        assembly.with_detector(robot, lgmd, lgmd.Params(threshold=-1.0))


def test_a_detector_keeps_its_cells_with_another_camera(robot):
    inside = scaled.Params(model=emd, detector=emd.Params(), pooling=3)
    finer = assembly.with_resolution(
        assembly.with_detector(robot, scaled, inside), Resolution(width=160, height=120, pooling=6)
    )
    assert finer.controller.detector.pooling == assembly.camera_settings(finer).pooling == 6
    fixed = assembly.with_detector(robot, grm)
    with pytest.raises(
        InputError, match=r"parameter pooling for a camera with pooling 6, got one of lgmdjax.detectors.grm"
    ):
        assembly.with_resolution(fixed, Resolution(width=160, height=120, pooling=6))


OWN = """
from lgmdjax.detectors.emd import Params, Response, init
from lgmdjax.detectors import emd

def step(params, state, frame):
    return emd.step(params, state, {})
"""


def test_fingerprint_tells_detectors_apart_and_knows_the_source_of_your_own(robot, tmp_path, monkeypatch):
    """One name and equal parameters, in this process and in the next one, where the user has changed the file."""
    monkeypatch.syspath_prepend(tmp_path)
    found = [assembly.fingerprint(assembly.with_detector(robot, emd))]
    inside = scaled.Params(model=emd, detector=emd.Params())
    found.append(assembly.fingerprint(assembly.with_detector(robot, scaled, inside)))
    for frame in ("frame", "2.0 * frame"):
        (tmp_path / "own_detector.py").write_text(OWN.format(frame))
        monkeypatch.delitem(sys.modules, "own_detector", raising=False)
        importlib.invalidate_caches()
        own: Any = importlib.import_module("own_detector")
        found.append(assembly.fingerprint(assembly.with_detector(robot, own)))
        assert found[-1] == assembly.fingerprint(assembly.with_detector(robot, own))
    assert len({assembly.fingerprint(robot), *found}) == 5


def test_placeholders_walk_straight():
    """What is not given: the teacher's base velocity for policies blind and random."""
    switch = assembly.make_policies()
    np.testing.assert_allclose(switch.policies[2].velocity, 1.3)
    np.testing.assert_allclose(switch.policies[4].velocities, np.full((assembly.REPLAY_LENGTH, 2), 1.3))


def test_a_folder_without_the_files_of_its_stage_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected"):
        assembly.load_robot(train_folder=tmp_path)
    with pytest.raises(InputError, match="expected"):
        assembly.load_robot(gait_folder=tmp_path)


@pytest.fixture
def folder(tmp_path):
    """A folder with files of the pretrained robot, which the tests change; without checksums, as older ones."""
    for name in ("controller.safetensors", "shaping.safetensors", "baselines.npz"):
        shutil.copy(PRETRAINED_DIR / name, tmp_path)
    return tmp_path


def rewrite_controller(folder, header=(), tensors=()):
    """Write the controller again as another program would."""
    path = folder / "controller.safetensors"
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata() | {name: json.dumps(value) for name, value in dict(header).items()}
    arrays = load_file(path) | dict(tensors)
    # A checksum would tell of the change first.
    save_file(arrays, path, {name: text for name, text in metadata.items() if text != "null" and name != "sha256"})


EYES = {"width": 80, "height": 60, "overlap": 0.5, "pooling": 3}
LGMD = {"threshold": 0.1, "suppression": 5.0, "inhibition": 0.1}


@pytest.mark.parametrize(
    ("header", "words"),
    [
        *(({"eyes": EYES | {"pooling": value}}, "eyes.pooling: expected an integer") for value in (0, 7.5, 10_000)),
        ({"eyes": EYES | {"pooling": 1000}}, "pooling"),
        ({"eyes": EYES | {"width": 10**9}}, "eyes.width: expected an integer of 1 to 4096"),
        ({"eyes": EYES | {"overlap": "half"}}, "eyes.overlap"),
        ({"eyes": []}, "header.eyes: expected an object"),
        ({"eyes": None}, "header: expected an object with eyes"),
        *(
            ({"lgmd": LGMD | {"threshold": value}}, "lgmd.threshold: expected a finite number")
            for value in ([1], "1", True, -1, 1e999)
        ),
        ({"symmetric": "yes"}, "header.symmetric: expected true or false, got 'yes'"),
        ({"units": 10**9}, "header.units: expected an integer"),
        ({"variant": ["lstm"]}, "header.variant: expected one of"),
        ({"variant": None}, "header: expected an object with variant"),
    ],
)
def test_a_controller_with_another_header_is_refused(folder, header, words):
    rewrite_controller(folder, header)
    with pytest.raises(InputError, match=words) as caught:
        assembly.load_robot(folder, folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("tensors", "words"),
    [
        ({"input_scale": np.zeros(2, np.float32)}, "input_scale: expected finite floats of 1e-06"),
        ({"output_scale": np.array([1, -1], np.float32)}, "output_scale"),
        ({"input_mean": np.zeros(2, np.int64)}, "input_mean: .*got int64"),
        ({"input_mean": np.full(2, 1e38, np.float32)}, "input_mean"),
    ],
)
def test_a_controller_with_other_weights_is_refused(folder, tensors, words):
    rewrite_controller(folder, tensors=tensors)
    with pytest.raises(InputError, match=words):
        assembly.load_robot(folder, folder)


GAIN, REPLAYED = np.asarray(5.0), np.ones((assembly.REPLAY_LENGTH, 2))


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({}, "expected an object with gain, replayed"),
        ({"gain": np.asarray(np.nan), "replayed": REPLAYED}, "baselines.npz.gain: expected a finite|finite floats"),
        ({"gain": np.asarray("5"), "replayed": REPLAYED}, "gain"),
        ({"gain": np.ones(1), "replayed": REPLAYED}, "gain"),
        ({"gain": GAIN, "replayed": np.ones((4096, 3))}, r"replayed: .* got float64 of shape \(4096, 3\)"),
        ({"gain": GAIN, "replayed": REPLAYED[:0]}, "replayed"),
        ({"gain": GAIN, "replayed": np.where(REPLAYED == 1, np.nan, 0)}, "replayed"),
    ],
)
def test_other_baselines_are_refused(folder, arrays, words):
    np.savez(folder / "baselines.npz", **arrays)
    with pytest.raises(InputError, match=words):
        assembly.load_robot(folder, folder)


@pytest.mark.parametrize("value", [[0.25], "0.25", True, 1e999, -1, None, 10**400])
def test_a_calibration_with_another_threshold_is_refused(tmp_path, value):
    (tmp_path / "calibration.json").write_text(json.dumps(LGMD | {"threshold": value}))
    with pytest.raises(InputError, match="threshold: expected a finite number"):
        assembly.load_detector(tmp_path)


@pytest.mark.parametrize("content", ["[]", "3", "{}", '{"threshold": 1}'])
def test_a_calibration_of_another_form_is_refused(tmp_path, content):
    (tmp_path / "calibration.json").write_text(content)
    with pytest.raises(InputError, match="expected an object with threshold, suppression, inhibition"):
        assembly.load_detector(tmp_path)
