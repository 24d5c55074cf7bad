"""One robot, one camera frame: sense, decide, move.

A frame draws what both eyes see from where the robot stands, scans with the laser, shows the pictures to the
LGMDs, lets the driver choose a velocity and the rule label the frame, and then runs the rhythm, the servos and
the body for the physics substeps of 1/30 s. Everything is a pure function of (parameters, room, state): a walk
is a `lax.scan` over `step`, that of a crowd one over its `vmap` (`lgmdjax.simulation.rollout`).

A touch of a wall or an obstacle ends a stretch: the next frame begins with the robot set back at the room's next
start, as an experimenter would lift it, so that one walk can count several collisions. A robot whose state is
not finite, or that fell over, is frozen where it was and flagged by `ok`; nothing here raises.
"""

from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx

from lgmdjax.body import hexapod
from lgmdjax.control import braitenberg, controller
from lgmdjax.control.policies import Driver, Senses
from lgmdjax.detectors import lgmd
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.sensors import camera, laser
from lgmdjax.world import arena

Leaf = Array | np.ndarray
Through = Literal[
    "controller", "nerves", "everything"
]  # what a derivative passes (`lgmdjax.learning.rollout_gradient`)
FRAME_RATE = 30.0  # Hz, the camera's (paper sec. 3.1)
SUBSTEPS = 6  # physics steps a frame; the robot's XML has the time step that makes them fill it


@struct.dataclass(kw_only=True)
class Params:
    """What a robot is made of, beside its body: senses, nervous system, and the rule that labels its frames."""

    controller: controller.Params
    teacher: braitenberg.Params
    camera: camera.Params
    laser: laser.Params
    every: Int[Array, ""] | None = None  # frames from one picture to the next, 1 if None; u stands in between
    sway: Float[Array, ""] | None = None  # of the head, as a multiple of the trunk's, 1 if None


@struct.dataclass(kw_only=True)
class Room:
    """Where a robot walks: the obstacles, and the poses (x, y, yaw) at which it is put down, in order."""

    arena: arena.Arena
    starts: Float[Array, "starts 3"]
    key: Array  # the luck of a driver that has some


@struct.dataclass(kw_only=True)
class State:
    """One robot in one room between two frames."""

    data: mjx.Data
    controller: controller.State
    teacher: braitenberg.State
    response: lgmd.Response  # to the last picture, of two eyes
    frame: Int[Array, ""]  # frames since the start
    setbacks: Int[Array, ""]  # times that it was put down again
    fresh: Bool[Array, ""]  # just put down: the eyes have no last picture yet
    touched: Bool[Array, ""]  # hit something in the last frame
    ok: Bool[Array, ""]  # finite and on its feet


@struct.dataclass(kw_only=True)
class Record:
    """What one frame leaves behind; the pose is the one from which the pictures were drawn. NumPy's on the host."""

    time: Float[Leaf, ""]  # s
    position: Float[Leaf, "3"]  # m
    quaternion: Float[Leaf, "4"]  # w x y z
    joints: Float[Leaf, "6 3"]  # rad
    u: Float[Leaf, "2"]
    feed_forward: Float[Leaf, "2"]  # grey
    excitation: Float[Leaf, "2"]  # grey, U / n_cell
    distances: Float[Leaf, "2"]  # m
    label: Float[Leaf, "2"]  # the teacher's velocity
    velocity: Float[Leaf, "2"]  # the driver's velocity
    clearance: Float[Leaf, ""]  # m, the least within the frame
    contact: Bool[Leaf, ""]  # clearance <= 0 in some substep
    fresh: Bool[Leaf, ""]
    setbacks: Int[Leaf, ""]
    ok: Bool[Leaf, ""]


def assemble(
    driver: Any,
    *,
    detector: lgmd.Params | None = None,
    rhythm: cpg.Params | None = None,
    networks: shaping.Params | None = None,
    teacher: braitenberg.Params | None = None,
    eyes: camera.Params | None = None,
    scanner: laser.Params | None = None,
) -> Params:
    """Put a robot together from its driver's parameters and whatever else is not the default.

    Plain numbers become arrays, so that a program compiled for some values serves all, and can be differentiated in
    them. The default networks are those that come with the package (`shaping.taught`).

    Raises InputError for numbers without sense (the components' `check`), unless some are being traced.
    """
    nerves = controller.Params(
        lgmd=detector or lgmd.Params(),
        driver=driver,
        cpg=rhythm or cpg.Params(),
        shaping=networks or shaping.taught(),
    )
    params = Params(
        controller=nerves,
        teacher=teacher or braitenberg.Params(),
        camera=eyes or camera.Params(),
        laser=scanner or laser.Params(),
    )
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(params)):
        lgmd.check(nerves.lgmd)
        cpg.check(nerves.cpg)
        braitenberg.check(params.teacher)
        laser.check(params.laser)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if np.isscalar(leaf) else leaf, params)


def init(params: Params, model: mjx.Model, room: Room, driver: Driver) -> State:
    """Put a robot down at the room's first start, with its rhythm settled and its eyes about to open."""
    dark = jnp.zeros(camera.shape(params.camera))
    return State(
        data=hexapod.reset(model, room.starts[0]),
        controller=controller.init(params.controller, dark, driver, room.key),
        teacher=braitenberg.init(params.teacher),
        response=lgmd.Response(u=jnp.full(2, lgmd.STILL, float), feed_forward=jnp.zeros(2), excitation=jnp.zeros(2)),
        frame=jnp.asarray(0, jnp.int32),
        setbacks=jnp.asarray(0, jnp.int32),
        fresh=jnp.asarray(True),
        touched=jnp.asarray(False),
        ok=jnp.asarray(True),
    )


def step(
    params: Params,
    model: mjx.Model,
    room: Room,
    state: State,
    driver: Driver,
    draw: Bool[Array, ""] | bool = True,
    through: Through = "everything",
) -> tuple[State, Record]:
    """Run one frame: set back if it touched, sense, decide, move.

    Without `draw` the eyes stay shut and see black (u = 0.5): for drivers that do not look, in walks whose pictures
    nobody wants.

    Gradient: by all that `through` names. With "nerves", what the eyes say is held; with "controller", the label and
    the body too.
    """
    state = set_back(params, room, state, driver)
    scene = arena.at(room.arena, state.frame / FRAME_RATE)
    state, senses = sense(params, scene, state, draw)
    if through != "everything":
        state, senses = _eyes_held(state, senses)
    state, label = decide(params, state, senses, driver)
    walker = (params, state)
    if through == "controller":
        label, walker = jax.lax.stop_gradient((label, walker))
    moved, clearance = move(walker[0], model, scene, walker[1])
    moved = replace(moved, controller=replace(state.controller, cpg=moved.controller.cpg))
    record = _record(state, senses, label, clearance)
    return _keep_sound(state, moved), record


def _eyes_held(state: State, senses: Senses) -> tuple[State, Senses]:
    """Take what the eyes saw and said for given."""
    eyes, response = jax.lax.stop_gradient((state.controller.lgmd, state.response))
    held = replace(state, controller=replace(state.controller, lgmd=eyes), response=response)
    said = {name: jax.lax.stop_gradient(getattr(senses, name)) for name in ("u", "feed_forward", "excitation")}
    return held, replace(senses, **said)


def set_back(params: Params, room: Room, state: State, driver: Driver) -> State:
    """Put a robot that touched something down at the room's next start, driver and rule as new, the rhythm going on."""
    setbacks = state.setbacks + 1
    start = jnp.take(room.starts, setbacks, axis=0, mode="wrap")
    fresh_driver = driver.init(params.controller.driver, jax.random.fold_in(room.key, setbacks))
    lifted = replace(
        state,
        data=hexapod.put(state.data, start),
        controller=replace(state.controller, driver=fresh_driver),
        teacher=braitenberg.init(params.teacher),
        setbacks=setbacks,
        fresh=jnp.ones_like(state.fresh),
    )
    return _where(state.touched, lifted, state)


def sense(
    params: Params, scene: arena.Arena, state: State, draw: Bool[Array, ""] | bool = True
) -> tuple[State, Senses]:
    """Look and scan from where the robot stands; the LGMDs (eqs. 7-16) see the left and right hemifield."""
    pose = hexapod.pose(state.data)
    distances = laser.hemifields(laser.scan(params.laser, scene, *hexapod.laser_pose(pose)))
    nerves = state.controller

    head = pose if params.sway is None else hexapod.swaying(pose, params.sway)
    frames = look(params.camera, scene, head, draw)
    opened = _where(state.fresh, controller.open_eyes(params.controller, frames), nerves.lgmd)
    nerves, response = controller.see(params.controller, replace(nerves, lgmd=opened), frames)
    if params.every is not None:
        looks = state.fresh | (state.frame % params.every == 0)
        nerves, response = _where(looks, (nerves, response), (state.controller, state.response))
    senses = Senses(
        u=response.u, feed_forward=response.feed_forward, excitation=response.excitation, distances=distances
    )
    return replace(state, controller=nerves, response=response), senses


def look(
    eyes: camera.Params, scene: arena.Arena, pose: hexapod.Pose, draw: Bool[Array, ""] | bool = True
) -> Float[Array, "2 height columns"]:
    """Draw what both eyes see from a pose of the trunk, in grey levels 0..255; black without `draw`.

    The choice is made at run time, also where it is known before, so that the drawing is compiled by itself. XLA would
    else draw anew inside each of the loops that read the picture, and round differently in each program. Given as an
    array, one program serves walks with and without pictures.
    """
    dark = jnp.zeros(camera.shape(eyes), pose.position.dtype)
    if draw is False:
        return dark
    unknown = jax.lax.optimization_barrier(jnp.asarray(draw))
    return jax.lax.cond(unknown, lambda: camera.render(eyes, scene, *hexapod.eye_poses(pose)), lambda: dark)


def decide(params: Params, state: State, senses: Senses, driver: Driver) -> tuple[State, Float[Array, "2"]]:
    """Let the driver choose the velocity, and the rule (eq. 22, limited) label the frame."""
    _, label = braitenberg.step(params.teacher, state.teacher, senses.distances)
    nerves = controller.decide(params.controller, state.controller, senses, driver)
    teacher = braitenberg.watch(params.teacher, nerves.velocity)
    return replace(state, controller=nerves, teacher=teacher), label


def move(params: Params, model: mjx.Model, scene: arena.Arena, state: State) -> tuple[State, Float[Array, ""]]:
    """Run rhythm, servos and body to the next frame; return the least clearance [m] on the way."""
    model = hexapod.place_obstacles(model, scene, state.data)
    interval = 1 / (FRAME_RATE * SUBSTEPS)

    @partial(jax.checkpoint, prevent_cse=False)  # to keep its inside for the way back would take longer
    def substep(carry, _):
        data, nerves = carry
        nerves, targets = controller.move(params.controller, nerves, interval)
        data = hexapod.substep(model, data, targets)
        clearance = jnp.min(arena.clearance(scene, *hexapod.capsules(model, data)))
        return (data, nerves), clearance

    (data, nerves), clearances = jax.lax.scan(substep, (state.data, state.controller), length=SUBSTEPS)
    clearance = jnp.min(clearances)
    state = replace(
        state,
        data=data,
        controller=nerves,
        frame=state.frame + 1,
        fresh=jnp.zeros_like(state.fresh),
        touched=clearance <= 0,
    )
    return state, clearance


def _record(state: State, senses: Senses, label: Float[Array, "2"], clearance: Float[Array, ""]) -> Record:
    pose = hexapod.pose(state.data)
    return Record(
        time=state.frame / FRAME_RATE,
        position=pose.position,
        quaternion=pose.quaternion,
        joints=hexapod.joints(state.data),
        u=senses.u,
        feed_forward=senses.feed_forward,
        excitation=senses.excitation,
        distances=senses.distances,
        label=label,
        velocity=state.controller.velocity,
        clearance=clearance,
        contact=clearance <= 0,
        fresh=state.fresh,
        setbacks=state.setbacks,
        ok=state.ok,
    )


def _keep_sound(before: State, after: State) -> State:
    """Freeze a robot that fell or went non-finite at its last sound frame, for good; only the clock goes on."""
    ok = before.ok & hexapod.is_sound(after.data)
    return replace(_where(ok, after, before), ok=ok, frame=after.frame)


def _where(condition: Bool[Array, ""], chosen: Any, otherwise: Any) -> Any:
    """Choose between two pytrees of one structure."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), chosen, otherwise)
