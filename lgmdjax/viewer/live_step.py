"""One frame of the live simulation, as one compiled program for all values of its controls.

| input                       | place                                                  |
| --------------------------- | ------------------------------------------------------ |
| policy                      | `PolicySwitch.active`                                  |
| T_s, T_f, W_I               | `lgmd.Params`                                          |
| turn gain, speed            | `SteeredParams`                                        |
| positions of the obstacles  | `Room.arena`                                           |
| pose of the robot           | `State.data` (`place`)                                 |

With a turn gain g and a speed s, the policy's velocity (mean m, turn t = v_right - v_left) becomes (s m, g t), brought
into the range of the gait (`braitenberg.limit`).
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree, UInt8

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, controller, policies
from lgmdjax.control.policies import GAIT_RANGE, SWITCH, Observation, Policy, PolicySwitch
from lgmdjax.detectors import lgmd
from lgmdjax.reporting.playback import LAYER_WHITE
from lgmdjax.runtime.export_cache import cached_jit
from lgmdjax.runtime.mjx import mjx
from lgmdjax.sensors import camera, hemifield
from lgmdjax.simulation import closed_loop
from lgmdjax.simulation.closed_loop import AnyArray
from lgmdjax.viewer.messages import Controls
from lgmdjax.world import arena


@struct.dataclass(kw_only=True)
class SteeredParams:
    """Parameters of a switch of policies whose velocity is scaled."""

    switch: PolicySwitch
    turn_gain: Float[Array, ""]
    speed: Float[Array, ""]


@struct.dataclass(kw_only=True)
class SensedFrame:
    """What the robot senses in a frame, as bytes for display."""

    pictures: UInt8[Array, "2 height width"]
    layers: UInt8[Array, "2 3 rows columns"]  # E, I, S, each as its eye sees the scene


@struct.dataclass(kw_only=True)
class Poses:
    """Frames of a recorded walk: poses of the robot and positions of the obstacles."""

    position: Float[Array, "frames 3"]  # m
    quaternion: Float[Array, "frames 4"]
    is_first: Bool[Array, " frames"]
    centres: Float[Array, "frames prisms 2"]  # m; boxes first


def _step(
    params: SteeredParams, states: tuple[PyTree, ...], observation: Observation
) -> tuple[tuple[PyTree, ...], Float[Array, "2"]]:
    states, (left, right) = SWITCH.step(params.switch, states, observation)
    mean, turn = params.speed * (left + right) / 2, params.turn_gain * (right - left)
    return states, braitenberg.limit(GAIT_RANGE, jnp.stack([mean - turn / 2, mean + turn / 2]))


STEERED = Policy("steered", lambda params, key: SWITCH.init(params.switch, key), _step, uses_camera=True)


def steer(robot: closed_loop.Params, controls: Controls) -> closed_loop.Params:
    """Return the robot with the values of the controls; its own values for controls that are None.

    Raises InputError for a robot with another detector than the LGMD, whose constants and layers are shown.
    """
    constants = {name: getattr(controls, name) for name in ("threshold", "suppression", "inhibition")}
    given = {name: jnp.asarray(value, float) for name, value in constants.items() if value is not None}
    active = jnp.asarray(policies.POLICIES.index(policies.get_policy(controls.policy)))
    steered = SteeredParams(
        switch=replace(robot.controller.policy, active=active),
        turn_gain=jnp.asarray(controls.turn_gain, float),
        speed=jnp.asarray(controls.speed, float),
    )
    detector = replace(controller.require_lgmd(robot.controller, "the live simulation"), **given)
    return replace(robot, controller=replace(robot.controller, detector=detector, policy=steered))


@cached_jit
def start(params: closed_loop.Params, model: mjx.Model, room: closed_loop.Room) -> closed_loop.State:
    """Return the state at the room's first start."""
    return closed_loop.init(params, model, room, STEERED)


@cached_jit
def frame(
    params: closed_loop.Params, model: mjx.Model, room: closed_loop.Room, state: closed_loop.State
) -> tuple[closed_loop.State, closed_loop.Record, SensedFrame]:
    """Return the next state, its record, and what the robot sensed."""
    before = state.controller.detector.difference
    after, record = closed_loop.step(params, model, room, state, STEERED)
    scene = arena.at_time(room.arena, record.time)
    pictures = _render_whole(params, scene, record.position, record.quaternion)
    layers = _layers(params.controller.detector, before, after.controller.detector, record.is_first)
    return after, record, SensedFrame(pictures=_to_bytes(pictures), layers=layers)


@cached_jit
def replay(
    params: closed_loop.Params, room: arena.Arena, state: lgmd.State, poses: Poses
) -> tuple[lgmd.State, SensedFrame]:
    """Return what a robot sensed in some frames of a recorded walk, and the state of its LGMDs after them.

    Args:
        params: the robot.
        room: the room in which it walked.
        state: of both LGMDs before the first frame (`start_replay`).
        poses: the frames.
    """

    def step(state: lgmd.State, at: Poses) -> tuple[lgmd.State, SensedFrame]:
        pictures = _render_whole(params, with_centres(room, at.centres), at.position, at.quaternion)
        frames = _crop(params.camera, pictures)
        before = controller.restart_detectors(params.controller, state, frames, at.is_first)
        after, _ = controller.step_detectors(params.controller, before, frames)
        layers = _layers(params.controller.detector, before.difference, after, at.is_first)
        return after, SensedFrame(pictures=_to_bytes(pictures), layers=layers)

    return jax.lax.scan(step, state, poses)


def start_replay(params: closed_loop.Params) -> lgmd.State:
    """Return states of both LGMDs before any picture."""
    return controller.init_detectors(params.controller, jnp.zeros(camera.image_shape(params.camera)))


@cached_jit
def place(
    params: closed_loop.Params,
    model: mjx.Model,
    room: closed_loop.Room,
    state: closed_loop.State,
    pose: Float[Array, "3"],
) -> closed_loop.State:
    """Return the state with the robot at rest at x, y, yaw, policy and teacher new, as after a reset on contact."""
    there = replace(room, starts=jnp.broadcast_to(pose, room.starts.shape))
    after = closed_loop.reset(params, model, there, replace(state, contact=jnp.asarray(True)), STEERED)
    return replace(after, contact=jnp.asarray(False), ok=jnp.asarray(True))


def with_centres(room: arena.Arena, centres: Float[Array, "prisms 2"]) -> arena.Arena:
    """Return the room with its obstacles, boxes first, at rest at `centres` [m]."""
    boxes = len(room.boxes.top)
    return replace(
        room, boxes=_at_rest(room.boxes, centres[:boxes]), cylinders=_at_rest(room.cylinders, centres[boxes:])
    )


def _at_rest(prisms: arena.Prisms, centres: Float[Array, "n 2"]) -> arena.Prisms:
    return replace(prisms, centre=centres, goal=centres)


def _render_whole(
    params: closed_loop.Params, scene: arena.Arena, position: Float[AnyArray, "3"], quaternion: Float[AnyArray, "4"]
) -> Float[Array, "2 height width"]:
    """Render both pictures whole, with the parts that no LGMD sees."""
    pose = hexapod.Pose(position=jnp.asarray(position), quaternion=jnp.asarray(quaternion))
    return closed_loop.render_stereo(replace(params.camera, overlap=1.0, ground=0.0), scene, pose)


def _crop(eyes: camera.Params, pictures: Float[Array, "2 height width"]) -> Float[Array, "2 rows columns"]:
    """Return what the LGMDs see of both pictures."""
    seen = (hemifield.crop(pictures[side], side, overlap=eyes.overlap, ground=eyes.ground) for side in (0, 1))
    return jnp.stack([jnp.asarray(part) for part in seen])


def _to_bytes(pictures: Float[Array, "2 height width"]) -> UInt8[Array, "2 height width"]:
    return jnp.clip(pictures, 0, 255).astype(jnp.uint8)


def _layers(
    params: lgmd.Params, before: Float[Array, "2 rows columns"], after: lgmd.State, is_first: Bool[AnyArray, ""]
) -> UInt8[Array, "2 3 rows columns"]:
    """Return E, W_I |I| and S of both LGMDs (eqs. 8, 10, 11) as bytes, each as its eye sees the scene.

    Args:
        params: of the detectors.
        before: their change in the last frame.
        after: their state after the frame.
        is_first: there was no last change.
    """
    last = jnp.where(is_first, 0.0, before)
    inhibited = jnp.stack([lgmd.inhibit(params.kernel, change) for change in last])
    excitation, inhibition = jnp.abs(after.difference), params.inhibition * jnp.abs(inhibited)
    layers = jnp.stack([excitation, inhibition, excitation - inhibition], axis=1)
    as_seen = jnp.stack([layers[0], layers[1, :, :, ::-1]])  # in the right LGMD, the outermost column comes first
    return (255 * jnp.clip(as_seen / LAYER_WHITE, 0, 1)).astype(jnp.uint8)
