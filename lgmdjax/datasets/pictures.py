"""Both eyes' whole pictures of recorded walks, rendered again from the poses, in grey levels of 8 bits.

Recorded walks hold no pictures, but their header says which rooms and camera they were recorded with. The pictures are
checked: for the first `CHECKED_FRAMES` of each walk, the detector must give the recorded u.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from lgmdjax.body import robot_xml
from lgmdjax.body.robot_xml import Body
from lgmdjax.datasets import recorded_rooms
from lgmdjax.datasets.recorded import Recording
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.runtime import schema
from lgmdjax.sensors import hemifield
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, episodes, rerender
from lgmdjax.simulation.episodes import Walk
from lgmdjax.world.arena import Arena

CHECKED_FRAMES = 3 * rerender.FRAMES_PER_CALL  # this many are also rendered at once
SETTLING_FRAMES = 2  # not compared: u of a walk's first frames may depend on earlier ones
TOLERANCE = 0.02  # largest RMS difference of u, in standard deviations of the recorded u

Pictures = UInt8[np.ndarray, "frames 2 height width"]


@dataclass(frozen=True, kw_only=True)
class RecordedCamera:
    """The stereo camera of recorded walks, and the LGMD behind it."""

    settings: CameraSettings
    detector: lgmd.Params
    body: Body | None = None  # on which the camera is; the package's if None


def find_camera(recording: Recording) -> RecordedCamera:
    """Return the camera of a recording: that of its header, of the run that it is in, or of the pretrained robot."""
    parameters = recording.parameters
    if "eyes" in parameters and "lgmd" in parameters:
        schema.check(assembly.HEADER, parameters, f"{recording.folder}: header", "collect again")
        settings = assembly.read_camera_settings(parameters)
        detector = assembly.fit_detector(assembly.lgmd_params(parameters["lgmd"]), settings)
        return RecordedCamera(settings=settings, detector=detector, body=robot_xml.find_body(recording.folder))
    around = [folder for folder in recording.folder.resolve().parents if (folder / "train").is_dir()]
    runs = [folder for folder in around if (folder / "train" / "controller.safetensors").is_file()]
    robot = assembly.load_robot(runs[0] / "fit-gait", runs[0] / "train") if runs else assembly.load_robot()
    camera = assembly.camera_settings(robot)
    return RecordedCamera(settings=camera, detector=robot.controller.detector, body=robot.body)


def find_rooms(recording: Recording) -> list[Arena]:
    """Return the room of each walk, made again from seeds; raise `InputError` if the header does not say how."""
    walks = recording.walks
    try:
        return recorded_rooms.find_rooms(recording.parameters, walks, len(walks), recording.folder)
    except InputError as error:
        raise InputError(f"{error}: leave --video out") from error


def render(eyes: RecordedCamera, room: Arena, walk: Walk) -> Iterator[Pictures]:
    """Yield the pictures of a walk, some seconds at a time; raise `InputError` if they do not give the recorded u."""
    whole = replace(assembly.camera_params(eyes.settings, eyes.body), overlap=1.0, ground=0.0)
    rooms = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], room)
    for first in range(0, len(walk), CHECKED_FRAMES):
        part = walk[first : first + CHECKED_FRAMES]
        pictures = rerender.render_walks(whole, rooms, episodes.stack_walks([part]))[0]
        if first == 0:
            _check(eyes, part, pictures)
        yield np.rint(np.clip(pictures, 0, 255)).astype(np.uint8)


def _check(eyes: RecordedCamera, walk: Walk, pictures: Float[np.ndarray, "frames 2 height width"]) -> None:
    """Raise `InputError` unless the detector gives the recorded u; not checked if it is constant (no camera)."""
    if len(walk) <= SETTLING_FRAMES or np.ptp(walk.u) == 0:
        return
    field = {"overlap": eyes.settings.overlap, "ground": eyes.settings.ground}
    seen = np.stack([hemifield.crop(pictures[:, side], side, **field) for side in range(2)], axis=1)
    padding = [(0, CHECKED_FRAMES - len(walk)), *[(0, 0)] * 3]  # one program serves all lengths
    is_first = np.pad(walk.is_first | (np.arange(len(walk)) == 0), padding[0])
    u = np.asarray(respond(eyes.detector, jnp.asarray(np.pad(seen, padding)), jnp.asarray(is_first)))[: len(walk)]
    known = walk.ok & (np.arange(len(walk)) >= SETTLING_FRAMES)
    difference = np.sqrt(np.mean((u - walk.u)[known] ** 2)) / max(float(walk.u[known].std()), 1e-6)
    if not difference <= TOLERANCE:
        raise InputError(
            f"expected pictures that give the recorded u within {TOLERANCE} standard deviations, got {difference:.2g} "
            f"in robot {walk.robot}'s walk of episode {walk.episode}; use the version that recorded it, or leave "
            "--video out"
        )


@jax.jit
def respond(
    detector: lgmd.Params, pictures: Float[Array, "frames 2 rows columns"], is_first: Bool[Array, " frames"]
) -> Float[Array, "frames 2"]:
    """Return u of both eyes' LGMDs for pictures of their hemifields; each first frame restarts them."""

    def frame(state: lgmd.State, inputs: tuple[Array, Array]) -> tuple[lgmd.State, Array]:
        images = hemifield.outermost_first(inputs[0])
        state = jax.tree.map(partial(jnp.where, inputs[1]), jax.vmap(partial(lgmd.init, detector))(images), state)
        state, response = jax.vmap(partial(lgmd.step, detector))(state, images)
        return state, response.u

    start = jax.vmap(partial(lgmd.init, detector))(pictures[0])
    return jax.lax.scan(frame, start, (pictures, is_first))[1]
