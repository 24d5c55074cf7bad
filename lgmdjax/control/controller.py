"""The robot's nervous system: stereo frame in, eighteen joint targets out.

Two LGMDs look at the two hemifields, a driver turns what they say into a velocity for either side, and
the rhythm of the CPG, shaped for that velocity, becomes joint angles. The three parts run at two beats:
`see` and the driver once a camera frame, `move` once a physics substep. `step` composes them as they run
on a robot with nothing but a camera.

The driver is an argument (`lgmdjax.control.policies`), since the same eyes and legs serve the learned navigator and
everything that it is compared with.

| symbol | name          | unit              | equation |
| ------ | ------------- | ----------------- | -------- |
| L      | frames        | grey, 0..255      | 7        |
| u      | response.u    | 1, 0.5..1         | 14, 16   |
| v      | velocity      | nominal, 0.05 m/s | 17       |

Source: Cizek & Faigl, "Self-supervised learning of the biologically-inspired obstacle avoidance of hexapod
walking robot", fig. 2 and sec. 3.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.control.policies import Driver, Senses
from lgmdjax.detectors import lgmd
from lgmdjax.locomotion import cpg, shaping


@struct.dataclass(kw_only=True)
class Params:
    """Everything between the eyes and the servos that a gradient can reach."""

    lgmd: lgmd.Params
    driver: Any  # the parameters of whichever driver is at the wheel
    cpg: cpg.Params
    shaping: shaping.Params


@struct.dataclass(kw_only=True)
class State:
    """What the eyes, the driver and the rhythm carry from beat to beat; `velocity` is the standing command."""

    lgmd: lgmd.State  # two eyes, stacked
    driver: Any
    cpg: cpg.State
    velocity: Float[Array, "2"]


def init(params: Params, frames: Float[Array, "2 height width"], driver: Driver, key: Array) -> State:
    """Start with the first stereo frame as the picture to compare with, the rhythm settled, and standing still."""
    return State(
        lgmd=open_eyes(params, frames),
        driver=driver.init(params.driver, key),
        cpg=cpg.settled(params.cpg),
        velocity=jnp.zeros(2),
    )


def open_eyes(params: Params, frames: Float[Array, "2 height width"]) -> lgmd.State:
    """Start both LGMDs on one stereo frame, so that the first difference they see is zero."""
    return jax.vmap(lgmd.init, in_axes=(None, 0))(params.lgmd, frames)


def see(params: Params, state: State, frames: Float[Array, "2 height width"]) -> tuple[State, lgmd.Response]:
    """Show one stereo frame to the two LGMDs (eqs. 7-16); the response has one entry an eye, left first."""
    eyes, response = jax.vmap(lgmd.step, in_axes=(None, 0, 0))(params.lgmd, state.lgmd, frames)
    return replace(state, lgmd=eyes), response


def decide(params: Params, state: State, senses: Senses, driver: Driver) -> State:
    """Let the driver turn the senses into the standing command (eq. 17)."""
    driven, velocity = driver.step(params.driver, state.driver, senses)
    return replace(state, driver=driven, velocity=velocity)


def move(params: Params, state: State, interval: float) -> tuple[State, Float[Array, "6 3"]]:
    """Advance the rhythm by `interval` seconds and shape it into joint targets [rad] for the standing command."""
    rhythm_state, rhythm = cpg.step(params.cpg, state.cpg, interval)
    targets = shaping.shape(params.shaping, rhythm, state.velocity)
    return replace(state, cpg=rhythm_state), targets


def step(
    params: Params, state: State, frames: Float[Array, "2 height width"], driver: Driver, interval: float
) -> tuple[State, Float[Array, "6 3"]]:
    """Turn one stereo frame into joint targets: see, decide, move, for a driver that needs only the eyes.

    A robot without a laser has no distances; the senses then hold zeros there.
    """
    state, response = see(params, state, frames)
    senses = Senses(
        u=response.u,
        feed_forward=response.feed_forward,
        excitation=response.excitation,
        distances=jnp.zeros(2),
    )
    state = decide(params, state, senses, driver)
    return move(params, state, interval)
