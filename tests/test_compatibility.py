"""Files of version 0.1.0 can still be read, and every file of the package is part of the hash of cached programs.

`data/v0.1.0` was written by that version: parts of a run folder at smoke scale, with its episode cut to two walks of 60
frames, and a small navigator fitted to them, with its checkpoint. It cannot be written again.
"""

import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from safetensors.numpy import load_file

import lgmdjax
from lgmdjax import paths
from lgmdjax.control import navigator
from lgmdjax.errors import InputError
from lgmdjax.learning import behaviour_cloning
from lgmdjax.locomotion import shaping
from lgmdjax.runtime import export_cache, run_folders
from lgmdjax.simulation import assembly, episodes

OLD = Path(__file__).parent / "data" / "v0.1.0"
RUN = OLD / "smoke-0"


def test_the_root_is_the_package():
    assert Path(lgmdjax.__file__).resolve().parent == paths.PACKAGE_DIR
    for name in [name for name in sys.modules if name.startswith("lgmdjax.")]:
        assert Path(str(sys.modules[name].__file__)).resolve().is_relative_to(paths.PACKAGE_DIR)
    assert paths.SHAPING_FILE.is_file() and (paths.PRETRAINED_DIR / "controller.safetensors").is_file()


def test_the_hash_of_cached_programs_covers_every_file_of_the_package(tmp_path):
    """A change of any file in any folder must change the hash; else a cached program would be out of date."""
    copy = tmp_path / "lgmdjax"
    shutil.copytree(paths.PACKAGE_DIR, copy, ignore=shutil.ignore_patterns("__pycache__"))
    assert export_cache.hash_folder(copy) == export_cache.PACKAGE_DIGEST
    for path in sorted(copy.rglob("*")):
        if path.is_file():
            content = path.read_bytes()
            path.write_bytes(content + b"\n")
            assert export_cache.hash_folder(copy) != export_cache.PACKAGE_DIGEST, path
            path.write_bytes(content)


def test_pretrained_weights_are_read_bit_for_bit():
    robot = assembly.load_robot()
    stored = load_file(paths.PRETRAINED_DIR / "controller.safetensors")
    learned = robot.controller.policy.policies[1]
    np.testing.assert_array_equal(learned.input_mean, stored["input_mean"])
    kernel = learned.weights["cell"]["dense_i"]["kernel"]
    np.testing.assert_array_equal(kernel, stored["weights.cell.dense_i.kernel"])
    shaped = load_file(paths.PRETRAINED_DIR / "shaping.safetensors")
    total = sum(np.float64(array).sum() for array in shaped.values())
    read = sum(np.asarray(leaf, np.float64).sum() for leaf in jax.tree.leaves(robot.controller.shaping))
    np.testing.assert_allclose(read, total, rtol=1e-6)


@pytest.mark.usefixtures("float32")
def test_the_robot_of_a_run_folder_is_loaded():
    robot = assembly.load_robot(RUN / "fit-gait", RUN / "train")
    stored = load_file(RUN / "train" / "controller.safetensors")
    np.testing.assert_array_equal(robot.controller.policy.policies[1].output_scale, stored["output_scale"])
    assert not shaping.load(RUN / "fit-gait" / "shaping.safetensors").printed_input
    detector = assembly.load_detector(RUN / "collect")
    assert float(detector.threshold) == float(robot.controller.detector.threshold)
    assert assembly.fingerprint(robot) == "0e22c326052c2030"  # as version 0.2 computed it: walks name their robot by it


def test_stages_do_not_resume_in_a_run_folder_of_version_0_1_0(tmp_path):
    shutil.copy(RUN / "run.json", tmp_path)
    with pytest.raises(
        InputError, match=r"format 1, made by an older lgmdjax; .*--run; choose another --name"
    ) as caught:
        run_folders.open_run(tmp_path.parent, tmp_path.name, "smoke", 0, {})
    assert "\n" not in str(caught.value)


def test_the_walks_of_an_episode_are_read():
    walks = episodes.read(RUN / "collect" / "episodes")
    table = pq.read_table(RUN / "collect" / "episodes" / "chunk-00000.parquet")
    assert [len(walk) for walk in walks] == [60, 60]
    for robot, walk in enumerate(walks):
        rows = table.filter(np.equal(table["robot"].to_numpy(), robot))
        np.testing.assert_array_equal(walk.position[:, 0], rows["x"].to_numpy())
        np.testing.assert_array_equal(walk.joints[:, 5, 2], rows["joint_17"].to_numpy())
        np.testing.assert_array_equal(walk.is_first, rows["fresh"].to_numpy())
        np.testing.assert_array_equal(walk.resets, rows["setbacks"].to_numpy())


@pytest.mark.usefixtures("float32")
def test_a_fit_resumes_from_a_checkpoint(tmp_path, monkeypatch):
    """The fit in the checkpoint is complete, so that its parameters are the result."""
    monkeypatch.setattr(behaviour_cloning, "_train_epochs", lambda *_: pytest.fail("the checkpoint was not read"))
    shutil.copytree(OLD / "checkpoints", tmp_path / "checkpoints")
    first, second = episodes.read(RUN / "collect" / "episodes")
    untrained = navigator.create(jax.random.key(0), units=4)
    settings = behaviour_cloning.Settings(epochs=4, window=20, streams=2)
    fit = behaviour_cloning.fit(
        untrained, [first], [second], settings, checkpoints=tmp_path / "checkpoints", show_progress=False
    )
    fitted, _ = navigator.load(OLD / "fitted.safetensors")
    jax.tree.map(np.testing.assert_array_equal, fit.params, fitted)
