"""Robots assembled from parameters, from the files of a run, or from those of the package."""

import re
from dataclasses import asdict, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from lgmdjax.body import robot_xml
from lgmdjax.control import braitenberg, compass, controller, navigator, policies
from lgmdjax.control.names import POLICY_NAMES, PolicyName
from lgmdjax.detectors import lgmd, protocol
from lgmdjax.detectors.protocol import Detector
from lgmdjax.errors import InputError
from lgmdjax.locomotion import cpg, shaping, tripod_gait
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.runtime import checksums, schema, static_arguments
from lgmdjax.runtime.storage import JsonObject, read_arrays, read_json
from lgmdjax.sensors import camera, hemifield, laser
from lgmdjax.sensors.settings import FIELD_LIMITS, CameraSettings, Resolution
from lgmdjax.simulation import closed_loop

REPLAY_LENGTH = 4096  # velocities of policy random; static, so that one compiled program serves all stages
LGMD = schema.Object(
    {
        "threshold": schema.Number(0, 255),  # grey
        "suppression": schema.Number(0, 2 * 255),  # grey; twice the largest FF, which never suppresses
        "inhibition": schema.Number(0, 100),
    }
)
SIDE = schema.Integer(1, camera.MAX_SIZE)  # px
FIELD = {name: schema.Number(*limits) for name, limits in FIELD_LIMITS.items()}
EYES = schema.Object({"width": SIDE, "height": SIDE}, {**FIELD, "pooling": SIDE})
HEADER = schema.Object({"eyes": EYES, "lgmd": LGMD})
"""Schema of the header of a controller, without the network's structure."""
BASELINES = schema.Object(
    {"gain": schema.Numbers((), -1e9, 1e9), "replayed": schema.Numbers((REPLAY_LENGTH, 2), -10, 10)}
)
"""Schema of baselines.npz: the gain of policy direct [1/m], and velocities [nominal] of policy random."""


NEWER_FIELDS = {
    r", mounts=None\)": ")",
    r"Params\[\(None,\)\]": "Params[()]",  # body
    r", None\)\], \[\]\)": ")], [])",  # mounts of the cameras
    r"Params\[\((\d+), None\)\]": r"Params[(\1,)]",  # mount of the laser
    r", None\]\)\)\)$": "])))",  # heading
}
"""Patterns of what the structure of a robot says of fields that version 0.2 lacked, and what stood there."""


def camera_params(settings: CameraSettings, body: robot_xml.Body | None = None) -> camera.Params:
    """Return the stereo camera of these settings on a body; on the package's if None."""
    of_detector = ("pooling", "falloff")
    of_camera = {name: value for name, value in asdict(settings).items() if name not in of_detector}
    return camera.Params(**of_camera, mounts=None if body is None else robot_xml.sensor_mounts(body).eyes)


def laser_params(body: robot_xml.Body | None) -> laser.Params:
    """Return the laser scanner of a body, whose corridor is as wide as its stance in proportion."""
    if body is None:
        return laser.Params()
    half_width = laser.Params().corridor_half_width * tripod_gait.read_gait(robot_xml.compiled(body)).width_ratio()
    return laser.Params(mount=robot_xml.sensor_mounts(body).laser, corridor_half_width=half_width)


def camera_settings(robot: closed_loop.Params) -> CameraSettings:
    """Return the camera settings of a robot, as `with_camera` sets them."""
    of_camera = {name: getattr(robot.camera, name) for name in ("width", "height", "overlap", "ground")}
    detector = robot.controller.detector
    of_detector = {name: getattr(detector, name) for name in ("pooling", "falloff") if hasattr(detector, name)}
    return CameraSettings(**of_camera, **of_detector)


def read_camera_settings(header: JsonObject, place: str = "header") -> CameraSettings:
    """Return the camera of a controller's training, or of recorded walks, from their header.

    Raises InputError for impossible ones, with `place` in the message.
    """
    eyes = header["eyes"]
    schema.check(EYES, eyes, f"{place}: eyes", "collect and train again")
    smallest = min(eyes["width"], eyes["height"])
    schema.check(schema.Integer(1, smallest), eyes.get("pooling", 1), f"{place}: pooling", "train again")
    return CameraSettings(**{name: eyes[name] for name in (*EYES.fields, *EYES.optional) if name in eyes})


def fit_detector(detector: PyTree, settings: CameraSettings) -> PyTree:
    """Return a detector with the size, the bearings and the weights of its cells set for a camera.

    Raises InputError for cells of several pixels, or weights, that the detector does not have.
    """
    wanted = {"pooling": settings.pooling, "falloff": settings.falloff}
    for name, value in wanted.items():
        if value != getattr(CameraSettings, name) and not hasattr(detector, name):
            raise InputError(
                f"expected a detector with the parameter {name} for a camera with {name} {value:g}, got one of "
                f"{type(detector).__module__}; lgmdjax.detectors.scaled gives any detector cells of several pixels"
            )
    wanted["edges"] = hemifield.edges(camera.Params().fov, settings.overlap)
    return replace(detector, **{name: value for name, value in wanted.items() if hasattr(detector, name)})


def load_robot(gait_folder: Path = PRETRAINED_DIR, train_folder: Path = PRETRAINED_DIR) -> closed_loop.Params:
    """Return the robot of a run, with all five policies and the camera of its training; by default the pretrained one.

    >>> robot = load_robot()
    >>> robot.camera.width, robot.camera.height
    (80, 60)

    Args:
        gait_folder: the folder of stage fit-gait.
        train_folder: the folder of stage train.

    Raises InputError if a folder lacks the files of its stage.
    """
    controller, baselines = train_folder / "controller.safetensors", train_folder / "baselines.npz"
    navigator_params, header = navigator.load(controller)
    schema.check(HEADER, header, f"{controller}: header", "train again")
    arrays = read_arrays(baselines)
    schema.check(BASELINES, arrays, str(baselines), "train again")
    switch = make_policies(navigator_params, float(arrays["gain"]), arrays["replayed"])
    settings = read_camera_settings(header, str(controller))
    return assemble_robot(gait_folder, settings, lgmd_params(header["lgmd"]), switch)


def assemble(
    policy_params: PyTree,
    *,
    detector_model: Detector = lgmd,
    detector_params: PyTree = None,
    cpg_params: cpg.Params | None = None,
    shaping_params: shaping.Params | None = None,
    teacher_params: braitenberg.Params | None = None,
    camera_params: camera.Params | None = None,
    laser_params: laser.Params | None = None,
) -> closed_loop.Params:
    """Assemble a robot from the parameters of its policy and of all components that are not the default.

    Plain numbers become arrays, so that one compiled program serves all values and can be differentiated with respect
    to them. The default shaping networks are those of the package (`shaping.load_pretrained`); those of a detector are
    its `Params()`.

    Raises InputError for invalid numbers (`check` of the components), unless some are traced, and for a detector that
    does not have its interface (`protocol.check`).
    """
    controller_params = controller.Params(
        detector=detector_model.Params() if detector_params is None else detector_params,
        policy=policy_params,
        cpg=cpg_params or cpg.Params(),
        shaping=shaping_params or shaping.load_pretrained(),
        detector_model=detector_model,
    )
    params = closed_loop.Params(
        controller=controller_params,
        teacher=teacher_params or braitenberg.Params(),
        camera=camera_params or camera.Params(),
        laser=laser_params or laser.Params(),
    )
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(params)):
        protocol.check(detector_model, controller_params.detector, closed_loop.frame_type(params.camera))
        cpg.check(controller_params.cpg)
        braitenberg.check(params.teacher)
        laser.check(params.laser)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if np.isscalar(leaf) else leaf, params)


def assemble_robot(
    gait_folder: Path,
    camera_settings: CameraSettings,
    lgmd_params: lgmd.Params,
    policy_params: policies.PolicySwitch,
) -> closed_loop.Params:
    """Return a robot with the body and the fitted gait of a run, and the given camera, detector and policies."""
    body = robot_xml.read_body(gait_folder)
    params = assemble(
        policy_params,
        detector_params=lgmd_params,
        shaping_params=shaping.load(gait_folder / "shaping.safetensors"),
        camera_params=camera_params(camera_settings, body),
        laser_params=laser_params(body),
    )
    return with_camera(replace(params, body=body), camera_settings)


def make_policies(
    navigator_params: navigator.Params | None = None,
    direct_gain: float = 0.0,
    replay_velocities: np.ndarray | None = None,
) -> policies.PolicySwitch:
    """Return all five policies, with the teacher active; arguments that are not given get placeholders.

    Args:
        navigator_params: the trained navigator; untrained if None.
        direct_gain: gain of policy direct [1/m].
        replay_velocities: `REPLAY_LENGTH` velocities of the teacher for policy random; constant if None.
    """
    teacher = braitenberg.Params()
    straight = jnp.full(2, teacher.base, dtype=float)
    if replay_velocities is None:
        velocities = jnp.broadcast_to(straight, (REPLAY_LENGTH, 2))
    else:
        velocities = jnp.asarray(replay_velocities, dtype=float)
    return policies.PolicySwitch(
        active=jnp.asarray(0),
        policies=(
            teacher,
            navigator.create(jax.random.key(0), symmetric=True) if navigator_params is None else navigator_params,
            policies.BlindParams(velocity=straight),
            policies.DirectParams(rule=teacher, gain=jnp.asarray(direct_gain, dtype=float)),
            policies.ReplayParams(velocities=velocities),
        ),
    )


def with_camera(params: closed_loop.Params, settings: CameraSettings) -> closed_loop.Params:
    """Return the robot with another camera.

    `settings.pooling` keeps the visual angle of a detector's cell, so that its responses change little.
    """
    detector = fit_detector(params.controller.detector, settings)
    eyes = camera_params(settings, params.body)
    return replace(params, camera=eyes, controller=replace(params.controller, detector=detector))


def with_detector(robot: closed_loop.Params, model: Detector, params: PyTree = None) -> closed_loop.Params:
    """Return the robot with another looming detector behind both cameras, whose policies are to be trained for it.

    >>> from lgmdjax.detectors import emd
    >>> with_detector(load_robot(), emd).controller.detector.gain.tolist()
    1000.0

    Args:
        robot: the robot.
        model: a module or a hashable object with the interface of `lgmdjax.detectors.protocol`.
        params: its parameters; `model.Params()` if None.

    Raises InputError for a detector without that interface, and for constants that it refuses.
    """
    given = model.Params() if params is None else params
    protocol.check(model, given, closed_loop.frame_type(robot.camera))
    arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if np.isscalar(leaf) else leaf, given)
    return replace(robot, controller=replace(robot.controller, detector=arrays, detector_model=model))


def with_resolution(robot: closed_loop.Params, resolution: Resolution) -> closed_loop.Params:
    """Return the robot with images and cells of another size; its detectors keep their field of view and weights."""
    sizes = {name: getattr(resolution, name) for name in ("width", "height", "pooling")}
    return with_camera(robot, replace(camera_settings(robot), **sizes))


def scale_resolution(robot: closed_loop.Params, width: int) -> Resolution:
    """Return the resolution with images of another width and cells of the same size in degrees.

    Raises InputError for a width at which the cells are not whole pixels.
    """
    camera, pooling = robot.camera, camera_settings(robot).pooling
    if width < 1 or (pooling * width) % camera.width or (camera.height * width) % camera.width:
        raise InputError(
            f"expected a --width whose cells are whole pixels ({pooling} at width {camera.width}), got {width}; "
            f"try {2 * camera.width}"
        )
    height, cell = camera.height * width // camera.width, pooling * width // camera.width
    return Resolution(width=width, height=height, pooling=cell)


def with_compass(params: closed_loop.Params, steering: compass.Params | None = None) -> closed_loop.Params:
    """Return the robot with a compass: it returns to the heading of its start, whatever its policy.

    Raises InputError for invalid numbers.
    """
    steering = steering or compass.Params()
    compass.check(steering)
    return replace(params, heading=jax.tree.map(lambda value: jnp.asarray(value, float), steering))


def with_policy(params: closed_loop.Params, name: PolicyName, policy_params: PyTree) -> closed_loop.Params:
    """Return the robot with other parameters of one of its five policies.

    Args:
        params: a robot whose controller has a `policies.PolicySwitch`.
        name: name of the policy to change.
        policy_params: its new parameters, of the same type as before.
    """
    switch: policies.PolicySwitch = params.controller.policy
    index = POLICY_NAMES.index(name)
    switch = replace(switch, policies=(*switch.policies[:index], policy_params, *switch.policies[index + 1 :]))
    return replace(params, controller=replace(params.controller, policy=switch))


def with_teacher(params: closed_loop.Params, rule: braitenberg.Params) -> closed_loop.Params:
    """Return the robot with another rule, which labels its walks and which the policy `teacher` follows."""
    rule = jax.tree.map(lambda value: jnp.asarray(value, float), rule)
    return with_policy(replace(params, teacher=rule), "teacher", rule)


def select_policy(params: closed_loop.Params, policy: policies.Policy) -> closed_loop.Params:
    """Return the robot with this policy active."""
    switch = replace(params.controller.policy, active=jnp.asarray(policies.POLICIES.index(policy)))
    return replace(params, controller=replace(params.controller, policy=switch))


def fingerprint(params: closed_loop.Params) -> str:
    """Return a hash of all parameters of a robot, their structure, and its detector.

    Raises InputError for a detector of your own that is not in a file (`protocol.identify`).
    """
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params)]
    structure = repr((params.camera, jax.tree.structure(params)))
    for model in static_arguments.static_fields(params):
        if isinstance(model, Detector):
            structure = structure.replace(repr(model), protocol.identify(model))
    # Not named, so that the fingerprints of walks that were recorded before there was a choice stay the same.
    structure = structure.replace(f"({protocol.identify(lgmd)},)", "()")
    if params.body is None and params.camera.mounts is None and params.laser.mount is None and params.heading is None:
        for newer, older in NEWER_FIELDS.items():
            structure = re.sub(newer, older, structure, count=1)
    return checksums.digest(*leaves, structure.encode())[:16]


def load_detector(folder: Path) -> lgmd.Params:
    """Return the LGMD that stage collect calibrated, from its folder."""
    path = folder / "calibration.json"
    calibration = read_json(path)
    schema.check(LGMD, calibration, str(path), "run `lgmdjax collect` again")
    return lgmd_params(calibration)


def lgmd_params(constants: JsonObject) -> lgmd.Params:
    """Return an LGMD with the constants of `lgmd.SCALARS`, as a calibration or a header has them."""
    threshold, suppression, inhibition = (float(constants[name]) for name in lgmd.SCALARS)
    return lgmd.Params(threshold=threshold, suppression=suppression, inhibition=inhibition)
