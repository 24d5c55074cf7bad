"""Calibrated lenses: OpenCV's fisheye and pinhole models, and their file format.

| symbol | name                                            | unit | shape            |
| ------ | ----------------------------------------------- | ---- | ---------------- |
| K      | focal lengths and principal point, as a matrix  | px   | (3, 3)           |
| D      | distortion: k1..k4, or k1 k2 p1 p2 [k3 [k4 k5 k6]] | 1 | (4,), or (4, 5, 8) |
| theta  | angle of a ray from the optical axis            | rad  | -                |
| r      | distance from the axis in the plane at distance 1 | 1  | -                |

Fisheye: theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8). Pinhole: r (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 +
...), and the tangential terms p1, p2. Beyond the angle at which such a polynomial starts to fall, it does not describe
the lens, and rays count as not seen.

A file is JSON, or YAML in OpenCV's form, with `model` ("fisheye" or "pinhole"), `size` [width, height], `K` and `D`.
The longer names of OpenCV's tools and of ROS (`camera_matrix`, `distortion_coefficients`, `image_width`) are read too.

Source: OpenCV's documentation of `calib3d` and of `fisheye`.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import partial_files, schema, storage

if HAS_OPENCV := find_spec("cv2") is not None:
    import cv2

Model = Literal["fisheye", "pinhole"]
COEFFICIENTS: Mapping[Model, tuple[int, ...]] = {"fisheye": (4,), "pinhole": (4, 5, 8)}
NAMES = {
    "K": ("camera_matrix", "Camera_Matrix"),
    "D": ("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs"),
}
WIDTHS, HEIGHTS = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
MODELS = {"equidistant": "fisheye", "plumb_bob": "pinhole", "rational_polynomial": "pinhole"}  # of ROS
SIDE = schema.Number(1, 16384)  # px; YAML has floats
MAX_NUMBER = 1e6  # in K and D: far beyond those of any lens
REMEDY = "make one with `lgmdjax calibrate-camera`"


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A calibrated camera."""

    model: Model
    size: tuple[int, int]  # px, width and height of the pictures
    K: Float[np.ndarray, "3 3"]
    D: Float[np.ndarray, "n"]


def project(
    lens: Lens, directions: Float[np.ndarray, "3 *n"]
) -> tuple[Float[np.ndarray, "2 *n"], Bool[np.ndarray, "*n"]]:
    """Return the image points of rays, column and row [px] from the centre of the first pixel, and which it sees.

    Args:
        lens: the camera's lens.
        directions: directions of the rays, x to the right, y down, z ahead.
    """
    x, y, z = directions
    across = np.hypot(x, y)
    theta = np.arctan2(across, z)
    if lens.model == "fisheye":
        a, seen = _fisheye(lens.D, x, y, theta, across)
    else:
        a, seen = _pinhole(lens.D, x, y, z, theta)
    column = lens.K[0, 0] * a[0] + lens.K[0, 1] * a[1] + lens.K[0, 2]
    row = lens.K[1, 1] * a[1] + lens.K[1, 2]
    return np.stack([column, row]), seen


def _fisheye(
    D: np.ndarray, x: np.ndarray, y: np.ndarray, theta: np.ndarray, across: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    bent = theta * (1 + sum(k * theta ** (2 * n + 2) for n, k in enumerate(D)))
    scale = bent / np.maximum(across, 1e-12)
    grid = np.linspace(0, np.pi, 2000)
    slope = 1 + np.sum([(2 * n + 3) * k * grid ** (2 * n + 2) for n, k in enumerate(D)], axis=0)
    return np.stack([scale * x, scale * y]), theta < _first_fall(grid, slope)


def _pinhole(
    D: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*D, *np.zeros(8 - len(D)))

    def stretch(square: np.ndarray) -> np.ndarray:
        numerator = 1 + square * (k1 + square * (k2 + square * k3))
        return numerator / (1 + square * (k4 + square * (k5 + square * k6)))

    ahead = z > 1e-6
    a, b = x / np.where(ahead, z, 1.0), y / np.where(ahead, z, 1.0)
    square = a * a + b * b
    scale = stretch(square)
    bent = np.stack(
        [
            scale * a + 2 * p1 * a * b + p2 * (square + 2 * a * a),
            scale * b + p1 * (square + 2 * b * b) + 2 * p2 * a * b,
        ]
    )
    grid = np.linspace(0, 0.5 * np.pi, 2000, endpoint=False)
    radius = np.tan(grid)
    return bent, ahead & (theta < _first_fall(grid, np.gradient(radius * stretch(radius**2), grid)))


def _first_fall(grid: np.ndarray, slope: np.ndarray) -> float:
    """Return the first angle at which a slope is not positive; the last angle if it always is."""
    falls = np.flatnonzero(slope <= 0)
    return float(grid[falls[0]]) if len(falls) else float(grid[-1])


def to_json(lens: Lens) -> storage.JsonObject:
    """Return the content of a lens's file."""
    return {"model": lens.model, "size": list(lens.size), "K": lens.K.tolist(), "D": lens.D.tolist()}


def write(path: Path, lens: Lens) -> None:
    """Write a lens as JSON, or as OpenCV's YAML if the name ends in .yaml or .yml."""
    if path.suffix not in (".yaml", ".yml"):
        storage.write_json(path, to_json(lens))
        return
    with partial_files.replacing(path) as partial:
        file = cv2.FileStorage("memory.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        file.write("model", lens.model)
        file.write("image_width", lens.size[0])
        file.write("image_height", lens.size[1])
        file.write("K", lens.K)
        file.write("D", lens.D[None])
        partial.write_text(file.releaseAndGetString(), encoding="utf-8")


def read(path: Path) -> Lens:
    """Return the lens in a file; raise `InputError` if it is missing or is not a calibration."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"expected a calibration, found no file at {path}; {REMEDY}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"expected a calibration as text, got {path}: {one_line(error)}; {REMEDY}") from error
    content = _parse(path, text)
    found = {name: _find(content, name, *others) for name, others in NAMES.items()}
    model, size = _model(content, path), _size(content, path)
    arrays = {name: _array(value) for name, value in found.items()}
    matrix, distortion = arrays["K"], arrays["D"]
    if matrix is None or matrix.size != 9:
        raise InputError(f"{path}: expected K, nine numbers, got {one_line(found['K'])[:80]}; {REMEDY}")
    if distortion is None or distortion.size not in COEFFICIENTS[model]:
        numbers = " or ".join(map(str, COEFFICIENTS[model]))
        raise InputError(
            f"{path}: expected D, {numbers} numbers for {model}, got {one_line(found['D'])[:80]}; {REMEDY}"
        )
    K = matrix.reshape(3, 3)
    has_form = K[1, 0] == 0 and np.array_equal(K[2], [0, 0, 1])
    if not (has_form and K[0, 0] > 0 and K[1, 1] > 0 and 0 < K[0, 2] < size[0] and 0 < K[1, 2] < size[1]):
        raise InputError(
            f"{path}: expected K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with focal lengths above 0 and its centre in "
            f"the picture, got {one_line(found['K'])[:80]}; {REMEDY}"
        )
    return Lens(model=model, size=size, K=K, D=distortion.reshape(-1))


def _parse(path: Path, text: str) -> Mapping[str, object]:
    """Return the fields of a file in JSON or in OpenCV's YAML."""
    try:
        content = json.loads(text)
    except RecursionError as error:
        raise InputError(
            f"{path}: expected an object with model, size, K and D, got JSON too deep; {REMEDY}"
        ) from error
    except ValueError:
        content = _parse_yaml(path, text)
    if not isinstance(content, Mapping):
        raise InputError(
            f"{path}: expected an object with model, size, K and D, got {one_line(content)[:80]}; {REMEDY}"
        )
    return content


def _parse_yaml(path: Path, text: str) -> Mapping[str, object]:
    if not HAS_OPENCV:
        raise InputError(f"{path}: expected JSON, or YAML and OpenCV to read it; pip install 'lgmdjax[drive]'")
    header = "" if text.startswith("%YAML") else "%YAML:1.0\n---\n"
    try:
        file = cv2.FileStorage(header + text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = file.root()
        return {name: _from_node(root.getNode(name)) for name in root.keys()}  # noqa: SIM118 (not a mapping)
    except Exception as error:  # OpenCV's own, SystemError, and those of text that is not UTF-8
        raise InputError(f"{path}: expected JSON or YAML, got {one_line(error)[:120]}; {REMEDY}") from error


def _from_node(node: "cv2.FileNode") -> object:
    """Return the value of a node in an OpenCV file; for a matrix, the list of its numbers."""
    if node.isMap():
        names = node.keys()
        if "data" in names:
            return [node.getNode("data").at(k).real() for k in range(node.getNode("data").size())]
        return {name: _from_node(node.getNode(name)) for name in names}
    if node.isSeq():
        return [_from_node(node.at(k)) for k in range(node.size())]
    return node.string() if node.isString() else node.real()


def _find(content: Mapping[str, object], *names: str) -> object:
    return next((content[name] for name in names if name in content), None)


def _array(value: object) -> Float[np.ndarray, "..."] | None:
    """Return the numbers of a field, which may be a matrix as in OpenCV's JSON or in ROS; None if it has none."""
    numbers = value.get("data") if isinstance(value, Mapping) else value
    try:
        array = np.asarray(numbers, float)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.ndim and np.all(np.abs(array) <= MAX_NUMBER) else None


def _model(content: Mapping[str, object], path: Path) -> Model:
    named = _find(content, "model", "distortion_model", "camera_model")
    name = MODELS.get(str(named), str(named))
    for model in get_args(Model):
        if name == model:
            return model
    raise InputError(f"{path}: expected model fisheye or pinhole, got {one_line(named)[:40]}; {REMEDY}")


def _size(content: Mapping[str, object], path: Path) -> tuple[int, int]:
    both = _find(content, "size", "image_size", "img_shape")
    sides: list[Any] = both if isinstance(both, list) else [_find(content, *WIDTHS), _find(content, *HEIGHTS)]
    if len(sides) != 2 or not all(SIDE.accepts(side) and side == int(side) for side in sides):
        raise InputError(f"{path}: expected size, width and height in px, got {one_line(sides)[:80]}; {REMEDY}")
    width, height = map(int, sides)
    return width, height
