"""Alarm of a looming detector: the response on a scale that adapts to the scene, a threshold, and a minimum duration.

A detector's own u measures how much moves. In a street it is near 1 all the time, in a laboratory near 0.5. An approach
shows in both as a rise of the excitation: over some tenths of a second it exceeds its mean over the last seconds.

| symbol    | name                       | unit   | equation                                                       |
| --------- | -------------------------- | ------ | -------------------------------------------------------------- |
| E_f       | inputs.excitation          | any    | of the detector                                                |
| P_f       | -                          | grey   | change of the frame, averaged over blocks of its width / 16    |
| M_f       | -                          | grey   | mean of |P_f|                                                  |
| D_f       | -                          | grey   | median of P_f: the change that the whole field has in common   |
| <x>_tau   | -                          | as x   | running mean of x with the time constant tau                   |
| w_f       | response.whole_field       | 0..1   | min(|<D>_fast| / <M>_fast, 1)                                  |
| e_f       | -                          | any    | (1 - w_f) E_f                                                  |
| A_f       | response.adapted           | 0..1   | <e>_fast / (<e>_fast + <e>_slow)                               |
| h_f       | state.time_above_threshold | s      | h_{f-1} + dt where A_f >= threshold, else 0                    |
| -         | response.alarm             | 0, 1   | 1 where h_f >= persistence, and at least one frame             |
| dt        | frame_time                 | s      | -                                                              |

A is 1/2 where the excitation is constant, 2/3 where it has doubled, 3/4 where it has tripled: the logistic function of
ln(<e>_fast / <e>_slow). It is 1/2 before anything has moved. Four points:

- Running means start at their first value (they are divided by the sum of the weights so far), so scenery that moves
  from the first frame on is not a rise.
- Frames in which nothing changes, such as repeated frames or those before a stimulus, are left out of all means: they
  tell nothing about the scale of motion. So A is constant while the picture stands still, and an alarm lasts until
  something moves again.
- A change of light changes the whole field alike. Feed-forward inhibition w, from the median, removes it. An object
  shifts the median only if it covers half of the field.
- Division by a running mean is the gain control of photoreceptors and of normalisation models (Heeger 1992). The median
  as feed-forward inhibition is ours. Its form and the constants were chosen by the area under ROC on the ten public
  clips of `docs/detectors.md`. Results on these clips are therefore optimistic.

Gradient: exact almost everywhere; zero for threshold and persistence, which are steps.
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import Cells, Scalar, pool
from lgmdjax.errors import InputError

BLOCKS = 16  # in a row of the frame, whose changes are compared
GAP = 0.5  # s; alarms with a shorter gap between them count as one
STILL = 1e-3  # grey, mean change below which nothing has moved


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the alarm."""

    fast: Scalar = 0.3  # s
    slow: Scalar = 3.0  # s
    threshold: Scalar = 0.6  # of A: half as much again as in the last seconds
    persistence: Scalar = 0.1  # s
    frame_time: Scalar = 1 / 30  # dt, s


@struct.dataclass(kw_only=True)
class RunningMean:
    """A weighted sum of values, and the sum of their weights."""

    total: Scalar
    weight: Scalar

    @property
    def value(self) -> Array:
        """Mean of the values; 0 before the first."""
        weight = jnp.asarray(self.weight)
        return jnp.where(weight > 0, self.total / jnp.where(weight > 0, weight, 1.0), 0.0)


@struct.dataclass(kw_only=True)
class State:
    """The last frame in blocks, four running means, and how long A has been above the threshold."""

    blocks: Cells
    change: RunningMean  # of M
    shift: RunningMean  # of D
    fast: RunningMean  # of e
    slow: RunningMean  # of e
    time_above_threshold: Scalar  # h, s


@struct.dataclass(kw_only=True)
class AlarmInput:
    """A frame, and the excitation of the detector in it."""

    frame: Float[Array, "height width"]  # grey levels 0..255
    excitation: Scalar  # E, zero or more


@struct.dataclass(kw_only=True)
class Response:
    """Adapted response to one frame, and whether there is an alarm."""

    adapted: Float[Array, ""]  # A
    whole_field: Float[Array, ""]  # w
    alarm: Float[Array, ""]  # 0 or 1


def check(params: Params) -> None:
    """Raise `InputError` for constants with which there would never or always be an alarm."""
    if not 0.5 < float(params.threshold) < 1:
        raise InputError(
            f"alarm threshold: expected more than 0.5 (no rise) and less than 1, got {params.threshold}; "
            "0.6 is half as much again as in the last seconds"
        )
    if not 0 <= float(params.persistence) <= 10:
        raise InputError(f"alarm persistence: expected 0 to 10 s, got {params.persistence}; 0.1 is usual")


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    blocks = _blocks(frame)
    zero = jnp.zeros((), blocks.dtype)
    nothing = RunningMean(total=zero, weight=zero)
    return State(blocks=blocks, change=nothing, shift=nothing, fast=nothing, slow=nothing, time_above_threshold=zero)


def step(params: Params, state: State, inputs: AlarmInput) -> tuple[State, Response]:
    """Process the next frame.

    >>> state = init(Params(), jnp.zeros((12, 16)))
    >>> inputs = AlarmInput(frame=jnp.zeros((12, 16)), excitation=jnp.asarray(0.0))
    >>> _, response = step(Params(), state, inputs)
    >>> float(response.adapted), float(response.alarm)
    (0.5, 0.0)
    """
    blocks = _blocks(inputs.frame)
    P = blocks - state.blocks
    M, D = jnp.mean(jnp.abs(P)), jnp.median(P)
    moved = jnp.where(M > STILL, jnp.ones_like(M), jnp.zeros_like(M))
    gain_fast, gain_slow = (moved * (1.0 - jnp.exp(-params.frame_time / tau)) for tau in (params.fast, params.slow))
    change, shift = _update(state.change, M, gain_fast), _update(state.shift, D, gain_fast)
    w = _ratio(jnp.abs(shift.value), change.value, 0.0)
    w = jnp.where(w < 1, w, jnp.ones_like(w))
    e = (1.0 - w) * jnp.asarray(inputs.excitation, blocks.dtype)
    fast, slow = _update(state.fast, e, gain_fast), _update(state.slow, e, gain_slow)
    A = _ratio(fast.value, fast.value + slow.value, 0.5)
    h = jnp.where(params.threshold <= A, state.time_above_threshold + params.frame_time, jnp.zeros_like(A))
    is_alarm = (h > 0) & (h >= params.persistence - 0.5 * params.frame_time)
    alarm = jnp.where(is_alarm, jnp.ones_like(A), jnp.zeros_like(A))
    after = State(blocks=blocks, change=change, shift=shift, fast=fast, slow=slow, time_above_threshold=h)
    return after, Response(adapted=A, whole_field=w, alarm=alarm)


def required_frames(persistence: float, frame_time: float) -> int:
    """Return how many frames in a row have to be above the threshold.

    >>> required_frames(0.1, 1 / 30), required_frames(0.0, 1 / 30)
    (3, 1)
    """
    return max(round(persistence / frame_time), 1)


def _blocks(frame: Float[Array, "height width"]) -> Cells:
    return pool(frame, max(round(frame.shape[1] / BLOCKS), 1))


def _update(mean: RunningMean, value: Array, gain: Array) -> RunningMean:
    return RunningMean(total=mean.total + gain * (value - mean.total), weight=mean.weight + gain * (1.0 - mean.weight))


def _ratio(part: Array, whole: Array, otherwise: float) -> Array:
    """Return part / whole, and `otherwise` where the whole is zero."""
    return jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1.0), jnp.full_like(whole, otherwise))
