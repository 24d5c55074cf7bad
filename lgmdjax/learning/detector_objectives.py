"""What a looming detector is fitted for: the nearness of obstacles on recorded walks, or approach against the rest.

| objective | loss                                                        | score, with steps as thresholds            |
| --------- | ----------------------------------------------------------- | ------------------------------------------ |
| `Walks`   | 1 - r, with r the correlation of u_left - u_right, averaged | r of whole walks                           |
|           | over a gait cycle, with the difference of 1/d               | (`detector_calibration.agreement`)         |
| `Stimuli` | mean of log(1 + exp(-(z_a - z_o) / T)) over all pairs of an | how often the largest u of an approach is  |
|           | approach a and another stimulus o                           | above that of another: the area under ROC  |

z is the largest logit of u in a clip, in standard deviations of all clips, so that the loss does not depend on the
gain, and T = `MARGIN`: a smooth form of the area under ROC.

Gradient: through whole windows of walks and whole clips, from the first frame on; of the largest response, that of its
frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree

from lgmdjax.control import controller
from lgmdjax.detectors import scaled
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, stimulus_scores
from lgmdjax.evaluation.metrics import AVERAGING_TIME
from lgmdjax.learning import detector_calibration, detector_responses
from lgmdjax.learning.detector_responses import Pictures
from lgmdjax.simulation.closed_loop import FRAME_RATE, AnyArray, Record

SETTLE = 30  # frames, first part of a window, in which the detector forgets that it began there
AVERAGED = round(AVERAGING_TIME * FRAME_RATE)  # frames
SCORED = 60  # averages of a window that are compared
FRAMES = SETTLE + AVERAGED + SCORED - 1  # of a window
MARGIN = 0.3  # T
TINY = 1e-12  # keeps the correlation of constant responses finite


@struct.dataclass(kw_only=True)
class Windows:
    """Windows of recorded walks."""

    pictures: Float[Array, "windows frames 2 height columns"]  # grey
    proximity: Float[Array, "windows scored 2"]  # 1/d [1/m]


@dataclass(frozen=True, kw_only=True)
class Walks:
    """Recorded walks with their pictures."""

    robot: controller.Params  # its eyes
    record: Record  # axes (robot, frame)
    pictures: Pictures  # grey

    def of(self, robots: Sequence[int] | np.ndarray) -> "Walks":
        """Return the walks of some of the robots."""
        record = jax.tree.map(lambda leaf: np.asarray(leaf)[robots], self.record)
        return replace(self, record=record, pictures=np.asarray(self.pictures)[robots])

    @cached_property
    def starts(self) -> tuple[np.ndarray, np.ndarray]:
        """Robot and first frame of every window in which the robot walks without contact or reset.

        Raises InputError if there is none.
        """
        walking = np.asarray(self.record.ok) & ~np.asarray(self.record.contact) & ~np.asarray(self.record.is_first)
        if walking.shape[1] >= FRAMES:
            whole = np.lib.stride_tricks.sliding_window_view(walking, FRAMES, axis=1).all(axis=-1)
            if whole.any():
                robots, firsts = np.nonzero(whole)
                return robots, firsts
        raise InputError(
            f"fit: expected {FRAMES / FRAME_RATE:.1f} s or more of walking at a stretch, got none; record longer walks"
        )

    def sample(self, windows: int, generator: np.random.Generator) -> Windows:
        """Draw windows at random."""
        robots, firsts = self.starts
        some = generator.choice(len(robots), windows)
        robots, frames = robots[some, None], firsts[some, None] + np.arange(FRAMES)
        scored = frames[:, SETTLE + AVERAGED // 2 :][:, :SCORED]
        return Windows(
            pictures=jnp.asarray(np.asarray(self.pictures)[robots, frames], float),
            proximity=jnp.asarray(1 / np.asarray(self.record.distances)[robots, scored], float),
        )

    def loss(self, params: scaled.Params, windows: Windows) -> Float[Array, ""]:
        """Return 1 - r."""
        eyes = replace(self.robot, detector=params, detector_model=scaled)
        u = jax.vmap(partial(_respond_stereo, eyes))(windows.pictures)[:, SETTLE - 1 :]
        averaged = jax.vmap(lambda side: jnp.convolve(side, jnp.full(AVERAGED, 1 / AVERAGED), "valid"))(
            u[..., 0] - u[..., 1]
        )
        return 1.0 - correlate(averaged, windows.proximity[..., 0] - windows.proximity[..., 1])

    def score(self, params: scaled.Params) -> float:
        """Return r of whole walks; 0 without a response."""
        eyes = replace(self.robot, detector=params, detector_model=scaled)
        u = np.asarray(detector_responses.respond(eyes, self.pictures, self.record.is_first).u)
        return detector_calibration.agreement(u, self.record)


def _respond_stereo(eyes: controller.Params, frames: Float[Array, "frames 2 height columns"]) -> Array:
    """Return u of both eyes for every frame after the first."""

    def step(states: PyTree, pair: Array) -> tuple[PyTree, Array]:
        states, response = controller.step_detectors(eyes, states, pair)
        return states, response.u

    return jax.lax.scan(step, controller.init_detectors(eyes, frames[0]), frames[1:])[1]


def correlate(a: Float[Array, "*shape"], b: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Return the correlation of all values; 0 if those of one are all equal."""
    a, b = a - jnp.mean(a), b - jnp.mean(b)
    return jnp.mean(a * b) / jnp.sqrt(jnp.mean(a * a) * jnp.mean(b * b) + TINY)


@dataclass(frozen=True, kw_only=True)
class Stimuli:
    """Clips of laboratory stimuli, some of which approach."""

    frames: Float[AnyArray, "clips frames height width"]  # grey
    approaches: Bool[np.ndarray, "clips"]

    def sample(self, _: np.random.Generator) -> Float[Array, "clips frames height width"]:
        """Return all clips."""
        return jnp.asarray(self.frames, float)

    def loss(self, params: scaled.Params, frames: Float[Array, "clips frames height width"]) -> Float[Array, ""]:
        """Return the mean of log(1 + exp(-(z_a - z_o) / T))."""
        largest = peaks(params, frames)
        z = (largest - jnp.mean(largest)) / jnp.sqrt(jnp.var(largest) + TINY)
        pairs = z[self.approaches][:, None] - z[~self.approaches][None]
        return jnp.mean(jax.nn.softplus(-pairs / MARGIN))

    def score(self, params: scaled.Params) -> float:
        """Return the area under ROC."""
        largest = np.asarray(peaks(params, jnp.asarray(self.frames, float)))
        return metrics.area_under_roc(largest[self.approaches], largest[~self.approaches])


@jax.jit
def peaks(params: scaled.Params, frames: Float[Array, "clips frames height width"]) -> Float[Array, "clips"]:
    """Return the largest logit of u in each clip; one clip after the other, to save memory."""

    @jax.checkpoint
    def one(clip: Float[Array, "frames height width"]) -> Float[Array, ""]:
        def step(state: PyTree, frame: Array) -> tuple[PyTree, Array]:
            state, response = scaled.step(params, state, frame)
            return state, response.u

        u = jax.lax.scan(step, scaled.init(params, clip[0]), clip[1:])[1]
        return jnp.max(scaled.logit(u[stimulus_scores.FIRST :]))

    return jax.lax.map(one, frames)
