"""Central pattern generator: six Matsuoka oscillators, one a leg, that fall into the tripod rhythm.

Each unit is a pair of neurons, extensor and flexor, that tire (adaptation) and silence each other; units
silence each other's like neurons through the matrix W. The network has no unit of time of its own, so it is
integrated in scaled time: one cycle takes `cycle_time` seconds.

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

Source: Cizek & Faigl, sec. 3.2; Matsuoka 1987. Three things printed there cannot hold and are corrected: the
sign of w_fe (`printed_sign`), the undefined r of eqs. 1 and 3 (read as the unit's other neuron), and W, whose
two weights are swapped (`coupling`, where `within_tripod=0.40, across=0.04` is the printed one).

Legs in order: left front, left middle, left rear, right rear, right middle, right front; the tripods are {0,
2, 4} and {1, 3, 5}, the even and the odd.

Gradient: exact almost everywhere; where an activation is exactly zero the rectifier's is taken as zero.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.errors import InputError

LEGS = 6
EXTENSOR, FLEXOR = 0, 1
CYCLE_TIME = 0.8  # s: 24 camera frames
NATURAL_PERIOD = 6.6941175  # time units a cycle, for the default parameters

# A point of the limit cycle of the default parameters, where the activations of a pair are equal and the even
# tripod's extensors are rising: (extensor, flexor) of an even leg; an odd leg is half a cycle away, where
# they swap.
SETTLED_ACTIVATION = (0.069216745, 0.069216745)
SETTLED_ADAPTATION = (0.019520150, 0.116315497)


def coupling(
    within_tripod: Float[Array, ""] | float = 0.04, across: Float[Array, ""] | float = 0.40
) -> Float[Array, "6 6"]:
    """Build W (eqs. 1, 3): weak inhibition inside a tripod, strong across, none of a leg on itself.

    The paper prints the two values the other way round, with which no start reaches a tripod (legs of one
    tripod then settle a third of a cycle apart).
    """
    tripod = np.arange(LEGS) % 2
    W = jnp.where(tripod[:, None] == tripod, within_tripod, across)
    return jnp.where(np.eye(LEGS, dtype=bool), 0.0, W).astype(float)


@struct.dataclass(kw_only=True)
class Params:
    """The network's constants (paper sec. 3.2), and how fast its time runs."""

    reaction_time: Float[Array, ""] | float = 1.7  # T_r, time units
    adaptation_time: Float[Array, ""] | float = 1.5  # T_a, time units
    self_inhibition: Float[Array, ""] | float = 7.0  # beta
    mutual_inhibition: Float[Array, ""] | float = 4.0  # w_fe; the paper's -4 is its printed sign
    coupling: Float[Array, "6 6"] = struct.field(default_factory=coupling)  # W
    tonic: Float[Array, "6 2"] | Float[Array, ""] | float = 1.0  # c_i; the rhythm's amplitude follows it
    cycle_time: Float[Array, ""] | float = CYCLE_TIME  # s a cycle; no unit is printed
    natural_period: Float[Array, ""] | float = NATURAL_PERIOD  # time units a cycle, `period` measures it
    printed_sign: bool = struct.field(pytree_node=False, default=False)  # excite the other neuron of the pair
    substeps: int = struct.field(pytree_node=False, default=4)  # Runge-Kutta steps in a `step`


@struct.dataclass(kw_only=True)
class State:
    """Activation u and adaptation v of every neuron; column 0 is the extensor, column 1 the flexor."""

    activation: Float[Array, "6 2"]
    adaptation: Float[Array, "6 2"]


def settled(params: Params) -> State:
    """Start on the limit cycle of the default parameters, in the tripod already, scaled by the drive.

    With other parameters it is still a state of exact antiphase, which the network keeps, and only the
    waveform has a transient. A symmetric start would not do: all legs in step is a solution as well, though
    an unstable one.
    """
    u, v = (_in_antiphase(even) * jnp.asarray(params.tonic) for even in (SETTLED_ACTIVATION, SETTLED_ADAPTATION))
    return State(activation=u, adaptation=v)


def init(params: Params, key: Array | None = None) -> State:
    """Start settled, or, if a key is given, with every neuron at random in [0, 0.2] times its drive."""
    if key is None:
        return settled(params)
    start = jax.random.uniform(key, (2, LEGS, 2), dtype=float, maxval=0.2) * jnp.asarray(params.tonic)
    return State(activation=start[0], adaptation=start[1])


def step(params: Params, state: State, interval: Float[Array, ""] | float) -> tuple[State, Float[Array, "6 2"]]:
    """Advance the network by `interval` seconds with RK4 (eqs. 1-5); return its state and the rhythm there.

    The rectifier bends each neuron's course wherever its activation crosses zero, so over whole cycles RK4 is
    of second order, not fourth; `substeps` equal steps inside the interval keep the error of period and
    waveform below 1e-5 at 180 steps a cycle (a single one: 6e-5).
    """
    h = interval * params.natural_period / (params.cycle_time * params.substeps)
    for _ in range(params.substeps):
        state = _runge_kutta(params, state, h)
    return state, rhythm(state)


def rhythm(state: State) -> Float[Array, "6 2"]:
    """Read each unit's output u_e - u_f (eq. 6) and adaptation difference v_e - v_f, left out in the paper.

    The output alone passes each value twice a cycle; with the adaptation the pair is a closed loop without
    crossing, from which the shaping network can tell stance from swing.
    """
    u, v = state.activation, state.adaptation
    return jnp.stack([u[:, EXTENSOR] - u[:, FLEXOR], v[:, EXTENSOR] - v[:, FLEXOR]], axis=1)


def derivative(params: Params, state: State) -> State:
    """Evaluate eqs. 1-4: the rates of activation and adaptation a time unit."""
    u, v = state.activation, state.adaptation
    w_fe = -params.mutual_inhibition if params.printed_sign else params.mutual_inhibition
    fired = jax.nn.relu(u)  # g, eq. 5
    inhibition = w_fe * fired[:, ::-1] + params.self_inhibition * v + params.coupling @ fired
    return State(
        activation=(params.tonic - u - inhibition) / params.reaction_time,
        adaptation=(fired - v) / params.adaptation_time,
    )


def phases(outputs: Float[np.ndarray, "steps 6"], interval: float, cycle: float) -> Float[np.ndarray, "6"]:
    """Measure each unit's phase in cycles, [0, 1), relative to the first, by its last upward zero crossing.

    Host side. A unit that never crosses zero has phase NaN.

    Args:
        outputs: u_e - u_f over time, steps `interval` apart.
        interval: time between steps.
        cycle: length of a cycle, in the unit of `interval`.
    """
    last = np.array([(_rises(x) * interval)[-1:].sum() if _rises(x).size else np.nan for x in np.asarray(outputs).T])
    return ((last - last[0]) / cycle) % 1.0


def period(outputs: Float[np.ndarray, "steps"], interval: float) -> float:
    """Measure the mean time between upward zero crossings of one unit's output; NaN if it has less than two."""
    rises = _rises(np.asarray(outputs))
    return float((rises[-1] - rises[0]) / (len(rises) - 1) * interval) if len(rises) > 1 else math.nan


def first_rise(output: Float[np.ndarray, "steps"], interval: float) -> float:
    """Find the time of one unit's first upward zero crossing; NaN if there is none."""
    rises = _rises(np.asarray(output))
    return float(rises[0] * interval) if len(rises) else math.nan


def check(params: Params) -> None:
    """Raise `InputError` if a constant is not finite, not positive, or of another number of legs."""
    if jnp.shape(params.coupling) != (LEGS, LEGS):
        raise InputError(f"cpg coupling: expected shape (6, 6), got {jnp.shape(params.coupling)}; give a row a leg")
    for name in ("reaction_time", "adaptation_time", "cycle_time", "natural_period"):
        if not (value := float(getattr(params, name))) > 0 or not math.isfinite(value):
            raise InputError(f"cpg {name}: expected a positive finite number, got {value}; see cpg.Params")
    for name in ("self_inhibition", "mutual_inhibition", "coupling", "tonic"):
        value = np.asarray(getattr(params, name))
        if not np.all(np.isfinite(value) & (value >= 0)):
            raise InputError(f"cpg {name}: expected finite numbers >= 0, got {value.min()}; see cpg.Params")
    if params.substeps < 1:
        raise InputError(f"cpg substeps: expected 1 or more, got {params.substeps}; the default is 4")


def _in_antiphase(even: tuple[float, float]) -> Float[Array, "6 2"]:
    return jnp.asarray([even, even[::-1]] * (LEGS // 2), dtype=float)


@jax.checkpoint  # in reverse mode XLA otherwise merges the steps, and computes the first anew for each that follows
def _runge_kutta(params: Params, state: State, h: Float[Array, ""] | float) -> State:
    """Take one classical fourth-order step of `h` time units."""

    def moved(rate: State, time: Float[Array, ""] | float) -> State:
        return jax.tree.map(lambda x, dx: x + time * dx, state, rate)

    k1 = derivative(params, state)
    k2 = derivative(params, moved(k1, h / 2))
    k3 = derivative(params, moved(k2, h / 2))
    k4 = derivative(params, moved(k3, h))
    return moved(jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4), h)


def _rises(output: Float[np.ndarray, "steps"]) -> Float[np.ndarray, "crossings"]:
    """Find upward zero crossings, in steps, by linear interpolation."""
    before = np.flatnonzero((output[:-1] < 0) & (output[1:] >= 0))
    return before + output[before] / (output[before] - output[before + 1])
