"""The stereo fisheye camera by OpenGL: faces of a cube around each eye, averaged over the area of the fisheye's pixels.

OpenGL renders pinhole pictures. Five faces of a cube, 90 degrees each, cover all directions except behind. A pixel of
the fisheye is the mean over `RAYS` x `RAYS` rays within its area, each of which reads the pixel of the face that it
hits. This is one sparse matrix, which is computed once. Faces that no pixel of the eye's hemifield meets are not
rendered: two of five if the detectors see only what is above the horizon.

| symbol | name                                  | unit | where                             |
| ------ | ------------------------------------- | ---- | --------------------------------- |
| u, v   | column and row from the middle        | px   | `sensors.camera`                  |
| d      | direction, x forward, y left, z up    | 1    | `camera.equidistant_directions`   |
| a, b   | position on a face, right and down    | 1    | in -1..1: d . right / d . axis    |

`mujoco.Renderer` chooses OpenGL by the variable MUJOCO_GL (egl, osmesa, glfw), which must be set before MuJoCo is
imported (`runtime.jax_setup.prepare_opengl`).
"""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from scipy import sparse

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.sensors import camera, camera_faults, hemifield

FACE = 96  # px; on this face a pixel of the 80 px fisheye averages five pixels, and a cell of its detector 46
RAYS = 8  # along each side of a pixel
SEEN = (0, 4)  # groups of geoms that the cameras see: the room, not the robot


class Face(NamedTuple):
    """Axes of a face in the eye's frame."""

    axis: tuple[float, float, float]
    right: tuple[float, float, float]

    def up(self) -> np.ndarray:
        """Return the upward axis of the picture."""
        return np.cross(self.right, self.axis)


FACES = {
    "front": Face((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    "left": Face((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    "right": Face((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)),
    "up": Face((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "down": Face((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
}


def add_cameras(spec: mujoco.MjSpec, face: int = FACE) -> None:
    """Add one camera for each face of each eye to the robot's trunk: eye_left_front and so on."""
    for eye in hexapod.EYES:
        site = spec.site(eye)
        for name, (axis, right) in FACES.items():
            axes = np.column_stack([right, np.cross(right, axis), -np.asarray(axis)])
            quaternion = np.empty(4)
            mujoco.mju_mat2Quat(quaternion, axes.ravel())
            site.parent.add_camera(name=f"{eye}_{name}", pos=site.pos, quat=quaternion, fovy=90.0)
    spec.visual.global_.offwidth = spec.visual.global_.offheight = face


class CubeCamera:
    """Renders the stereo pictures of one robot; a context manager that frees OpenGL's memory.

    Args:
        model: from `robot_model.build`, with the same `face`.
        params: parameters of the fisheye camera.
        lens: distortion and turn of the eyes (`camera_faults.LensError`).
        whole: render the whole picture, not only the detectors' hemifields.
        face: width of a face [px].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        params: camera.Params,
        *,
        lens: camera_faults.LensError | None = None,
        whole: bool = False,
        face: int = FACE,
    ):
        self.face, self.shape = face, (2, params.height, params.width)
        self.option = mujoco.MjvOption()
        self.option.geomgroup[:] = [group in SEEN for group in range(len(self.option.geomgroup))]
        self.option.sitegroup[:] = 0
        self.weights = [resampling(params, side, lens=lens, whole=whole, face=face) for side in (0, 1)]
        try:
            self.renderer = mujoco.Renderer(model, face, face)
        except Exception as error:  # each back end of OpenGL has its own exceptions
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(
                f"expected OpenGL without a window, got none ({reason}); install libegl1 or libosmesa6, and set "
                "MUJOCO_GL to egl or osmesa before Python starts"
            ) from None

    def __enter__(self) -> "CubeCamera":
        return self

    def __exit__(self, *_: object) -> None:
        self.renderer.close()

    def render(self, data: mujoco.MjData) -> Float[np.ndarray, "2 height width"]:
        """Return the pictures of both eyes, in grey levels 0..255; what no detector sees is 0."""
        return np.stack([self._render_eye(data, side) for side in (0, 1)]).reshape(self.shape)

    def _render_eye(self, data: mujoco.MjData, side: int) -> np.ndarray:
        faces = self.weights[side]
        return sum(
            (matrix @ self.draw_face(data, hexapod.EYES[side], name).ravel() for name, matrix in faces.items()),
            start=np.zeros(self.shape[1] * self.shape[2], np.float32),
        )

    def draw_face(self, data: mujoco.MjData, eye: str, name: str) -> UInt8[np.ndarray, "face face"]:
        """Return the pinhole picture of one face; surfaces are grey, so one channel is enough."""
        self.renderer.update_scene(data, f"{eye}_{name}", self.option)
        return self.renderer.render()[..., 1]


def resampling(
    params: camera.Params,
    side: int,
    *,
    lens: camera_faults.LensError | None = None,
    whole: bool = False,
    face: int = FACE,
) -> dict[str, sparse.csr_matrix]:
    """Return, for each face that the eye sees, the matrix (pixels of the eye, pixels of the face) that averages it.

    Rows of all matrices together add up to one, or to zero for pixels that no detector sees.
    """
    height, width = params.height, params.width
    ticks = (np.arange(RAYS) + 0.5) / RAYS
    v, u = np.meshgrid(_within(height, ticks), _within(width, ticks), indexing="ij")
    pixel = np.arange(height * width).reshape(height, width).repeat(RAYS, axis=0).repeat(RAYS, axis=1)
    if not whole:
        seen = hemifield.crop(pixel, side, overlap=params.overlap, ground=params.ground)
        seen = np.isin(pixel, seen)
        u, v, pixel = u[seen], v[seen], pixel[seen]
    focal = width / params.fov
    if lens is not None:
        u, v = camera_faults.distort(u, v, 0.5 * width, float(lens.distortion))
    directions = camera.equidistant_directions(u.ravel(), v.ravel(), focal)[0]
    if lens is not None:
        directions = camera_faults.turn_matrix(np.asarray(lens.turn)[side]) @ directions
    return _matrices(directions, pixel.ravel(), height * width, face)


def _within(count: int, ticks: np.ndarray) -> np.ndarray:
    """Return the positions of all rays along one side of the picture, from its middle [px]."""
    return (np.arange(count)[:, None] + ticks).ravel() - 0.5 * count


def _matrices(directions: np.ndarray, pixel: np.ndarray, pixels: int, face: int) -> dict[str, sparse.csr_matrix]:
    along = np.stack([np.asarray(each.axis) @ directions for each in FACES.values()])
    nearest, weight = along.argmax(axis=0), np.float32(1 / RAYS**2)
    matrices: dict[str, sparse.csr_matrix] = {}
    for index, (name, each) in enumerate(FACES.items()):
        mine = nearest == index
        if not mine.any():
            continue
        d, depth = directions[:, mine], along[index, mine]
        column, row = (_to_pixel(side @ d / depth, face) for side in (np.asarray(each.right), -each.up()))
        entries = np.full(mine.sum(), weight)
        shape = (pixels, face * face)
        matrices[name] = sparse.csr_matrix((entries, (pixel[mine], row * face + column)), shape)
    return matrices


def _to_pixel(place: np.ndarray, face: int) -> np.ndarray:
    return np.clip(np.floor(0.5 * (place + 1) * face).astype(int), 0, face - 1)
