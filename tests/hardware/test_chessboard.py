"""Calibration from pictures of a chessboard that are rendered with a known lens."""

import re
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lgmdjax.cli import main
from lgmdjax.errors import InputError
from lgmdjax.hardware import chessboard, lens
from lgmdjax.hardware.chessboard import Board
from lgmdjax.hardware.lens import Lens

BOARD = Board(columns=7, rows=5, square=30.0)
SIZE = (640, 480)
LENSES = {
    "fisheye": Lens(
        model="fisheye",
        size=SIZE,
        K=np.array([[224.0, 0, 323.0], [0, 224.0, 237.0], [0, 0, 1]]),
        D=np.array([0.03, -0.01, 0.002, 0.0]),
    ),
    "pinhole": Lens(
        model="pinhole",
        size=SIZE,
        K=np.array([[480.0, 0, 316.0], [0, 480.0, 243.0], [0, 0, 1]]),
        D=np.array([-0.2, 0.05, 0.0, 0.0, 0.0]),
    ),
}
VIEWS = [  # across, down, turn
    *((-1, -1, 0.3), (1, -1, -0.4), (0, 0, 0.0), (-1, 1, 0.5)),
    *((1, 1, -0.2), (0, 0.5, 0.7), (0.5, 0, 0.2), (-0.5, 0.5, -0.6)),
]


@cache
def viewing_rays(model: str) -> np.ndarray:
    """Return the directions of 2 x 2 points in each pixel, (3, n), in order of rows."""
    calibrated = LENSES[model]
    rows, columns = (np.mgrid[: 2 * SIZE[1], : 2 * SIZE[0]] + 0.5) / 2 - 0.5
    points = np.stack([columns.ravel(), rows.ravel()], axis=1)[:, None]
    undistort = cv2.fisheye.undistortPoints if model == "fisheye" else cv2.undistortPoints
    plane = undistort(points, calibrated.K, calibrated.D)[:, 0].T
    return np.concatenate([plane, np.ones((1, plane.shape[1]))])


@cache
def photograph(model: str, view: tuple[float, float, float]) -> np.ndarray:
    """Return a picture of the board."""
    across, down, turn = view
    wide, high, distance = (55.0, 40.0, 160.0) if model == "fisheye" else (95.0, 65.0, 330.0)
    rotation, _ = cv2.Rodrigues(np.array([0.5 * down + 0.2, -0.5 * across + 0.15, turn]))
    middle = np.array([across * wide, down * high, distance])
    corner = middle - rotation @ np.array([(BOARD.columns - 1) / 2, (BOARD.rows - 1) / 2, 0]) * BOARD.square
    rays, normal = viewing_rays(model), rotation[:, 2]
    hits = rays * ((normal @ corner) / (normal @ rays))
    x, y, _ = rotation.T @ (hits - corner[:, None]) / BOARD.square
    inside = (x > -1) & (x < BOARD.columns) & (y > -1) & (y < BOARD.rows)
    margin = (x > -1.6) & (x < BOARD.columns + 0.6) & (y > -1.6) & (y < BOARD.rows + 0.6)
    black = (np.floor(x) + np.floor(y)) % 2 == 0
    grey = np.where(inside & black, 25.0, np.where(margin, 230.0, 120.0))
    return grey.reshape(SIZE[1], 2, SIZE[0], 2).mean(axis=(1, 3)).round().astype(np.uint8)


def save_pictures(folder: Path, model: str) -> Path:
    folder.mkdir()
    for number, view in enumerate(VIEWS):
        Image.fromarray(photograph(model, view)).save(folder / f"{number}.png")
    Image.fromarray(np.full(SIZE[::-1], 128, np.uint8)).save(folder / "wall.png")
    return folder


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_the_lens_that_took_the_pictures_is_found(
    tmp_path: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = save_pictures(tmp_path / model, model)
    out = tmp_path / "camera.yaml"
    flags = ["--board", "7x5", "--square", "30", "--model", model, "--out", str(out)]
    assert main.main(["calibrate-camera", str(folder), *flags]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"[5-8] pictures used, [1-4] without the whole board", printed) and str(out) in printed
    found, true = lens.read(out), LENSES[model]
    assert found.model == model and found.size == SIZE
    np.testing.assert_allclose(found.K, true.K, atol=5.0)
    angles = np.linspace(0, 0.8 if model == "fisheye" else 0.4, 30)
    rays = np.stack([np.sin(angles), 0.3 * np.sin(angles), np.cos(angles)])
    np.testing.assert_allclose(lens.project(found, rays)[0], lens.project(true, rays)[0], atol=1.0)
    with Image.open(out.with_suffix(".png")) as figure:
        assert figure.size[0] > 400


def test_what_is_left_of_straight_lines_tells_a_good_lens_from_a_bad_one(tmp_path: Path) -> None:
    folder = save_pictures(tmp_path / "pictures", "fisheye")
    found = chessboard.calibrate(folder, BOARD, "fisheye")
    left = np.sqrt(np.mean(chessboard.row_deviations(found) ** 2))
    flat = Lens(model="pinhole", size=SIZE, K=found.lens.K, D=np.zeros(4))
    bent = chessboard.Calibration(lens=flat, error=0.0, corners=found.corners, used=found.used, unused=())
    assert np.rad2deg(left) < 0.1
    assert np.sqrt(np.mean(chessboard.row_deviations(bent) ** 2)) > 5 * left


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--board", "7"], "--board as 9x6"),
        (["--board", "6x6"], "unequal sides"),
        (["--square", "-1"], "--square above 0"),
        (["--out", "camera.txt"], "ends in .json"),
        ([], "got none in"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path, flags: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main.main(["calibrate-camera", str(tmp_path), *flags]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and words in lines[0]
    assert not any(tmp_path.iterdir())


def test_pictures_of_several_sizes_or_without_a_board_are_refused(tmp_path: Path) -> None:
    for number, size in enumerate((64, 64, 64, 64, 64)):
        Image.fromarray(np.full((48, size), 128, np.uint8)).save(tmp_path / f"{number}.png")
    with pytest.raises(InputError, match="got 0 of 5"):
        chessboard.calibrate(tmp_path, BOARD, "pinhole")
    Image.fromarray(np.zeros((10, 10), np.uint8)).save(tmp_path / "small.png")
    with pytest.raises(InputError, match="of one size"):
        chessboard.calibrate(tmp_path, BOARD, "pinhole")
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(InputError, match="expected a picture"):
        chessboard.calibrate(tmp_path, BOARD, "pinhole")
