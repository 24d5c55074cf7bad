"""Central pattern generator (CPG): six Matsuoka oscillators, one per leg, that converge to the tripod rhythm.

Each unit is a pair of neurons, extensor and flexor, which adapt and inhibit each other. Units inhibit each other's
neurons of the same kind through the matrix W. The network's time has no physical unit, so it is integrated in scaled
time: one cycle takes `cycle_time` seconds.

| symbol     | name                       | unit      | equation |
| ---------- | -------------------------- | --------- | -------- |
| u_i        | state.activation           | 1         | 1, 3     |
| v_i        | state.adaptation           | 1         | 2, 4     |
| T_r, T_a   | reaction, adaptation time  | time unit | 1-4      |
| beta       | self_inhibition            | 1         | 1, 3     |
| w_fe       | mutual_inhibition          | 1         | 1, 3     |
| W = w_ij   | coupling                   | 1         | 1, 3     |
| c_i        | tonic                      | 1         | 1, 3     |
| g          | rectifier                  | 1         | 5        |
| CPG_i      | rhythm[i, 0]               | 1         | 6        |
| -          | rhythm[i, 1] = v_e - v_f   | 1         | -        |

Source: Cizek & Faigl, sec. 3.2; Matsuoka 1987. Three printed details are wrong and are corrected: the sign of w_fe
(`printed_sign`), the undefined r of eqs. 1 and 3 (taken as the unit's other neuron), and W, whose two weights are
swapped (`coupling`; the printed form is `within_tripod=0.40, across=0.04`).

Leg order: left front, left middle, left rear, right rear, right middle, right front. The tripods are the even legs
{0, 2, 4} and the odd legs {1, 3, 5}.

Gradient: exact almost everywhere; where an activation is exactly zero, that of the rectifier is taken as zero.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.errors import InputError
from lgmdjax.html import NotebookTable

LEGS = 6
EXTENSOR, FLEXOR = 0, 1
CYCLE_TIME = 0.8  # s: 24 camera frames
NATURAL_PERIOD = 6.6941175  # time units per cycle, for the default parameters

# (extensor, flexor) of an even leg at a point of the limit cycle of the default parameters. There the two activations
# are equal, and the extensors of the even tripod are rising. An odd leg is half a cycle away, where the pair swaps.
LIMIT_CYCLE_ACTIVATION = (0.069216745, 0.069216745)
LIMIT_CYCLE_ADAPTATION = (0.019520150, 0.116315497)


def coupling(
    within_tripod: Float[Array, ""] | float = 0.04, across: Float[Array, ""] | float = 0.40
) -> Float[Array, "6 6"]:
    """Return W (eqs. 1, 3): weak inhibition within a tripod, strong across, none of a leg on itself.

    The paper prints the two values the other way round. With those, no start converges to a tripod gait: the legs of
    one tripod settle a third of a cycle apart.

    >>> print(coupling()[0])  # on the left front leg
    [0.   0.4  0.04 0.4  0.04 0.4 ]

    Args:
        within_tripod: weight between legs of the same tripod.
        across: weight between legs of different tripods.
    """
    tripod = np.arange(LEGS) % 2
    W = jnp.where(tripod[:, None] == tripod, within_tripod, across)
    return jnp.where(np.eye(LEGS, dtype=bool), 0.0, W).astype(float)


@struct.dataclass(kw_only=True)
class Params(NotebookTable):
    """Constants of the network (paper sec. 3.2) and the time scale."""

    reaction_time: Float[Array, ""] | float = 1.7  # T_r, time units
    adaptation_time: Float[Array, ""] | float = 1.5  # T_a, time units
    self_inhibition: Float[Array, ""] | float = 7.0  # beta
    mutual_inhibition: Float[Array, ""] | float = 4.0  # w_fe; the paper prints -4
    coupling: Float[Array, "6 6"] = struct.field(default_factory=coupling)  # W
    tonic: Float[Array, "6 2"] | Float[Array, ""] | float = 1.0  # c_i; the amplitude is proportional to it
    cycle_time: Float[Array, ""] | float = CYCLE_TIME  # s per cycle; the paper gives no unit
    natural_period: Float[Array, ""] | float = NATURAL_PERIOD  # time units per cycle, as measured by `period`
    printed_sign: bool = struct.field(pytree_node=False, default=False)  # w_fe excites instead of inhibiting
    substeps: int = struct.field(pytree_node=False, default=4)  # Runge-Kutta steps per `step`


@struct.dataclass(kw_only=True)
class State:
    """Activation u and adaptation v of every neuron; column 0 is the extensor, column 1 the flexor."""

    activation: Float[Array, "6 2"]
    adaptation: Float[Array, "6 2"]


def limit_cycle_state(params: Params) -> State:
    """Return a state on the limit cycle of the default parameters, in tripod phase and scaled by the tonic drive.

    With other parameters the two tripods are still in exact antiphase, which the network preserves, and only the
    waveform has a transient. A state with all legs in phase is a solution too, but an unstable one.
    """
    u, v = (
        _in_antiphase(even_leg) * jnp.asarray(params.tonic)
        for even_leg in (LIMIT_CYCLE_ACTIVATION, LIMIT_CYCLE_ADAPTATION)
    )
    return State(activation=u, adaptation=v)


def init(params: Params, key: Array | None = None) -> State:
    """Return `limit_cycle_state`, or with a key a random state: uniform in [0, 0.2] times the tonic drive."""
    if key is None:
        return limit_cycle_state(params)
    start = jax.random.uniform(key, (2, LEGS, 2), dtype=float, maxval=0.2) * jnp.asarray(params.tonic)
    return State(activation=start[0], adaptation=start[1])


def step(params: Params, state: State, interval: Float[Array, ""] | float) -> tuple[State, Float[Array, "6 2"]]:
    """Advance the network by `interval` seconds with RK4 (eqs. 1-5); return the new state and its rhythm.

    The rectifier has a kink wherever an activation crosses zero. Over whole cycles RK4 is therefore of second order,
    not fourth. The error of period and waveform, at 180 calls per cycle:

    | substeps    | error        |
    | ----------- | ------------ |
    | 1           | 6e-5         |
    | 4 (default) | below 1e-5   |

    >>> params = Params()
    >>> state, rhythm = step(params, init(params), 1 / 30)
    >>> rhythm.shape
    (6, 2)
    """
    h = interval * params.natural_period / (params.cycle_time * params.substeps)
    for _ in range(params.substeps):
        state = _rk4_step(params, state, h)
    return state, rhythm(state)


def rhythm(state: State) -> Float[Array, "6 2"]:
    """Return each unit's output u_e - u_f (eq. 6) and its adaptation difference v_e - v_f, which the paper leaves out.

    The output alone takes each value twice a cycle. Together with the adaptation difference it traces a closed loop
    without self-intersection, by which the shaping network can distinguish stance from swing.
    """
    u, v = state.activation, state.adaptation
    return jnp.stack([u[:, EXTENSOR] - u[:, FLEXOR], v[:, EXTENSOR] - v[:, FLEXOR]], axis=1)


def derivative(params: Params, state: State) -> State:
    """Return the rates of change of activation and adaptation per time unit (eqs. 1-4)."""
    u, v = state.activation, state.adaptation
    w_fe = -params.mutual_inhibition if params.printed_sign else params.mutual_inhibition
    firing = jax.nn.relu(u)  # g, eq. 5
    inhibition = w_fe * firing[:, ::-1] + params.self_inhibition * v + params.coupling @ firing
    return State(
        activation=(params.tonic - u - inhibition) / params.reaction_time,
        adaptation=(firing - v) / params.adaptation_time,
    )


def phases(outputs: Float[np.ndarray, "steps 6"], interval: float, cycle_time: float) -> Float[np.ndarray, "6"]:
    """Return each unit's phase relative to the first [cycles, 0 to 1], measured at its last upward zero crossing.

    Host side. A unit that never crosses zero has phase NaN.

    Args:
        outputs: u_e - u_f over time.
        interval: time between steps.
        cycle_time: length of a cycle, in the unit of `interval`.
    """
    crossings = [_upward_crossings(x) for x in np.asarray(outputs).T]
    last = np.array([(times * interval)[-1:].sum() if times.size else np.nan for times in crossings])
    return ((last - last[0]) / cycle_time) % 1.0


def period(output: Float[np.ndarray, "steps"], interval: float) -> float:
    """Return the mean time between upward zero crossings of one unit's output; NaN if there are fewer than two.

    >>> round(period(np.sin(np.arange(100) / 10 * 2 * np.pi), 0.1), 6)
    1.0
    """
    crossings = _upward_crossings(np.asarray(output))
    count = len(crossings)
    return float((crossings[-1] - crossings[0]) / (count - 1) * interval) if count > 1 else math.nan


def first_upward_crossing(output: Float[np.ndarray, "steps"], interval: float) -> float:
    """Return the time of the first upward zero crossing of one unit's output; NaN if there is none."""
    crossings = _upward_crossings(np.asarray(output))
    return float(crossings[0] * interval) if len(crossings) else math.nan


def check(params: Params) -> None:
    """Raise `InputError` if a constant is not finite, not positive, or not for six legs."""
    if jnp.shape(params.coupling) != (LEGS, LEGS):
        raise InputError(f"cpg coupling: expected shape (6, 6), got {jnp.shape(params.coupling)}; give one row per leg")
    for name in ("reaction_time", "adaptation_time", "cycle_time", "natural_period"):
        if not (value := float(getattr(params, name))) > 0 or not math.isfinite(value):
            raise InputError(f"cpg {name}: expected a positive finite number, got {value}; see cpg.Params")
    for name in ("self_inhibition", "mutual_inhibition", "coupling", "tonic"):
        value = np.asarray(getattr(params, name))
        if not np.all(np.isfinite(value) & (value >= 0)):
            raise InputError(f"cpg {name}: expected finite numbers >= 0, got {value.min()}; see cpg.Params")
    if params.substeps < 1:
        raise InputError(f"cpg substeps: expected 1 or more, got {params.substeps}; the default is 4")


def _in_antiphase(even_leg: tuple[float, float]) -> Float[Array, "6 2"]:
    return jnp.asarray([even_leg, even_leg[::-1]] * (LEGS // 2), dtype=float)


# Without the checkpoint, XLA fuses the steps in reverse mode and computes the first again for each later one.
@jax.checkpoint
def _rk4_step(params: Params, state: State, h: Float[Array, ""] | float) -> State:
    """Take one classical fourth-order Runge-Kutta step of `h` time units."""

    def advanced(rate: State, time: Float[Array, ""] | float) -> State:
        return jax.tree.map(lambda x, dx: x + time * dx, state, rate)

    k1 = derivative(params, state)
    k2 = derivative(params, advanced(k1, h / 2))
    k3 = derivative(params, advanced(k2, h / 2))
    k4 = derivative(params, advanced(k3, h))
    return advanced(jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4), h)


def _upward_crossings(output: Float[np.ndarray, "steps"]) -> Float[np.ndarray, "crossings"]:
    """Return the times of upward zero crossings in steps, by linear interpolation."""
    before = np.flatnonzero((output[:-1] < 0) & (output[1:] >= 0))
    return before + output[before] / (output[before] - output[before + 1])
