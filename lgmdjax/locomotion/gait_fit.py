"""Gradient-based fit of the shaping networks to the regular tripod gait, over one cycle of the rhythm.

The inputs are those of the networks in use, the CPG's limit cycle and a velocity. The targets are those of
`lgmdjax.locomotion.tripod_gait`. The loss does not measure joint angles but the positions of the feet that follow from
them, and the resulting motion of the trunk.

Source: Cizek & Faigl, sec. 3.2, which gives no loss and no settings; these are ours.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from lgmdjax.locomotion import cpg, kinematics, shaping, tripod_gait
from lgmdjax.locomotion.kinematics import LegGeometry
from lgmdjax.locomotion.tripod_gait import Gait
from lgmdjax.runtime import tracking

# Velocities and their weights in the loss. Walking backward is for turning and needs less accuracy.
VELOCITIES = (-1.0, -0.6, -0.2, 0.2, 0.5, 0.8, 1.0, 1.2, 1.4, 1.7, 2.0)
VELOCITY_WEIGHTS = (0.5, 0.5, 0.5, 0.7, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
PHASES = 48  # points of the cycle
SWING_WEIGHT = 0.15  # of an error of a foot high above the floor, relative to one in stance
SKIM_HEIGHT = 0.006  # m; below about this a swinging foot has the weight of stance, since floor and legs are compliant
STRIDE_WEIGHT = 10.0  # of an error in half the stride [mm], divided by v; it determines the speed
SWAY_WEIGHT = 0.2  # of the trunk's motion [mm or mrad per radian of phase]

ADAM = optax.scale_by_adam()


class _Demonstrations(NamedTuple):
    """Inputs and targets of the left legs' networks over the cycle and the velocities, with weights of errors."""

    inputs: Float[Array, "phases velocities 3"]  # scaled to order one
    scale: Float[Array, "3"]
    targets: Float[Array, "phases velocities 3 3"]  # rad; front, middle, rear
    feet: Float[Array, "phases velocities 3 3"]  # m, positions that follow from the targets
    stance: Float[Array, "phases"]  # 1 in stance
    weight: Float[Array, "phases velocities"]  # per millimetre
    stride: Float[Array, "phases velocities"]  # weights by which errors in x sum to that of half a stride
    trunk: Float[Array, "6 9"]  # its motion from the errors of left front, right middle and left rear foot


class _Networks(NamedTuple):
    """The left legs' networks on scaled inputs."""

    w1: Float[Array, "*candidates 3 3 6"]
    b1: Float[Array, "*candidates 3 6"]
    w2: Float[Array, "*candidates 3 6 3"]
    b2: Float[Array, "*candidates 3 3"]


class _Problem(NamedTuple):
    """What the losses depend on, besides the networks."""

    left: LegGeometry
    demonstrations: _Demonstrations


class _FitState(NamedTuple):
    """Networks and the state of their optimiser."""

    networks: _Networks
    optimiser: optax.OptState


class _Span(NamedTuple):
    """Steps `first` to `end` (exclusive) of `total`, at an initial learning rate."""

    learning_rate: Float[Array, ""]
    first: Float[Array, ""]
    end: Float[Array, ""]
    total: Float[Array, ""]


_Carry = tuple[_FitState, Float[Array, ""], Float[Array, ""]]  # with loss and step
_Loss = Callable[[_Networks, _Problem], Float[Array, ""]]
Progress = Callable[[int, float], None]
"""Called with the steps done and the loss [mm^2]."""


def fit(
    geometry: LegGeometry,
    gait: Gait | None = None,
    cpg_params: cpg.Params | None = None,
    *,
    key: Array | None = None,
    steps: int = 6000,
    candidates: int = 32,
    printed_input: bool = False,
    progress: Progress | None = None,
) -> shaping.Params:
    """Fit the six shaping networks to the gait on the CPG's limit cycle, by gradient (Adam); return them.

    Host side; half a minute on two cores. Three networks are fitted and mirrored, so that the robot is symmetric. In
    the first eighth of the steps each leg has `candidates` random initialisations, whose loss is the error of the
    foot. In the remaining steps the best candidates of the three legs are fitted together, and the loss also includes
    their effect on the trunk: its sway and speed.

    Args:
        geometry: of the robot's legs.
        gait: the gait to fit.
        cpg_params: of the CPG whose rhythm is the networks' input; its cycle time has no effect.
        key: random key of the initialisations.
        steps: total steps of the optimiser.
        candidates: number of initialisations per leg.
        printed_input: leave out the adaptation difference, as the paper does; the robot then hardly walks.
        progress: called every hundred steps.
    """
    name = "shaping, printed input" if printed_input else "shaping"

    def report(done: int, loss: Float[Array, ""]) -> None:
        if progress:
            progress(done, float(loss))
        if tracking.has_listener():
            tracking.log(done, {f"{name}/loss_mm2": float(loss)})

    demonstrations = _demonstrations(geometry, gait or Gait(), cpg_params or cpg.Params(), printed_input)
    keys = jax.random.split(jax.random.key(0) if key is None else key, (candidates, 3))
    networks = _initial_networks(demonstrations.inputs, demonstrations.targets, keys)
    problem = _Problem(kinematics.left_legs(geometry), demonstrations)
    search_steps = steps // 8
    networks = _minimise(_candidates_loss, networks, problem, 0.01, range(search_steps), report=report)
    networks = _best_candidates(networks, problem)
    networks = _minimise(_robot_loss, networks, problem, 0.005, range(search_steps, steps), report=report)
    return _mirrored(networks, demonstrations, printed_input)


def limit_cycle_rhythm(cpg_params: cpg.Params, phases: Float[np.ndarray, "phases"]) -> Float[np.ndarray, "phases 2"]:
    """Return the rhythm of a unit on the limit cycle at given phases; 0 is its upward zero crossing. Host side.

    >>> rhythm = limit_cycle_rhythm(cpg.Params(), np.array([0.0, 0.25]))
    >>> print(rhythm[:, 0].round(2))
    [0.   0.53]
    """
    steps = 400  # per cycle
    interval = cpg_params.cycle_time / steps
    state, _ = jax.lax.scan(
        lambda s, _: (cpg.step(cpg_params, s, interval)[0], None), cpg.limit_cycle_state(cpg_params), length=40 * steps
    )
    _, rhythm = jax.lax.scan(lambda s, _: cpg.step(cpg_params, s, interval), state, length=4 * steps)
    unit = np.asarray(rhythm[:, 0])
    start, cycle = cpg.first_upward_crossing(unit[:, 0], 1.0), cpg.period(unit[:, 0], 1.0)
    at = start + np.asarray(phases) * cycle
    return np.stack([np.interp(at, np.arange(len(unit)), unit[:, i]) for i in range(2)], axis=1)


def _demonstrations(geometry: LegGeometry, gait: Gait, cpg_params: cpg.Params, printed_input: bool) -> _Demonstrations:
    """Evaluate the gait of the left legs over one cycle of the rhythm at every velocity."""
    phases = np.arange(PHASES) / PHASES
    rhythm = limit_cycle_rhythm(cpg_params, phases) * np.array([1.0, 0.0 if printed_input else 1.0])
    velocities, velocity_weights = np.array(VELOCITIES), np.array(VELOCITY_WEIGHTS)
    grid = (PHASES, len(velocities))
    inputs = np.concatenate(
        [np.broadcast_to(rhythm[:, None], (*grid, 2)), np.broadcast_to(velocities[None, :, None], (*grid, 1))], axis=2
    )
    scale = np.maximum(np.abs(inputs).max((0, 1)) * np.array([0.7, 0.7, 0.5]), 1e-6)
    # Compiled as one program: operation by operation, compilation would take longer than everything else here.
    angles = jax.jit(partial(tripod_gait.joint_targets, geometry, gait))(
        jnp.broadcast_to(jnp.asarray(phases, dtype=float)[:, None, None], (*grid, 6)),
        jnp.broadcast_to(jnp.asarray(velocities, dtype=float)[None, :, None], (*grid, 6)),
    )
    duty_factor = float(gait.duty_factor)
    stance = (phases < duty_factor).astype(float)
    height = np.asarray(tripod_gait.foot_path(gait, jnp.asarray(phases, dtype=float), jnp.zeros(PHASES))[:, 2])
    along = (phases - duty_factor / 2) * stance
    relative = velocity_weights / np.maximum(np.abs(velocities), 0.4)
    fields = dict(
        inputs=inputs / scale,
        scale=scale,
        targets=angles[:, :, :3],
        feet=jax.jit(kinematics.forward)(geometry, angles)[:, :, :3],
        stance=stance,
        weight=np.outer(SWING_WEIGHT + (1 - SWING_WEIGHT) * np.exp(-height / SKIM_HEIGHT), velocity_weights)
        / np.sqrt(3 * stance.sum() * len(velocities)),
        stride=np.outer(along / (along @ along) * duty_factor / 2, relative) / np.sqrt(3 * len(velocities)),
        trunk=_trunk_motion(gait),
    )
    return _Demonstrations(**{name: jnp.asarray(values, dtype=float) for name, values in fields.items()})


def _trunk_motion(gait: Gait) -> Float[np.ndarray, "6 9"]:
    """Return the least-squares map from foot errors of a tripod (left front, right middle, left rear) to trunk motion.

    The motion is three translations and three rotations.
    """
    height = -float(gait.body_height)
    rows = []
    for x, y in np.asarray(tripod_gait.neutral_feet(gait))[[0, 4, 2], :2]:
        rows.append(np.hstack([np.eye(3), [[0, height, -y], [-height, 0, x], [y, -x, 0]]]))
    return np.linalg.pinv(np.vstack(rows))


@jax.jit
@partial(jax.vmap, in_axes=(None, None, 0))
@partial(jax.vmap, in_axes=(None, 2, 0))
def _initial_networks(inputs: Float[Array, "p v 3"], targets: Float[Array, "p v 3"], key: Array) -> _Networks:
    """Sample networks (candidates, legs) whose units have their kinks at random inputs; solve for the output layer."""
    x, y = inputs.reshape(-1, 3), targets.reshape(-1, 3)
    first, second = jax.random.split(key)
    w1 = jax.random.normal(first, (3, shaping.UNITS), dtype=float)
    kinks = x[jax.random.randint(second, (shaping.UNITS,), 0, x.shape[0])]
    b1 = -0.9 * jnp.sum(kinks.T * w1, axis=0)
    units = jnp.concatenate([jax.nn.relu(x @ w1 + b1), jnp.ones_like(x[:, :1])], axis=1)
    ridge = 1e-3 * x.shape[0] * jnp.eye(shaping.UNITS + 1)
    output = jnp.linalg.solve(units.T @ units + ridge, units.T @ y)
    return _Networks(w1=w1, b1=b1, w2=output[:-1], b2=output[-1])


def _foot_errors(networks: _Networks, problem: _Problem) -> Float[Array, "*candidates p v 3 3"]:
    """Return the displacement of the left feet from those of the demonstrations [mm]."""
    left, demonstrations = problem
    units = jnp.einsum("pvi,...liu->...pvlu", demonstrations.inputs, networks.w1) + networks.b1[..., None, None, :, :]
    angles = jnp.einsum("...pvlu,...luj->...pvlj", jax.nn.relu(units), networks.w2)
    angles = angles + networks.b2[..., None, None, :, :]
    return 1e3 * (kinematics.forward(left, angles) - demonstrations.feet)


def _feet_loss(
    errors: Float[Array, "*candidates p v 3 3"], demonstrations: _Demonstrations
) -> Float[Array, "*candidates 3"]:
    return jnp.sum((errors * demonstrations.weight[:, :, None, None]) ** 2, axis=(-4, -3, -1))


def _candidates_loss(networks: _Networks, problem: _Problem) -> Float[Array, ""]:
    return jnp.sum(_feet_loss(_foot_errors(networks, problem), problem.demonstrations))


@jax.jit
def _best_candidates(networks: _Networks, problem: _Problem) -> _Networks:
    """Return each leg's candidate with the smallest loss."""
    losses = _feet_loss(_foot_errors(networks, problem), problem.demonstrations)
    best = jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf), axis=0)
    return jax.tree.map(lambda weights: weights[best, jnp.arange(3)], networks)


def _robot_loss(networks: _Networks, problem: _Problem) -> Float[Array, ""]:
    """Return the loss of the feet, plus their effect on the trunk in straight walking: its speed and its sway.

    A tripod is two legs of one side and the mirrored middle leg of the other, at one phase and velocity.
    """
    demonstrations = problem.demonstrations
    errors = _foot_errors(networks, problem)
    strides = jnp.einsum("pvl,pv->vl", errors[..., 0], demonstrations.stride)
    mirror = jnp.asarray([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0]], dtype=float)
    tripod = (errors * mirror).reshape(*errors.shape[:2], 9)
    motion = tripod @ demonstrations.trunk.T  # mm, mrad
    rate = (jnp.roll(motion, -1, axis=0) - motion) * (PHASES / (2 * jnp.pi))
    in_stance = demonstrations.weight * (demonstrations.stance * jnp.roll(demonstrations.stance, -1))[:, None]
    sway = jnp.sum((rate * in_stance[:, :, None]) ** 2)
    return jnp.sum(_feet_loss(errors, demonstrations)) + STRIDE_WEIGHT * jnp.sum(strides**2) + SWAY_WEIGHT * sway


def _minimise(
    loss: _Loss,
    networks: _Networks,
    problem: _Problem,
    learning_rate: float,
    steps: range,
    *,
    report: Callable[[int, Float[Array, ""]], None],
) -> _Networks:
    """Minimise a loss by Adam with a cosine schedule of the learning rate; report the progress every hundred steps."""
    state = _FitState(networks, ADAM.init(networks))
    for first in range(0, len(steps), 100):
        end = min(first + 100, len(steps))
        span = _Span(*(jnp.asarray(x, dtype=float) for x in (learning_rate, first, end, len(steps))))
        state, value = _adam_steps(loss, state, problem, span)
        report(steps.start + end, value)
    return state.networks


@partial(jax.jit, static_argnums=0)
def _adam_steps(loss: _Loss, state: _FitState, problem: _Problem, span: _Span) -> tuple[_FitState, Float[Array, ""]]:
    """Take the steps of a span; return the new state and the last loss.

    The numbers of the steps are arguments, not constants, so that a single program serves all spans.
    """

    def body(carry: _Carry) -> _Carry:
        (networks, optimiser), _, step = carry
        value, gradient = jax.value_and_grad(loss)(networks, problem)
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integer powers
            updates, optimiser = ADAM.update(gradient, optimiser)
        rate = -span.learning_rate * 0.5 * (1 + jnp.cos(jnp.pi * step / span.total))
        networks = jax.tree.map(lambda weight, update: weight + rate * update, networks, updates)
        return _FitState(networks, optimiser), value, step + 1

    start = (state, jnp.zeros_like(span.learning_rate), span.first)
    state, value, _ = jax.lax.while_loop(lambda carry: carry[2] < span.end, body, start)
    return state, value


def _mirrored(networks: _Networks, demonstrations: _Demonstrations, printed_input: bool) -> shaping.Params:
    """Return the networks of all six legs on unscaled inputs; the right legs mirror the left ones."""
    left = networks._replace(w1=networks.w1 / demonstrations.scale[:, None])
    both = {name: jnp.concatenate([weights, weights]) for name, weights in left._asdict().items()}
    return shaping.symmetrise(shaping.Params(**both, printed_input=printed_input))
