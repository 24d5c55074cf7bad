"""Commands for cameras and servos: nothing of the user's is replaced, and what cannot work is refused at the start."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lgmdjax.cli import main, sim_robot
from lgmdjax.errors import InputError
from lgmdjax.hardware import joint_map


def refused(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("lgmdjax: expected ") and words in line, line


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("servos.toml", joint_map.to_toml(joint_map.default()).replace("zero = 512", "zero = 500", 1)),
        ("servos.toml", "\0"),
        ("trace.csv", "mine\n"),
        ("bus", "mine"),
        ("imu", "mine"),
    ],
)
def test_the_files_of_a_real_robot_are_not_replaced(
    name: str, content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(content)
    refused(["sim-robot", "--out", str(tmp_path), "--port", "0", "--seconds", "0.1"], "is another file", capsys)
    assert (tmp_path / name).read_text() == content and len(list(tmp_path.iterdir())) == 1


def test_the_files_of_an_earlier_simulation_are_its_own(tmp_path: Path) -> None:
    joint_map.write(tmp_path / "servos.toml", joint_map.default())
    (tmp_path / "trace.csv").write_text(sim_robot.TRACE_HEADER + "0.1,2\n")
    for name in sim_robot.LINKS:
        (tmp_path / name).symlink_to("/dev/pts/none")
    sim_robot._check_folder(tmp_path, joint_map.default())
    (tmp_path / "trace.csv").write_text("")  # it was killed
    sim_robot._check_folder(tmp_path, joint_map.default())
    (tmp_path / "servos.toml").unlink()
    (tmp_path / "servos.toml").symlink_to("trace.csv")
    with pytest.raises(InputError, match="is another file"):
        sim_robot._check_folder(tmp_path, joint_map.default())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sim-robot", "--seconds", "0"], "--seconds above 0"),
        (["sim-robot", "--seconds", "nan"], "--seconds above 0"),
        (["sim-robot", "--seed", "-1"], "a seed of 0 to 4294967295"),
        (["view", "--seed", "99999999999999999999"], "a seed of 0 to 4294967295"),
        (["bench", "stimuli", "--seed", "-1"], "a seed of 0 to 4294967295"),
        (["trial", "corner", "--seed", "4294967296"], "a seed of 0 to 4294967295"),
    ],
)
def test_numbers_that_make_no_sense_are_one_line(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(arguments, words, capsys)


@pytest.mark.skipif(os.name == "nt", reason="needs /dev")
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(tmp_path / "1.png")
    folder = str(tmp_path)
    refused(["servos", "map", "--servos", "none", "--out", "/dev/null/a.toml"], "a folder that can be written", capsys)
    refused(["calibrate-camera", folder, "--out", "/dev/null/a.json"], "a folder that can be written", capsys)
    refused(["calibrate-camera", folder, "--out", f"{folder}/1.json"], "--out outside of", capsys)
    monkeypatch.chdir(tmp_path)
    refused(["calibrate-camera", "."], "--out outside of", capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["1.png"]
