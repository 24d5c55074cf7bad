"""Lenses and resampling: as OpenCV projects, and as pictures averaged over an eye's pixels are."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.hardware import lens, resampling
from lgmdjax.hardware.lens import Lens
from lgmdjax.sensors import camera

FISHEYE = Lens(
    model="fisheye",
    size=(320, 240),
    K=np.array([[108.0, 0, 161.5], [0, 107.0, 118.5], [0, 0, 1]]),
    D=np.array([0.02, -0.01, 0.003, -0.0005]),
)
PINHOLE = Lens(
    model="pinhole",
    size=(320, 240),
    K=np.array([[150.0, 0, 158.0], [0, 151.0, 121.0], [0, 0, 1]]),
    D=np.array([-0.25, 0.08, 0.001, -0.002, -0.01]),
)
EYE = camera.Params(width=40, height=30)


def rays(angle: float) -> np.ndarray:
    """Random directions within an angle of the axis, (3, n)."""
    random = np.random.default_rng(0)
    theta, phi = angle * np.sqrt(random.random(500)), 2 * np.pi * random.random(500)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def test_lenses_project_as_opencv_does() -> None:
    zero = np.zeros(3)
    directions = rays(1.4)
    expected, _ = cv2.fisheye.projectPoints(directions.T[:, None], zero, zero, FISHEYE.K, FISHEYE.D)
    points, seen = lens.project(FISHEYE, directions)
    assert seen.all()
    np.testing.assert_allclose(points.T, expected[:, 0], atol=1e-9)
    directions = rays(0.7)
    for count in (4, 5, 8):
        D = np.concatenate([PINHOLE.D, [0.01, -0.02, 0.003]])[:count]
        expected, _ = cv2.projectPoints(directions.T[:, None].copy(), zero, zero, PINHOLE.K, D)
        points, seen = lens.project(Lens(model="pinhole", size=PINHOLE.size, K=PINHOLE.K, D=D), directions)
        assert seen.all()
        np.testing.assert_allclose(points.T, expected[:, 0], atol=1e-9)


def test_rays_where_the_polynomial_folds_back_or_behind_a_pinhole_are_not_seen() -> None:
    folding = Lens(model="fisheye", size=(320, 240), K=FISHEYE.K, D=np.array([-0.2, 0, 0, 0]))
    fold = np.sqrt(1 / 0.6)  # where 1 - 3 x 0.2 theta^2 = 0
    theta = np.array([0.9, 0.99, 1.01, 1.5]) * fold
    _, seen = lens.project(folding, np.stack([np.sin(theta), np.zeros(4), np.cos(theta)]))
    assert seen.tolist() == [True, True, False, False]
    _, seen = lens.project(PINHOLE, np.array([[0.0, 0.1], [0.0, 0.0], [1.0, -1.0]]))
    assert seen.tolist() == [True, False]


def scene(directions: np.ndarray) -> np.ndarray:
    """Grey levels of a world at infinity: stripes finer than an eye's pixel beside coarse ones."""
    x, y, z = directions
    azimuth, height = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    return 128 + 60 * np.sin(6 * azimuth + 4 * height) + 40 * np.sin(60 * azimuth)


def mean_over_eye_pixels(n: int = 24) -> np.ndarray:
    v, u = (np.mgrid[: n * EYE.height, : n * EYE.width] + 0.5) / n
    f = EYE.width / EYE.fov
    x, y = (u - EYE.width / 2) / f, (v - EYE.height / 2) / f
    theta = np.hypot(x, y)
    ratio = np.sin(theta) / theta
    grey = scene(np.stack([ratio * x, ratio * y, np.cos(theta)]))
    return grey.reshape(EYE.height, n, EYE.width, n).mean(axis=(1, 3))


@pytest.mark.parametrize("calibrated", [FISHEYE, PINHOLE], ids=["fisheye", "pinhole"])
def test_the_eye_gets_the_mean_over_its_pixels(calibrated: Lens) -> None:
    """OpenCV says what a camera with this lens pictures; the eye's pixels are integrated by hand."""
    scale = 4  # rendered finer, then averaged, as a sensor's pixels do
    width, height = calibrated.size
    rows, columns = (np.mgrid[: scale * height, : scale * width] + 0.5) / scale - 0.5
    points = np.stack([columns.ravel(), rows.ravel()], axis=1)[:, None]
    undistort = cv2.fisheye.undistortPoints if calibrated.model == "fisheye" else cv2.undistortPoints
    plane = undistort(points, calibrated.K, calibrated.D)[:, 0].T
    grey = scene(np.concatenate([plane, np.ones((1, plane.shape[1]))]))
    picture = grey.reshape(height, scale, width, scale).mean(axis=(1, 3)).round().astype(np.uint8)
    resampler = resampling.from_lens(calibrated, EYE)
    eye, expected = resampler(picture).astype(float), mean_over_eye_pixels()
    middle = (slice(9, 21), slice(12, 28))  # where both lenses see whole pixels
    assert np.abs(eye - expected)[middle].max() < 3 and np.std(expected[middle]) > 30
    assert (resampler.seen > 0.9) == (calibrated.model == "fisheye")
    if calibrated.model == "pinhole":
        assert 0.25 < resampler.seen < 0.9 and np.all(eye[:, 0] == resampling.GREY)


def test_a_camera_with_the_eyes_own_lens_is_averaged() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (90, 120), np.uint8)
    eye = resampling.from_same_lens((120, 90), EYE)(picture)
    expected = picture.reshape(30, 3, 40, 3).mean(axis=(1, 3))
    assert np.abs(eye - expected).max() <= 0.5
    same = picture[:30, :40]
    np.testing.assert_array_equal(resampling.from_same_lens((40, 30), EYE)(same), same)
    with pytest.raises(InputError, match="calibrate-camera"):
        resampling.from_same_lens((160, 90), EYE)
    with pytest.raises(InputError, match="use a wider lens"):
        K = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
        resampling.from_lens(Lens(model="pinhole", size=(320, 240), K=K, D=np.zeros(4)), EYE)


ROS = """image_width: 320
image_height: 240
distortion_model: equidistant
camera_matrix:
  rows: 3
  cols: 3
  data: [108.0, 0.0, 161.5, 0.0, 107.0, 118.5, 0.0, 0.0, 1.0]
distortion_coefficients:
  rows: 1
  cols: 4
  data: [0.02, -0.01, 0.003, -0.0005]
"""


@pytest.mark.parametrize("name", ["lens.json", "lens.yaml", "ros.yaml", "opencv.yml"])
def test_files_are_read_as_they_were_written(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "ros.yaml":
        path.write_text(ROS)
    elif name == "opencv.yml":
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for key, value in (("model", "fisheye"), ("image_width", 320), ("image_height", 240)):
            file.write(key, value)
        file.write("camera_matrix", FISHEYE.K)
        file.write("distortion_coefficients", FISHEYE.D)
        file.release()
    else:
        lens.write(path, FISHEYE)
    found = lens.read(path)
    assert (found.model, found.size) == (FISHEYE.model, FISHEYE.size)
    np.testing.assert_allclose(found.K, FISHEYE.K)
    np.testing.assert_allclose(found.D, FISHEYE.D)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "mirror"}, "fisheye or pinhole"),
        ({"size": [320]}, "width and height"),
        ({"K": [1, 2, 3]}, "nine numbers"),
        ({"K": [[0, 0, 160], [0, 0, 120], [0, 0, 1]]}, "focal lengths above 0"),
        ({"D": [0.1] * 5}, "4 numbers for fisheye"),
        ({"D": "none"}, "4 numbers"),
        ({"D": [0.1, 0, 0, 10**400]}, "4 numbers"),
        ({"size": [320, float("inf")]}, "width and height"),
        ({"size": [True, 240]}, "width and height"),
        ({"K": [[300, 0, 160], [5, 300, 120], [0, 0, 1]]}, "focal lengths above 0"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path: Path, change: dict[str, object], words: str) -> None:
    path = tmp_path / "lens.json"
    path.write_text(json.dumps(lens.to_json(FISHEYE) | change))
    with pytest.raises(InputError) as error:
        lens.read(path)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_missing_file_and_one_that_is_no_calibration_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found no file"):
        lens.read(tmp_path / "none.json")
    (tmp_path / "list.json").write_text("[1, 2]")
    with pytest.raises(InputError, match="an object with model"):
        lens.read(tmp_path / "list.json")
    for content in ("[" * 100_000, "K: [", "a\x02: \x1b[2J", "%YAML:1.0\n---\nK 3"):
        (tmp_path / "noise.yaml").write_text(content)
        with pytest.raises(InputError, match="expected") as error:
            lens.read(tmp_path / "noise.yaml")
        assert str(error.value).isprintable()
    (tmp_path / "noise.yaml").write_bytes(b"\x00\xff\xfe")
    with pytest.raises(InputError, match="as text"):
        lens.read(tmp_path / "noise.yaml")
