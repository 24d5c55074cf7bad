"""Calibrate a lens with OpenCV from pictures of a chessboard, and measure how far its rows are from straight lines.

The rows of a board are straight. If the lens is known, the viewing directions of the corners in a row lie on a great
circle, however much the lens bends the row. The angle between a corner and the circle through its row is the remaining
error of the calibration. This measure uses the lens alone, and none of the board poses that the calibration estimates.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from PIL import Image

from lgmdjax.errors import InputError, one_line
from lgmdjax.hardware import lens
from lgmdjax.hardware.lens import Lens, Model
from lgmdjax.reporting.figures import style

if lens.HAS_OPENCV:
    import cv2

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm")
MIN_BOARDS = 5
MAX_ERROR = 2.0  # px, root mean square, above which a calibration is refused
MAGNIFICATION = 20  # of the distances from straight lines, in the figure


@dataclass(frozen=True, kw_only=True)
class Board:
    """A chessboard: numbers of inner corners along and across, and the side of a square."""

    columns: int
    rows: int
    square: float  # mm

    def points(self) -> Float[np.ndarray, "corners 3"]:
        """Return the corners on the board [mm], row by row."""
        y, x = np.mgrid[: self.rows, : self.columns] * self.square
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A lens, and the corners that it was made from."""

    lens: Lens
    error: float  # px, root mean square distance between corners and their projections
    corners: Float[np.ndarray, "pictures rows columns 2"]  # px
    used: tuple[str, ...]  # names of pictures with the board
    unused: tuple[str, ...]


def parse_board(text: str, square: float) -> Board:
    """Return the board that a text such as 9x6 describes; raise `InputError` for any other text."""
    words = text.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and 3 <= int(word) <= 50 for word in words):
        raise InputError(f"expected --board as 9x6, inner corners along and across, got {one_line(text)[:40]}")
    columns, rows = map(int, words)
    if columns == rows:
        raise InputError(
            f"expected a --board with unequal sides, since a square one looks the same when turned, got {text}"
        )
    if not 0 < square < 1e4:
        raise InputError(f"expected --square above 0 mm, got {square:g}; measure a square")
    return Board(columns=columns, rows=rows, square=square)


def calibrate(folder: Path, board: Board, model: Model) -> Calibration:
    """Calibrate a lens from the pictures in a folder.

    Raises InputError if too few pictures show the whole board, if their sizes differ, or if the fit is bad.
    """
    check_installed()
    pictures, size = _read_pictures(folder)
    found = {name: find_corners(picture, board) for name, picture in pictures.items()}
    used = {name: corners for name, corners in found.items() if corners is not None}
    if len(used) < MIN_BOARDS:
        raise InputError(
            f"expected {MIN_BOARDS} or more pictures of a whole board with {board.columns}x{board.rows} inner corners, "
            f"got {len(used)} of {len(pictures)} in {folder}; take more, or correct --board"
        )
    error, K, D = _fit(list(used.values()), board, model, size)
    if not error < MAX_ERROR:
        raise InputError(
            f"expected corners within {MAX_ERROR:g} px of a {model} lens, got {error:.2g} px; try the other --model, "
            "or leave out pictures that are blurred"
        )
    shape = (len(used), board.rows, board.columns, 2)
    return Calibration(
        lens=Lens(model=model, size=size, K=K, D=D),
        error=error,
        corners=np.stack(list(used.values())).reshape(shape),
        used=tuple(used),
        unused=tuple(name for name in found if name not in used),
    )


def _read_pictures(folder: Path) -> tuple[dict[str, UInt8[np.ndarray, "height width"]], tuple[int, int]]:
    """Return the pictures of a folder by name, and their width and height [px]."""
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise InputError(f"expected a folder with pictures of a chessboard, got none in {folder}; take ten or more")
    pictures = {path.name: read_grey(path) for path in paths}
    sizes = {(picture.shape[1], picture.shape[0]) for picture in pictures.values()}
    if len(sizes) > 1:
        raise InputError(
            f"expected pictures of one size, got {', '.join(f'{w} x {h}' for w, h in sorted(sizes))} in {folder}"
        )
    return pictures, sizes.pop()


def read_grey(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Return a picture in grey levels; raise `InputError` for a file that is not a picture."""
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("L"))
    except Exception as error:  # whatever a damaged file makes Pillow raise
        raise InputError(
            f"expected a picture, got {path} ({one_line(error)[:120]}); remove it from the folder"
        ) from error


def find_corners(picture: UInt8[np.ndarray, "height width"], board: Board) -> Float[np.ndarray, "corners 2"] | None:
    """Return the inner corners of the board [px], row by row, with subpixel accuracy; None if it is not all in view."""
    found, corners = cv2.findChessboardCornersSB(picture, (board.columns, board.rows), None, cv2.CALIB_CB_ACCURACY)
    return np.asarray(corners, float).reshape(-1, 2) if found else None


def _fit(
    corners: Sequence[Float[np.ndarray, "corners 2"]], board: Board, model: Model, size: tuple[int, int]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the error [px], K and D that OpenCV fits to the corners."""
    points = [board.points()[None].astype(np.float32)] * len(corners)  # OpenCV 5 expects rows of points
    seen = [each[None].astype(np.float32) for each in corners]
    try:
        if model == "fisheye":
            names = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 4, OpenCV 5
            flags = sum(getattr(names, name) for name in ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW"))
            points = [each.astype(np.float64) for each in points]
            seen = [each.astype(np.float64) for each in seen]
            error, K, D, _, _ = cv2.fisheye.calibrate(points, seen, size, np.eye(3), np.zeros((4, 1)), flags=flags)
        else:
            error, K, D, _, _ = cv2.calibrateCamera(points, seen, size, None, None)
    except cv2.error as fault:
        raise InputError(
            f"expected boards that a {model} lens fits, got {one_line(fault)[:120]}; "
            "photograph the board from more sides"
        ) from fault
    return float(error), np.asarray(K, float), np.asarray(D, float).reshape(-1)


def directions(calibrated: Lens, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return the viewing directions of points in the picture, of length 1; x to the right, y down, z ahead."""
    seen = points[:, None].astype(np.float64)
    if calibrated.model == "fisheye":
        plane = cv2.fisheye.undistortPoints(seen, calibrated.K, calibrated.D)
    else:
        plane = cv2.undistortPoints(seen, calibrated.K, calibrated.D)
    rays = np.concatenate([plane[:, 0], np.ones((len(points), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def row_deviations(calibration: Calibration) -> Float[np.ndarray, "pictures rows columns"]:
    """Return the angle between each corner and the straight line through its row [rad], positive on one side."""
    pictures, rows, columns, _ = calibration.corners.shape
    rays = directions(calibration.lens, calibration.corners.reshape(-1, 2)).reshape(pictures, rows, columns, 3)
    _, _, axes = np.linalg.svd(rays)
    normals = axes[..., 2, :]  # of the plane through the eye and the row
    return np.arcsin(np.clip(np.einsum("prcx,prx->prc", rays, normals), -1, 1))


@style.styled
def plot(calibration: Calibration) -> Figure:
    """Plot the rows of all boards as seen, and the magnified distance of each corner from its row's straight line."""
    left = row_deviations(calibration)
    figure = Figure(figsize=(style.WIDTH, 3.6))
    picture, histogram = figure.subplots(1, 2, width_ratios=(1.6, 1))
    width, height = calibration.lens.size
    focal = calibration.lens.K[0, 0]
    for corners, residuals in zip(
        calibration.corners.reshape(-1, left.shape[2], 2), left.reshape(-1, left.shape[2]), strict=True
    ):
        along = corners[-1] - corners[0]
        across = np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
        picture.plot(*corners.T, color=style.GREY, linewidth=0.5)
        picture.plot(
            *(corners + MAGNIFICATION * focal * residuals[:, None] * across).T, color=style.LEFT_COLOUR, linewidth=0.8
        )
    picture.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="column [px]", ylabel="row [px]")
    picture.set_title(f"rows as seen, and their remaining bend, {MAGNIFICATION} times")
    histogram.hist(np.rad2deg(left).ravel(), bins=40, color=style.LEFT_COLOUR)
    histogram.set(xlabel="angle from the straight line [deg]", ylabel="corners")
    histogram.set_title(f"{calibration.error:.2f} px root mean square")
    return figure


def check_installed() -> None:
    """Raise `InputError` if OpenCV is missing."""
    if not lens.HAS_OPENCV:
        raise InputError(
            "expected OpenCV to find a chessboard, got an environment without it; pip install 'lgmdjax[drive]'"
        )
