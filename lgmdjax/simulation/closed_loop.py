"""The closed loop: one robot, one camera frame. Reset, observe, decide, move.

In each frame of 1/30 s a robot

1. renders both cameras from its present pose, scans with the laser, and steps the looming detectors,
2. lets the policy choose a velocity, and the teacher label the frame,
3. runs CPG, servos and physics for `SUBSTEPS` steps.

Everything is a pure function of (parameters, room, state): a rollout is a `lax.scan` over `step`, that of a batch a
scan over its `vmap` (`lgmdjax.simulation.rollout`).

After contact with a wall or an obstacle the next frame begins with a reset to the room's next start, as an experimenter
would lift the robot, so that one rollout can count several collisions. A robot that fell over, or whose state is not
finite, is frozen and flagged by `ok`; nothing here raises.
"""

from dataclasses import replace
from functools import partial
from typing import Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, compass, controller
from lgmdjax.control.controller import Response
from lgmdjax.control.policies import Observation, Policy
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.runtime.mjx import mjx
from lgmdjax.sensors import camera, camera_faults, laser
from lgmdjax.simulation import faulty_cameras
from lgmdjax.world import arena, floor_plan

Tree = TypeVar("Tree")
AnyArray = Array | np.ndarray

GradPath = Literal["controller", "body", "everything"]
"""What a gradient passes through: only the policy; also the body and the label; or also camera and detectors."""

FRAME_RATE = 30.0  # Hz, of the camera (paper sec. 3.1)
PATH_STRIDE = 8  # frames between two points of a path that a notebook shows
CAMERAS = 2**31  # folded into a room's key for its cameras, beyond any number of resets
SUBSTEPS = 6  # physics steps a frame; the time step in the robot's XML is 1 / (FRAME_RATE * SUBSTEPS)


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Parameters of a robot: controller, teacher, sensors, and which body it has (`build_model`)."""

    controller: controller.Params
    teacher: braitenberg.Params  # of the rule that labels the frames
    camera: camera.Params
    laser: laser.Params
    frame_stride: Int[Array, ""] | None = None  # frames from one picture to the next, 1 if None; u is held in between
    head_sway: Float[Array, ""] | None = None  # sway of the head, as a multiple of the trunk's, 1 if None
    heading: compass.Params | None = None  # of a robot that keeps the heading of its start; None for one without a goal
    body: hexapod.Body | None = struct.field(pytree_node=False, default=None)  # the package's if None


@struct.dataclass(kw_only=True)
class Room(NotebookTable):
    """A room with the poses (x, y, yaw) at which its robot starts, in order."""

    arena: arena.Arena
    starts: Float[Array, "starts 3"]
    key: Array  # random key of policy and cameras
    faults: camera_faults.Params | None = None  # of the robot's cameras (`faulty_cameras`), none if None

    def _picture(self) -> str:
        return self.arena._picture()


@struct.dataclass(kw_only=True)
class State:
    """State of one robot in one room between two frames."""

    data: mjx.Data
    controller: controller.State
    teacher: braitenberg.State
    heading: compass.State | None  # None without `Params.heading`
    response: Response  # of both detectors to the last picture
    frame: Int[Array, ""]  # frames since the start of the rollout
    resets: Int[Array, ""]  # number of resets so far
    is_first: Bool[Array, ""]  # first frame after a start or reset: there is no picture to compare with
    contact: Bool[Array, ""]  # touched something in the last frame
    ok: Bool[Array, ""]  # finite and not fallen
    cameras: faulty_cameras.State | None = None  # if the room has faults


@struct.dataclass(kw_only=True)
class Record(NotebookTable):
    """The record of one frame, or of many: `axes` are then (frame) or (robot, frame).

    The pose is that from which the pictures were rendered. Records on the host hold NumPy arrays.
    """

    time: Float[AnyArray, "*axes"]  # s, since the start of the rollout
    position: Float[AnyArray, "*axes 3"]  # m, of the trunk
    quaternion: Float[AnyArray, "*axes 4"]  # w x y z
    joints: Float[AnyArray, "*axes 6 3"]  # rad
    u: Float[AnyArray, "*axes 2"]  # 1, outputs of the detectors, left first
    feed_forward: Float[AnyArray, "*axes 2"]  # grey; zero for a detector without
    excitation: Float[AnyArray, "*axes 2"]  # grey, U / n_cell
    distances: Float[AnyArray, "*axes 2"]  # m, to the nearest obstacle
    corridor: Float[AnyArray, "*axes 2"]  # m, to the nearest obstacle in the way
    label: Float[AnyArray, "*axes 2"]  # velocity of the teacher, nominal
    velocity: Float[AnyArray, "*axes 2"]  # velocity of the policy, nominal
    clearance: Float[AnyArray, "*axes"]  # m, smallest within the frame
    contact: Bool[AnyArray, "*axes"]  # clearance <= 0 in some substep
    is_first: Bool[AnyArray, "*axes"]  # first frame after a start or reset
    resets: Int[AnyArray, "*axes"]  # number of resets so far
    ok: Bool[AnyArray, "*axes"]  # finite and not fallen

    def _picture(self) -> str:
        """Return the paths of up to four robots from above, interrupted at resets, with crosses at contacts."""
        position, resets, contact = (np.asarray(leaf) for leaf in (self.position, self.resets, self.contact))
        if position.ndim not in (2, 3) or not position.size:
            return ""
        series = (leaf if position.ndim == 3 else leaf[None] for leaf in (position, resets, contact))
        paths, marks = [], []
        for own, count, touched in zip(*(leaf[:4] for leaf in series), strict=True):
            paths.append([part[::PATH_STRIDE] for part in np.split(own, np.flatnonzero(np.diff(count)) + 1)])
            marks.append(own[touched])
        return floor_plan.svg(None, paths, marks)


def frame_type(camera_params: camera.Params) -> jax.ShapeDtypeStruct:
    """Return shape and type of what the camera shows to each detector."""
    return jax.ShapeDtypeStruct(camera.image_shape(camera_params)[1:], jnp.result_type(float))


def build_model(params: Params) -> mjx.Model:
    """Return the model of a robot's body, in JAX's current default precision."""
    return hexapod.build(hexapod.load(params.body))


def init(params: Params, model: mjx.Model, room: Room, policy: Policy) -> State:
    """Return the state of a robot at the room's first start, its CPG on the limit cycle, before the first picture."""
    black, faults = jnp.zeros(camera.image_shape(params.camera)), room.faults
    if faults is not None and params.frame_stride is not None:
        raise InputError("expected a robot that sees in every frame in rooms with camera faults, got a frame_stride")
    return State(
        data=hexapod.init(model, room.starts[0]),
        controller=controller.init(params.controller, black, policy, room.key),
        teacher=braitenberg.init(params.teacher),
        heading=_init_heading(params, room, jnp.asarray(0, jnp.int32)),
        response=controller.rest(),
        frame=jnp.asarray(0, jnp.int32),
        resets=jnp.asarray(0, jnp.int32),
        is_first=jnp.asarray(True),
        contact=jnp.asarray(False),
        ok=jnp.asarray(True),
        cameras=None if faults is None else faulty_cameras.init(faults, black, jax.random.fold_in(room.key, CAMERAS)),
    )


def step(
    params: Params,
    model: mjx.Model,
    room: Room,
    state: State,
    policy: Policy,
    *,
    render: Bool[Array, ""] | bool = True,
    grad_path: GradPath = "everything",
) -> tuple[State, Record]:
    """Run one frame: reset after contact, observe, decide, move.

    Without `render` the pictures are black (u = 0.5), for policies that do not use the camera.

    Gradient: through all that `grad_path` names. With "body" the pictures and the detectors' responses are held
    constant; with "controller" also the label, the distances and the body.
    """
    state = reset(params, model, room, state, policy)
    scene = arena.at_time(room.arena, state.frame / FRAME_RATE)
    state, observation = observe(params, scene, state, render, room.faults)
    if grad_path != "everything":
        state, observation = _hold_vision(state, observation)
    state, label = decide(params, state, observation, policy)
    mover = (params, state)
    if grad_path == "controller":
        label, mover = jax.lax.stop_gradient((label, mover))
    moved, clearance = move(mover[0], model, scene, mover[1])
    moved = replace(moved, controller=replace(state.controller, cpg=moved.controller.cpg))
    record = _record(state, observation, label, clearance)
    return freeze_unhealthy(model, state, moved), record


def _hold_vision(state: State, observation: Observation) -> tuple[State, Observation]:
    """Stop the gradient through pictures and responses of the detectors."""
    detector_state, response = jax.lax.stop_gradient((state.controller.detector, state.response))
    held = replace(state, controller=replace(state.controller, detector=detector_state), response=response)
    outputs = {name: jax.lax.stop_gradient(getattr(observation, name)) for name in ("u", "feed_forward", "excitation")}
    return held, replace(observation, **outputs)


def reset(params: Params, model: mjx.Model, room: Room, state: State, policy: Policy) -> State:
    """Reset a robot after contact to the room's next start, with new policy and teacher states; the CPG continues."""
    resets = state.resets + 1
    start = jnp.take(room.starts, resets, axis=0, mode="wrap")
    policy_state = policy.init(params.controller.policy, jax.random.fold_in(room.key, resets))
    at_start = replace(
        state,
        data=hexapod.reset(model, state.data, start),
        controller=replace(state.controller, policy=policy_state),
        teacher=braitenberg.init(params.teacher),
        heading=_init_heading(params, room, resets),
        resets=resets,
        is_first=jnp.ones_like(state.is_first),
    )
    return _where(state.contact, at_start, state)


def observe(
    params: Params,
    scene: arena.Arena,
    state: State,
    render: Bool[Array, ""] | bool = True,
    faults: camera_faults.Params | None = None,
) -> tuple[State, Observation]:
    """Render, scan, and step the detectors (eqs. 7-16); return the observation from the robot's present pose."""
    frames, ranges = sense(params, scene, state, render)
    if faults is None or state.cameras is None:
        return respond(params, state, frames, ranges)
    sensor = camera_faults.average(faults, params.camera.width)
    cameras, frames = faulty_cameras.step(sensor, state.cameras, frames, state.is_first)
    response = _where(cameras.is_waiting, controller.rest(frames.dtype), state.response)
    return respond(params, replace(state, cameras=cameras, response=response), frames, ranges)


def sense(
    params: Params, scene: arena.Arena, state: State, render: Bool[Array, ""] | bool = True
) -> tuple[Float[Array, "2 height columns"], Float[Array, " rays"]]:
    """Return both pictures [grey, 0..255] and the laser's ranges [m] from the robot's present pose."""
    pose = hexapod.pose(state.data)
    ranges = laser.scan(params.laser, scene, *hexapod.laser_pose(pose, params.laser.mount))
    head = pose if params.head_sway is None else hexapod.scale_tilt(pose, params.head_sway)
    return render_stereo(params.camera, scene, head, render), ranges


def respond(
    params: Params, state: State, frames: Float[Array, "2 height columns"], ranges: Float[Array, " rays"]
) -> tuple[State, Observation]:
    """Step the detectors (eqs. 7-16) with what `sense` returned; return the observation."""
    is_first = state.is_first if state.cameras is None else state.cameras.is_waiting
    controller_state, response = controller.detect_or_start(params.controller, state.controller, frames, is_first)
    has_picture = _has_picture(params, state)
    if has_picture is not None:
        new, old = (controller_state, response), (state.controller, state.response)
        controller_state, response = _where(has_picture, new, old)
    observation = Observation(
        u=response.u,
        feed_forward=response.feed_forward,
        excitation=response.excitation,
        distances=laser.hemifield_distances(ranges),
        corridor=laser.corridor_distances(params.laser, ranges),
    )
    return replace(state, controller=controller_state, response=response), observation


def _has_picture(params: Params, state: State) -> Bool[Array, ""] | None:
    """Return whether the detectors get a picture in this frame; None if they do in every frame."""
    if state.cameras is not None:
        return state.cameras.arrived
    return None if params.frame_stride is None else state.is_first | (state.frame % params.frame_stride == 0)


def render_stereo(
    camera_params: camera.Params, scene: arena.Arena, pose: hexapod.Pose, render: Bool[Array, ""] | bool = True
) -> Float[Array, "2 height columns"]:
    """Render both cameras from a pose of the trunk, in grey levels 0..255; black without `render`.

    Whether to render is decided at run time even if it is known before, so that rendering is compiled separately.
    Otherwise XLA would render again inside each loop that reads the picture, with other rounding in each program. If
    `render` is an array, one compiled program serves rollouts with and without pictures.
    """
    black = jnp.zeros(camera.image_shape(camera_params), pose.position.dtype)
    if render is False:
        return black
    unknown = jax.lax.optimization_barrier(jnp.asarray(render))
    eyes = hexapod.eye_poses(pose, camera_params.mounts)
    return jax.lax.cond(unknown, lambda: camera.render(camera_params, scene, *eyes), lambda: black)


def decide(params: Params, state: State, observation: Observation, policy: Policy) -> tuple[State, Float[Array, "2"]]:
    """Let the policy choose the velocity; return also the teacher's velocity (eq. 22, limited), the label."""
    distances = braitenberg.sensed_distances(params.teacher, observation.distances, observation.corridor)
    _, label = braitenberg.step(params.teacher, state.teacher, distances)
    controller_state = controller.decide(params.controller, state.controller, observation, policy)
    state = _steer(params, replace(state, controller=controller_state))
    teacher = braitenberg.track_turn(params.teacher, state.controller.velocity)
    return replace(state, teacher=teacher), label


def _init_heading(params: Params, room: Room, resets: Int[Array, ""]) -> compass.State | None:
    """Return the state in which the robot keeps the heading of its start; the drift of its sensor is random."""
    if params.heading is None:
        return None
    start = jnp.take(room.starts, resets, axis=0, mode="wrap")
    sign = jax.random.uniform(jax.random.fold_in(room.key, resets), (), start.dtype, -1.0, 1.0)
    return compass.init(params.heading, start[2], sign)


def _steer(params: Params, state: State) -> State:
    """Add the turn towards the heading that the robot keeps, if it keeps one, to the velocity of the policy."""
    if params.heading is None or state.heading is None:
        return state
    yaw, velocity = hexapod.yaw(hexapod.pose(state.data)), state.controller.velocity
    kept, velocity = compass.step(params.heading, state.heading, velocity, yaw, 1 / FRAME_RATE)
    return replace(state, heading=kept, controller=replace(state.controller, velocity=velocity))


def move(
    params: Params, model: mjx.Model, scene: arena.Arena, state: State, targets: Float[Array, "6 3"] | None = None
) -> tuple[State, Float[Array, ""]]:
    """Run CPG, servos and physics until the next frame; return also the smallest clearance [m] within it.

    With `targets` [rad] the servos hold these set points for the whole frame, and the CPG is not stepped.
    """
    model = hexapod.place_barriers(model, scene, state.data)
    interval = 1 / (FRAME_RATE * SUBSTEPS)

    @partial(jax.checkpoint, prevent_cse=False)  # storing its intermediates for the backward pass would take longer
    def substep(
        carry: tuple[mjx.Data, controller.State], _: None
    ) -> tuple[tuple[mjx.Data, controller.State], Float[Array, ""]]:
        data, controller_state = carry
        set_points = targets
        if set_points is None:
            controller_state, set_points = controller.move(params.controller, controller_state, interval)
        data = hexapod.substep(model, data, set_points)
        clearance = jnp.min(arena.clearance(scene, *hexapod.capsules(model, data)))
        return (data, controller_state), clearance

    (data, controller_state), clearances = jax.lax.scan(substep, (state.data, state.controller), length=SUBSTEPS)
    clearance = jnp.min(clearances)
    state = replace(
        state,
        data=data,
        controller=controller_state,
        frame=state.frame + 1,
        is_first=jnp.zeros_like(state.is_first),
        contact=clearance <= 0,
    )
    return state, clearance


def _record(state: State, observation: Observation, label: Float[Array, "2"], clearance: Float[Array, ""]) -> Record:
    pose = hexapod.pose(state.data)
    return Record(
        time=state.frame / FRAME_RATE,
        position=pose.position,
        quaternion=pose.quaternion,
        joints=hexapod.joint_angles(state.data),
        u=observation.u,
        feed_forward=observation.feed_forward,
        excitation=observation.excitation,
        distances=observation.distances,
        corridor=observation.corridor,
        label=label,
        velocity=state.controller.velocity,
        clearance=clearance,
        contact=clearance <= 0,
        is_first=state.is_first,
        resets=state.resets,
        ok=state.ok,
    )


def freeze_unhealthy(model: mjx.Model, before: State, after: State) -> State:
    """Freeze a robot permanently in its last healthy state if it fell or became non-finite; it still counts frames."""
    ok = before.ok & hexapod.is_healthy(model, after.data)
    return replace(_where(ok, after, before), ok=ok, frame=after.frame)


def _where(condition: Bool[Array, ""], chosen: Tree, otherwise: Tree) -> Tree:
    """Choose between two pytrees of one structure."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), chosen, otherwise)
