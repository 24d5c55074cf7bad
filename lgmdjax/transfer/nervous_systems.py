"""The nervous systems of a batch of robots, at a real robot's two rates: that of pictures and that of set points.

`process_picture` runs once for each picture, `next_targets` 180 times a second, with or without a new picture. Both
call the functions of `lgmdjax.control.controller`, as the closed loop in MJX and `deployment.nervous_system` do: with a
picture before every sixth set point, they are the same system.
"""

from dataclasses import replace
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from lgmdjax.body import hexapod, servo_faults
from lgmdjax.control import braitenberg, controller, policies
from lgmdjax.control.controller import Response
from lgmdjax.control.policies import Observation
from lgmdjax.minmax import clip
from lgmdjax.sensors import camera, camera_faults, hemifield, laser
from lgmdjax.simulation import closed_loop
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS
from lgmdjax.transfer.faults import Faults

Tree = TypeVar("Tree")

INTERVAL = 1 / (FRAME_RATE * SUBSTEPS)  # s, between two set points
POLICY = policies.SWITCH


@struct.dataclass(kw_only=True)
class State:
    """State of one robot's nervous system, cameras and servos."""

    controller: controller.State
    teacher: braitenberg.State
    response: Response
    distances: Float[Array, "2"]  # m, the scanner's last measurement
    corridor: Float[Array, "2"]
    label: Float[Array, "2"]  # the teacher's velocity
    is_first: Bool[Array, ""]  # no picture came since the start or reset
    cameras: camera_faults.State
    servos: servo_faults.State


def init(params: closed_loop.Params, faults: Faults, key: Array) -> State:
    """Return the state of a robot that has not seen a picture yet, its CPG on the limit cycle."""
    black = jnp.zeros(camera.image_shape(params.camera), jnp.float32)
    whole = jnp.zeros((2, params.camera.height, params.camera.width), jnp.float32)
    zero = jnp.zeros(2, jnp.float32)
    return State(
        controller=controller.init(params.controller, black, POLICY, key),
        teacher=braitenberg.init(params.teacher),
        response=controller.rest(jnp.float32),
        distances=zero,
        corridor=zero,
        label=zero,
        is_first=jnp.asarray(True),
        cameras=camera_faults.init(faults.camera, whole, jax.random.fold_in(key, 1)),
        servos=servo_faults.init(faults.servos, jnp.asarray(hexapod.stance(params.body), jnp.float32)),
    )


def process_picture(
    params: closed_loop.Params,
    faults: Faults,
    state: State,
    pictures: Float[Array, "2 height width"],
    ranges: Float[Array, " rays"],
) -> State:
    """Return the state after taking a picture and a scan; if a picture arrives, detectors and policy process it."""
    cameras = replace(state.cameras, previous=_previous(state, pictures))
    sensor = camera_faults.average(faults.camera, params.camera.width)
    cameras, delivery = camera_faults.step(sensor, cameras, pictures)
    field = {"overlap": params.camera.overlap, "ground": params.camera.ground}
    frames = [hemifield.crop(delivery.pictures[side], side, **field) for side in (hemifield.LEFT, hemifield.RIGHT)]
    seen, response = controller.detect_or_start(params.controller, state.controller, jnp.stack(frames), state.is_first)
    distances, corridor = laser.hemifield_distances(ranges), laser.corridor_distances(params.laser, ranges)
    observation = Observation(**vars(response), distances=distances, corridor=corridor)
    sensed = braitenberg.sensed_distances(params.teacher, distances, corridor)
    _, label = braitenberg.step(params.teacher, state.teacher, sensed)
    decided = controller.decide(params.controller, seen, observation, POLICY)
    teacher = braitenberg.track_turn(params.teacher, decided.velocity)
    after = (decided, teacher, response, jnp.zeros_like(state.is_first))
    before = (state.controller, state.teacher, state.response, state.is_first)
    decided, teacher, response, is_first = _where(delivery.arrived, after, before)
    return replace(
        state, controller=decided, teacher=teacher, response=response, is_first=is_first, cameras=cameras,
        distances=distances, corridor=corridor, label=label,
    )  # fmt: skip


def _previous(state: State, pictures: Array) -> Array:
    """Return the previous picture; at a start the present one, so that there is no motion."""
    started = ~jnp.any(state.cameras.arrives) & state.is_first
    return jnp.where(started, pictures, state.cameras.previous)


def next_targets(params: closed_loop.Params, faults: Faults, state: State) -> tuple[State, Float[Array, "6 3"]]:
    """Advance the CPG by `INTERVAL`; return the set points [rad] that arrive at the joints."""
    moved, targets = controller.move(params.controller, state.controller, INTERVAL)
    limits = jnp.asarray(hexapod.target_limits(params.body), targets.dtype)
    servos, arrived = servo_faults.step(faults.servos, state.servos, clip(targets, *limits), INTERVAL)
    return replace(state, controller=moved, servos=servos), arrived


def restart(params: closed_loop.Params, faults: Faults, state: State, key: Array, lifted: Bool[Array, ""]) -> State:
    """Return the state after a reset if the robot was `lifted`: the initial state, except that the CPG continues."""
    started = init(params, faults, key)
    started = replace(started, controller=replace(started.controller, cpg=state.controller.cpg))
    return _where(lifted, started, state)


@jax.jit
def init_batch(params: closed_loop.Params, faults: Faults, keys: Array) -> State:
    """Return the states of a batch of robots; `faults` and `keys` have an axis of robots, `params` has none."""
    return jax.vmap(init, in_axes=(None, 0, 0))(params, faults, keys)


@jax.jit
def process_picture_batch(
    params: closed_loop.Params, faults: Faults, states: State, pictures: Array, ranges: Array
) -> State:
    """Call `process_picture` for a batch of robots."""
    return jax.vmap(process_picture, in_axes=(None, 0, 0, 0, 0))(params, faults, states, pictures, ranges)


@jax.jit
def next_targets_batch(
    params: closed_loop.Params, faults: Faults, states: State
) -> tuple[State, Float[Array, "robots 6 3"]]:
    """Call `next_targets` for a batch of robots."""
    return jax.vmap(next_targets, in_axes=(None, 0, 0))(params, faults, states)


@jax.jit
def restart_batch(
    params: closed_loop.Params, faults: Faults, states: State, keys: Array, lifted: Bool[Array, " robots"]
) -> State:
    """Call `restart` for a batch of robots."""
    return jax.vmap(restart, in_axes=(None, 0, 0, 0, 0))(params, faults, states, keys, lifted)


def _where(condition: Bool[Array, ""], chosen: Tree, otherwise: Tree) -> Tree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), chosen, otherwise)
