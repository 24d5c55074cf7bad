"""The robot's controller: stereo frame in, eighteen joint targets out.

Two LGMDs process the two hemifields, a policy turns their outputs into a left and right velocity, and the output of
the CPG, shaped for that velocity, becomes joint angles. There are two rates: `detect` and `decide` run once per camera
frame, `move` once per physics substep. `step` composes them for a robot whose only sensor is the camera.

The policy is an argument (`lgmdjax.control.policies`), so that the learned navigator and the policies that it is
compared with share the same detectors and gait.

| symbol | name          | unit              | equation |
| ------ | ------------- | ----------------- | -------- |
| L      | frames        | grey, 0..255      | 7        |
| u      | response.u    | 1, 0.5..1         | 14, 16   |
| v      | velocity      | nominal, 0.05 m/s | 17       |

Source: Cizek & Faigl, "Self-supervised learning of the biologically-inspired obstacle avoidance of hexapod
walking robot", fig. 2 and sec. 3.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree, UInt8

from lgmdjax.control.policies import Observation, Policy
from lgmdjax.detectors import lgmd
from lgmdjax.html import NotebookTable
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.sensors import hemifield

Frames = Float[Array, "2 height width"] | UInt8[Array, "2 height width"]
"""Images of the left and the right eye (`cells.Frame`)."""


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """All parameters between camera and servos that can be differentiated."""

    lgmd: lgmd.Params
    policy: PyTree  # of the type that the policy takes
    cpg: cpg.Params
    shaping: shaping.Params


@struct.dataclass(kw_only=True)
class State:
    """States of detectors, policy and CPG, and the velocity commanded last."""

    lgmd: lgmd.State  # of both eyes, stacked
    policy: PyTree
    cpg: cpg.State
    velocity: Float[Array, "2"]


def init(params: Params, frames: Frames, policy: Policy, key: Array) -> State:
    """Return the state at a first stereo frame: zero velocity, and the CPG on its limit cycle."""
    return State(
        lgmd=init_lgmd(params, frames),
        policy=policy.init(params.policy, key),
        cpg=cpg.limit_cycle_state(params.cpg),
        velocity=jnp.zeros(2),
    )


def init_lgmd(params: Params, frames: Frames) -> lgmd.State:
    """Return the states of both LGMDs at a first stereo frame, so that their first frame difference is zero."""
    return jax.vmap(lgmd.init, in_axes=(None, 0))(params.lgmd, hemifield.outermost_first(frames))


def detect(params: Params, state: State, frames: Frames) -> tuple[State, lgmd.Response]:
    """Step both LGMDs by one stereo frame (eqs. 7-16); the response has one entry for each eye, left first."""
    frames = hemifield.outermost_first(frames)
    lgmd_state, response = jax.vmap(lgmd.step, in_axes=(None, 0, 0))(params.lgmd, state.lgmd, frames)
    return replace(state, lgmd=lgmd_state), response


def detect_or_start(
    params: Params, state: State, frames: Frames, is_first: Bool[Array, ""]
) -> tuple[State, lgmd.Response]:
    """Step both LGMDs as `detect` does; a first frame starts from the states of `init_lgmd`."""
    started = init_lgmd(params, frames)
    before = jax.tree.map(lambda new, old: jnp.where(is_first, new, old), started, state.lgmd)
    return detect(params, replace(state, lgmd=before), frames)


def observe_without_laser(response: lgmd.Response) -> Observation:
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
