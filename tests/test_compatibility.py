"""What version 0.1.0 left on disk can still be read, and the cache of programs still knows every file of the package.

`data/v0.1.0` was written by that version: parts of a run folder at smoke scale (its episode cut to two walks of 60
frames), and a fit of a small navigator to them with its checkpoint. It cannot be made anew.
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
from lgmdjax.learning import behaviour_cloning
from lgmdjax.locomotion import shaping
from lgmdjax.runtime import export_cache
from lgmdjax.simulation import assembly, episodes

OLD = Path(__file__).parent / "data" / "v0.1.0"
RUN = OLD / "smoke-0"


def test_the_root_is_the_package():
    assert Path(lgmdjax.__file__).resolve().parent == paths.PACKAGE
    for name in ("lgmdjax", "shaping", "navigator"):
        module = sys.modules.get(f"lgmdjax.{name}", lgmdjax)
        assert Path(str(module.__file__)).resolve().is_relative_to(paths.PACKAGE)
    assert paths.SHAPING.is_file() and (paths.PRETRAINED / "controller.safetensors").is_file()


def test_kept_programs_are_known_by_every_file_of_the_package(tmp_path):
    """A change of any one file, in whatever folder, must make another sum than the one that is looked for."""
    copy = tmp_path / "lgmdjax"
    shutil.copytree(paths.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    assert export_cache._sum(copy) == export_cache.SOURCES
    for path in sorted(copy.rglob("*")):
        if path.is_file():
            content = path.read_bytes()
            path.write_bytes(content + b"\n")
            assert export_cache._sum(copy) != export_cache.SOURCES, path
            path.write_bytes(content)


def test_pretrained_weights_are_read_to_the_last_bit():
    robot = assembly.trained()
    stored = load_file(paths.PRETRAINED / "controller.safetensors")
    learned = robot.controller.driver.drivers[1]
    np.testing.assert_array_equal(learned.input_mean, stored["input_mean"])
    kernel = learned.weights["cell"]["dense_i"]["kernel"]
    np.testing.assert_array_equal(kernel, stored["weights.cell.dense_i.kernel"])
    shaped = load_file(paths.PRETRAINED / "shaping.safetensors")
    total = sum(np.float64(array).sum() for array in shaped.values())
    read = sum(np.asarray(leaf, np.float64).sum() for leaf in jax.tree.leaves(robot.controller.shaping))
    np.testing.assert_allclose(read, total, rtol=1e-6)


@pytest.mark.usefixtures("float32")
def test_a_run_folder_gives_its_robot():
    robot = assembly.trained(RUN / "fit-gait", RUN / "train")
    stored = load_file(RUN / "train" / "controller.safetensors")
    np.testing.assert_array_equal(robot.controller.driver.drivers[1].output_scale, stored["output_scale"])
    assert not shaping.load(RUN / "fit-gait" / "shaping.safetensors").literal
    detector = assembly.load_detector(RUN / "collect")
    assert float(detector.threshold) == float(robot.controller.lgmd.threshold)


def test_an_episode_gives_its_walks():
    walks = episodes.read(RUN / "collect" / "episodes")
    table = pq.read_table(RUN / "collect" / "episodes" / "chunk-00000.parquet")
    assert [len(walk) for walk in walks] == [60, 60]
    for robot, walk in enumerate(walks):
        rows = table.filter(np.equal(table["robot"].to_numpy(), robot))
        np.testing.assert_array_equal(walk.position[:, 0], rows["x"].to_numpy())
        np.testing.assert_array_equal(walk.joints[:, 5, 2], rows["joint_17"].to_numpy())
        np.testing.assert_array_equal(walk.fresh, rows["fresh"].to_numpy())
        np.testing.assert_array_equal(walk.setbacks, rows["setbacks"].to_numpy())


@pytest.mark.usefixtures("float32")
def test_a_checkpoint_is_carried_on_from(tmp_path, monkeypatch):
    """The fit is done, so nothing is left to learn: what comes out is what the checkpoint holds."""
    monkeypatch.setattr(behaviour_cloning, "_advance", lambda *_: pytest.fail("the checkpoint was not read"))
    shutil.copytree(OLD / "checkpoints", tmp_path / "checkpoints")
    first, second = episodes.read(RUN / "collect" / "episodes")
    untrained = navigator.create(jax.random.key(0), units=4)
    settings = behaviour_cloning.Settings(epochs=4, window=20, streams=2)
    fit = behaviour_cloning.fit(
        untrained, [first], [second], settings, checkpoints=tmp_path / "checkpoints", show=False
    )
    fitted, _ = navigator.load(OLD / "fitted.safetensors")
    jax.tree.map(np.testing.assert_array_equal, fit.params, fitted)
