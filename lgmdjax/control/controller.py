"""The robot's controller: stereo frame in, eighteen joint targets out.

Two looming detectors process the two hemifields, a policy turns their outputs into a left and right velocity, and the
output of the CPG, shaped for that velocity, becomes joint angles. There are two rates: `detect` and `decide` run once
per camera frame, `move` once per physics substep. `step` composes them for a robot whose only sensor is the camera.

The policy is an argument (`lgmdjax.control.policies`), so that the learned navigator and the policies that it is
compared with share the same detectors and gait. The detector is a part of the parameters: any module or object with the
interface of `lgmdjax.detectors.protocol`, the paper's LGMD by default.

| symbol | name          | unit              | equation |
| ------ | ------------- | ----------------- | -------- |
| L      | frames        | grey, 0..255      | 7        |
| u      | response.u    | 1, 0.5..1         | 14, 16   |
| v      | velocity      | nominal, 0.05 m/s | 17       |

Source: Cizek & Faigl, "Self-supervised learning of the biologically-inspired obstacle avoidance of hexapod
walking robot", fig. 2 and sec. 3.
"""

from copy import deepcopy
from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, PyTree, UInt8

from lgmdjax.control.policies import Observation, Policy
from lgmdjax.detectors import cells, lgmd, protocol
from lgmdjax.detectors.protocol import Detector
from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.sensors import hemifield

Frames = Float[Array, "2 height width"] | UInt8[Array, "2 height width"]
"""Images of the left and the right eye (`cells.Frame`)."""


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """All parameters between camera and servos that can be differentiated, and the detector that they are for."""

    detector: PyTree  # of the type that `detector_model` takes
    policy: PyTree  # of the type that the policy takes
    cpg: cpg.Params
    shaping: shaping.Params
    detector_model: Detector = struct.field(pytree_node=False, default=lgmd)  # of both eyes; hashable, as modules are

    def __deepcopy__(self, memo: dict[int, object]) -> "Params":
        """Copy the arrays; the detector, a module that Python cannot copy, is the same."""
        return jax.tree.map(lambda leaf: deepcopy(leaf, memo), self)


@struct.dataclass(kw_only=True)
class State:
    """States of detectors, policy and CPG, and the velocity commanded last."""

    detector: PyTree  # of both eyes, stacked
    policy: PyTree
    cpg: cpg.State
    velocity: Float[Array, "2"]


@struct.dataclass(kw_only=True)
class Response:
    """What a policy may use of both detectors' responses, left first."""

    u: Float[Array, "2"]
    feed_forward: Float[Array, "2"]  # zero for a detector without
    excitation: Float[Array, "2"]


def init(params: Params, frames: Frames, policy: Policy, key: Array) -> State:
    """Return the state at a first stereo frame: zero velocity, and the CPG on its limit cycle."""
    return State(
        detector=init_detectors(params, frames),
        policy=policy.init(params.policy, key),
        cpg=cpg.limit_cycle_state(params.cpg),
        velocity=jnp.zeros(2),
    )


def init_detectors(params: Params, frames: Frames) -> PyTree:
    """Return the states of both detectors at a first stereo frame, so that their first frame difference is zero."""
    return jax.vmap(params.detector_model.init, in_axes=(None, 0))(params.detector, hemifield.outermost_first(frames))


def rest(dtype: DTypeLike = float) -> Response:
    """Return the response of both detectors before they see anything."""
    return Response(
        u=jnp.full(2, cells.U_AT_REST, dtype), feed_forward=jnp.zeros(2, dtype), excitation=jnp.zeros(2, dtype)
    )


def step_detectors(params: Params, states: PyTree, frames: Frames) -> tuple[PyTree, Response]:
    """Return the next states of both detectors, and their responses to a stereo frame (eqs. 7-16)."""

    def step(state: PyTree, frame: Array) -> tuple[PyTree, tuple[Array, Array, Array]]:
        state, own = params.detector_model.step(params.detector, state, frame)
        return state, (own.u, getattr(own, "feed_forward", jnp.zeros_like(own.u)), own.excitation)

    states, (u, feed_forward, excitation) = jax.vmap(step)(states, hemifield.outermost_first(frames))
    return states, Response(u=u, feed_forward=feed_forward, excitation=excitation)


def restart_detectors(params: Params, states: PyTree, frames: Frames, is_first: Bool[Array, ""]) -> PyTree:
    """Return the states of both detectors before a stereo frame: those of `init_detectors` for a first one."""
    started = init_detectors(params, frames)
    return jax.tree.map(lambda new, old: jnp.where(is_first, new, old), started, states)


def detect(params: Params, state: State, frames: Frames) -> tuple[State, Response]:
    """Step both detectors by one stereo frame; the response has one entry for each eye, left first."""
    states, response = step_detectors(params, state.detector, frames)
    return replace(state, detector=states), response


def detect_or_start(params: Params, state: State, frames: Frames, is_first: Bool[Array, ""]) -> tuple[State, Response]:
    """Step both detectors as `detect` does; a first frame starts from the states of `init_detectors`."""
    before = restart_detectors(params, state.detector, frames, is_first)
    return detect(params, replace(state, detector=before), frames)


def require_lgmd(params: Params, purpose: str) -> lgmd.Params:
    """Return the parameters of the LGMD; raise `InputError` for a robot with another detector.

    Args:
        params: of the controller.
        purpose: what needs the LGMD, as "the export to C".
    """
    if params.detector_model is not lgmd:
        raise InputError(
            f"expected a robot with the detector {protocol.name(lgmd)} for {purpose}, got one with "
            f"{protocol.name(params.detector_model)}; only the LGMD is supported there"
        )
    return params.detector


def observe_without_laser(response: Response) -> Observation:
    """Return the observation of a robot without a laser scanner: distances are zero, so no policy may need them."""
    return Observation(
        u=response.u,
        feed_forward=response.feed_forward,
        excitation=response.excitation,
        distances=jnp.zeros(2),
        corridor=jnp.zeros(2),
    )


def decide(params: Params, state: State, observation: Observation, policy: Policy) -> State:
    """Let the policy choose the velocity for an observation (eq. 17)."""
    policy_state, velocity = policy.step(params.policy, state.policy, observation)
    return replace(state, policy=policy_state, velocity=velocity)


def move(params: Params, state: State, interval: float) -> tuple[State, Float[Array, "6 3"]]:
    """Step the CPG by `interval` seconds and shape its output into joint targets [rad] for the commanded velocity."""
    cpg_state, rhythm = cpg.step(params.cpg, state.cpg, interval)
    targets = shaping.apply(params.shaping, rhythm, state.velocity)
    return replace(state, cpg=cpg_state), targets


def step(
    params: Params, state: State, frames: Frames, policy: Policy, interval: float
) -> tuple[State, Float[Array, "6 3"]]:
    """Turn one stereo frame into joint targets [rad]: detect, decide, move (`observe_without_laser`)."""
    state, response = detect(params, state, frames)
    state = decide(params, state, observe_without_laser(response), policy)
    return move(params, state, interval)
