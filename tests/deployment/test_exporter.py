"""The exported folder: its card, all or nothing, and what is refused in one line."""

import hashlib
import os
import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from lgmdjax.control import navigator
from lgmdjax.deployment import c_source, exporter, nervous_system, onnx_graph, stablehlo
from lgmdjax.detectors import emd
from lgmdjax.errors import InputError
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.runtime import storage
from lgmdjax.simulation import assembly


def make_run(folder: Path, *files: str) -> Path:
    """A run folder with some files of the pretrained robot."""
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes((PRETRAINED_DIR / Path(file).name).read_bytes())
    return folder


WHOLE = ("fit-gait/shaping.safetensors", "train/controller.safetensors", "train/baselines.npz")


def test_the_card_tells_what_to_connect_where(tmp_path):
    run, out = make_run(tmp_path / "quick-0", *WHOLE), tmp_path / "made" / "robot"
    (run / "evaluate").mkdir()
    evaluation = {"tube": {"learned": {"robots": 3}, "blind": {}}, "indoor": {"teacher": {}}}
    storage.write_json(run / "evaluate" / "evaluation.json", evaluation)
    card = exporter.export(run, out, width=160, formats=["c"])
    assert card == exporter.read_card(out)
    assert {path.name for path in out.iterdir()} == {"card.json", "nervous_system.c", "nervous_system.h"}
    for name, file in card["files"].items():
        content = (out / name).read_bytes()
        assert file == {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    assert card["eyes"]["width"] == 160 and card["eyes"]["columns_seen"] == 80 and card["eyes"]["rate"] == "30 Hz"
    constants = navigator.load(run / "train" / "controller.safetensors")[1]["lgmd"]
    assert {name: card["lgmd"][name] for name in constants} == pytest.approx(constants, rel=1e-6)
    assert (card["lgmd"]["rows"], card["lgmd"]["columns"]) == (10, 13)
    assert np.mean(card["lgmd"]["weights"]) == pytest.approx(1) and np.argmax(card["lgmd"]["weights"]) >= 9
    assert np.shape(card["servos"]["lowest"]) == (6, 3) and card["servos"]["rate"] == "180 Hz"
    np.testing.assert_allclose(np.rad2deg(card["servos"]["highest"][3]), [75, 100, 67], atol=1e-3)
    assert card["state"]["is_first"] == {"shape": [], "type": "bool", "first": True}
    assert card["state"]["lgmd_frame"] == {"shape": [2, 10, 13], "type": "float32", "first": 0.0}
    assert np.shape(card["state"]["cpg_adaptation"]["first"]) == (6, 2)
    assert card["outputs"]["targets"] == {"shape": [6, 6, 3], "type": "float32"}
    assert card["training"]["seed"] == 2026 and card["scores"] == {"tube": {"robots": 3}}
    assert card["robot"]["name"] == "quick-0" and len(card["robot"]["fingerprint"]) == 16
    left, right = card["eyes"]["positions"]
    assert left[1] == -right[1] > 0


@pytest.mark.parametrize("evaluation", [[1], {"tube": [1]}, {"tube": None}, "tube"])
def test_other_scores_are_one_line(tmp_path, evaluation):
    (tmp_path / "evaluate").mkdir()
    storage.write_json(tmp_path / "evaluate" / "evaluation.json", evaluation)
    with pytest.raises(InputError, match=r"expected an object, got .*; run `lgmdjax evaluate` again"):
        exporter._read_scores(tmp_path)


@pytest.mark.parametrize("name", ["für */ int x; /*", "a\nb\\", os.fsdecode(b"caf\xe9"), "??/" * 30])
def test_any_name_of_a_robot_can_stand_in_the_comment(name, float32):
    text = c_source.generate(nervous_system.from_robot(assembly.load_robot()), name)["nervous_system.h"]
    comment = text.partition("#ifndef")[0]
    assert comment.isascii() and comment.count("*/") == 1 and comment.rstrip().endswith("*/")


@pytest.mark.parametrize("content", ["file", "folder with a file"])
def test_nothing_of_the_users_is_replaced(tmp_path, content):
    out = tmp_path / "robot"
    if content == "file":
        out.write_text("mine")
    else:
        out.mkdir()
        (out / "mine").touch()
    with pytest.raises(InputError, match=r"expected an empty or a new folder, got .*robot, which .*; choose another"):
        exporter.export(None, out, formats=["c"])
    assert [path.name for path in tmp_path.rglob("*")] == (["robot"] if content == "file" else ["robot", "mine"])


def test_a_run_without_a_controller_is_refused(tmp_path):
    run = make_run(tmp_path / "run", WHOLE[0])
    with pytest.raises(InputError, match=r"expected a run with a controller, got .*run .*lgmdjax train"):
        exporter.export(run, tmp_path / "robot", formats=["c"])
    with pytest.raises(InputError, match=r"expected a run folder or the word pretrained, got .*missing"):
        exporter.export(tmp_path / "missing", tmp_path / "robot", formats=["c"])
    assert not (tmp_path / "robot").exists()


def test_a_missing_extra_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_graph, "HAS_JAX2ONNX", False)
    with pytest.raises(InputError, match=r"expected jax2onnx .*pip install 'lgmdjax\[onnx\]'.*--formats stablehlo c"):
        exporter.export(None, tmp_path / "robot")
    assert not any(tmp_path.iterdir())


def test_a_failure_leaves_nothing(tmp_path, monkeypatch):
    def fail(folder, params):
        raise OSError("disk full")

    monkeypatch.setattr(stablehlo, "write", fail)
    (tmp_path / "robot").mkdir()
    with pytest.raises(OSError, match="disk full"):
        exporter.export(None, tmp_path / "robot", formats=["c", "stablehlo"])
    assert [path.name for path in tmp_path.rglob("*")] == ["robot"]


def test_only_what_the_c_program_can_do_is_written(float32):
    robot = assembly.load_robot()
    params = nervous_system.from_robot(robot)
    controller = params.controller
    smooth = replace(params, controller=replace(controller, detector=replace(controller.detector, smooth=True)))
    with pytest.raises(InputError, match="expected an LGMD with hard thresholds"):
        c_source.generate(smooth, "a robot")
    other = navigator.create(jax.random.key(0), "feed-forward")
    with pytest.raises(InputError, match=r"expected an LSTM .*got feed-forward"):
        c_source.generate(replace(params, controller=replace(controller, policy=other)), "a robot")
    with pytest.raises(InputError, match="expected a robot that sees in every frame"):
        nervous_system.from_robot(replace(robot, frame_stride=jax.numpy.asarray(2)))
    with pytest.raises(
        InputError, match=r"expected a robot with the detector lgmd for the export .*, got one with emd"
    ):
        nervous_system.from_robot(assembly.with_detector(robot, emd))


def test_numbers_in_c_are_those_of_single_precision(float32):
    """Read back from the text, every table is what it was, to the last bit."""
    params = nervous_system.from_robot(assembly.load_robot())
    source = c_source.generate(params, "a robot")["nervous_system.c"]
    for constant in c_source.constants(params):
        text = constant.definition() if constant.is_table else constant.declaration()
        assert text in source
        numbers = re.findall(r"-?\d[\d.]*(?:e[+-]?\d+)?(?=f)", text.partition("=")[2].partition("/*")[0])
        values = np.asarray(constant.value, np.float32).ravel()
        np.testing.assert_array_equal(np.array(numbers, np.float32), values, err_msg=constant.name)
