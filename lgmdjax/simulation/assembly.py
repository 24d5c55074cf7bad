"""Robots assembled from the files of a run, or from those of the package."""

from dataclasses import asdict, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lgmdjax.control import braitenberg, navigator, policies
from lgmdjax.control.names import POLICY_NAMES, PolicyName
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.locomotion import shaping
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.runtime import checksums, schema
from lgmdjax.runtime.storage import JsonObject, read_arrays, read_json
from lgmdjax.sensors import camera, hemifield
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


def camera_params(settings: CameraSettings) -> camera.Params:
    """Return the stereo camera of these settings."""
    of_detector = ("pooling", "falloff")
    return camera.Params(**{name: value for name, value in asdict(settings).items() if name not in of_detector})


def camera_settings(robot: closed_loop.Params) -> CameraSettings:
    """Return the camera settings of a robot, as `with_camera` sets them."""
    of_camera = {name: getattr(robot.camera, name) for name in ("width", "height", "overlap", "ground")}
    return CameraSettings(**of_camera, pooling=robot.controller.lgmd.pooling, falloff=robot.controller.lgmd.falloff)


def read_camera_settings(header: JsonObject, place: str = "header") -> CameraSettings:
    """Return the camera of a controller's training, or of recorded walks, from their header.

    Raises InputError for impossible ones, with `place` in the message.
    """
    eyes = header["eyes"]
    schema.check(EYES, eyes, f"{place}: eyes", "collect and train again")
    smallest = min(eyes["width"], eyes["height"])
    schema.check(schema.Integer(1, smallest), eyes.get("pooling", 1), f"{place}: pooling", "train again")
    return CameraSettings(**{name: eyes[name] for name in (*EYES.fields, *EYES.optional) if name in eyes})


def fit_detector(detector: lgmd.Params, settings: CameraSettings) -> lgmd.Params:
    """Return the LGMD with the size, the bearings and the weights of its cells set for a camera."""
    edges = hemifield.edges(camera.Params().fov, settings.overlap)
    return replace(detector, pooling=settings.pooling, falloff=settings.falloff, edges=edges)


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


def assemble_robot(
    gait_folder: Path,
    camera_settings: CameraSettings,
    lgmd_params: lgmd.Params,
    policy_params: policies.PolicySwitch,
) -> closed_loop.Params:
    """Return a robot with the fitted gait of a run, and the given camera, detector and policies."""
    params = closed_loop.assemble(
        policy_params,
        lgmd_params=lgmd_params,
        shaping_params=shaping.load(gait_folder / "shaping.safetensors"),
        camera_params=camera_params(camera_settings),
    )
    return with_camera(params, camera_settings)


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

    `settings.pooling` keeps the visual angle of an LGMD cell, so that its responses change little.
    """
    lgmd_params = fit_detector(params.controller.lgmd, settings)
    return replace(params, camera=camera_params(settings), controller=replace(params.controller, lgmd=lgmd_params))


def with_resolution(robot: closed_loop.Params, resolution: Resolution) -> closed_loop.Params:
    """Return the robot with images and LGMD cells of another size; its LGMDs keep their field of view and weights."""
    sizes = {name: getattr(resolution, name) for name in ("width", "height", "pooling")}
    return with_camera(robot, replace(camera_settings(robot), **sizes))


def scale_resolution(robot: closed_loop.Params, width: int) -> Resolution:
    """Return the resolution with images of another width and LGMD cells of the same size in degrees.

    Raises InputError for a width at which the cells are not whole pixels.
    """
    camera, pooling = robot.camera, robot.controller.lgmd.pooling
    if width < 1 or (pooling * width) % camera.width or (camera.height * width) % camera.width:
        raise InputError(
            f"expected a --width whose cells are whole pixels ({pooling} at width {camera.width}), got {width}; "
            f"try {2 * camera.width}"
        )
    height, cell = camera.height * width // camera.width, pooling * width // camera.width
    return Resolution(width=width, height=height, pooling=cell)


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
    """Return a hash of all parameters of a robot and their structure."""
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params)]
    structure = repr((params.camera, jax.tree.structure(params))).encode()
    return checksums.digest(*leaves, structure)[:16]


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
