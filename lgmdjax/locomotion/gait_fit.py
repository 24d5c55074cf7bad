"""The lesson that the shaping networks learn: the regular tripod gait, over one cycle of the rhythm, by gradient.

The inputs are what the networks will hear, the CPG's limit cycle and a velocity; the targets are those of
`lgmdjax.locomotion.tripod_gait`. What counts is not the angles but where they put the feet, and what that does to the
trunk.

Source: Cizek & Faigl, sec. 3.2, which gives no loss and no settings; these are ours.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from lgmdjax.locomotion import cpg, shaping
from lgmdjax.locomotion.kinematics import Geometry, forward
from lgmdjax.locomotion.tripod_gait import Gait, foot_path, homes, targets

# Velocities and how much each counts; walking backward is for turning and needs no accuracy.
VELOCITIES = (-1.0, -0.6, -0.2, 0.2, 0.5, 0.8, 1.0, 1.2, 1.4, 1.7, 2.0)
IMPORTANCE = (0.5, 0.5, 0.5, 0.7, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
PHASES = 48  # points of the cycle
SWING = 0.15  # what a millimetre high in the air counts beside one on the floor
SKIM = 0.006  # m; lower than about this a swinging foot counts as if it stood, since the floor and the legs give
STRIDE = 10.0  # what a millimetre of half a stride counts, divided by v: speed follows from it
SWAY = 0.2  # what a milliradian or a millimetre a radian of phase of the trunk's motion counts

ADAM = optax.scale_by_adam()


class _Lesson(NamedTuple):
    """What is taught: the left legs' targets and feet over the cycle and the velocities."""

    inputs: Float[Array, "phases velocities 3"]  # scaled to order one
    scale: Float[Array, "3"]
    targets: Float[Array, "phases velocities 3 3"]  # rad; front, middle, rear
    feet: Float[Array, "phases velocities 3 3"]  # m, where the targets would put them
    stance: Float[Array, "phases"]  # 1 while the foot stands
    weight: Float[Array, "phases velocities"]  # of a millimetre
    stride: Float[Array, "phases velocities"]  # weights by which errors in x sum to that of half a stride
    trunk: Float[Array, "6 9"]  # its motion from the errors of left front, right middle and left rear foot


class _Networks(NamedTuple):
    """The left legs' networks on scaled inputs."""

    w1: Float[Array, "*candidates 3 3 6"]
    b1: Float[Array, "*candidates 3 6"]
    w2: Float[Array, "*candidates 3 6 3"]
    b2: Float[Array, "*candidates 3 3"]


def teach(
    geometry: Geometry,
    gait: Gait | None = None,
    network: cpg.Params | None = None,
    *,
    key: Array | None = None,
    steps: int = 6000,
    candidates: int = 32,
    literal: bool = False,
    progress: Callable[[int, float], None] | None = None,
) -> shaping.Params:
    """Fit the six shaping networks to the gait, on the CPG's limit cycle, by gradient (Adam).

    Host side; half a minute on two cores. Three networks are fitted and mirrored, so that the mirrored robot
    walks mirrored. For an eighth of the steps each leg has `candidates` random starts, judged by where they put
    the foot; then the best three go on together, and what they do to the trunk counts too: its sway and speed.

    Args:
        geometry: of the robot's legs.
        gait: the gait to teach.
        network: the CPG whose rhythm the networks will hear; its cycle time plays no part.
        key: luck of the starts.
        steps: of the optimiser, in all.
        candidates: starts for each leg.
        literal: leave out the adaptation difference, as the paper does; the result hardly walks.
        progress: told now and then the steps done and the loss [mm^2].
    """
    lesson = _lesson(geometry, gait or Gait(), network or cpg.Params(), literal)
    keys = jax.random.split(jax.random.key(0) if key is None else key, (candidates, 3))
    networks = _starts(lesson.inputs, lesson.targets, keys)
    left = replace(geometry, mounts=geometry.mounts[:3], mount_yaws=geometry.mount_yaws[:3])
    search = steps // 8
    networks = _descend(_search_loss, networks, left, lesson, 0.01, range(search), progress)
    networks = _best(networks, left, lesson)
    networks = _descend(_polish_loss, networks, left, lesson, 0.005, range(search, steps), progress)
    return _both_sides(networks, lesson, literal)


def limit_cycle(network: cpg.Params, phases: Float[np.ndarray, "phases"]) -> Float[np.ndarray, "phases 2"]:
    """Read a settled unit's rhythm at phases of its cycle; 0 is its output's upward zero crossing. Host side."""
    steps = 400  # of a cycle
    interval = network.cycle_time / steps
    state, _ = jax.lax.scan(
        lambda s, _: (cpg.step(network, s, interval)[0], None), cpg.settled(network), length=40 * steps
    )
    _, rhythm = jax.lax.scan(lambda s, _: cpg.step(network, s, interval), state, length=4 * steps)
    unit = np.asarray(rhythm[:, 0])
    start, cycle = cpg.first_rise(unit[:, 0], 1.0), cpg.period(unit[:, 0], 1.0)
    at = start + np.asarray(phases) * cycle
    return np.stack([np.interp(at, np.arange(len(unit)), unit[:, i]) for i in range(2)], axis=1)


def _lesson(geometry: Geometry, gait: Gait, network: cpg.Params, literal: bool) -> _Lesson:
    """Walk the left legs through one cycle of the rhythm at every velocity."""
    phases = np.arange(PHASES) / PHASES
    rhythm = limit_cycle(network, phases) * np.array([1.0, 0.0 if literal else 1.0])
    velocities, importance = np.array(VELOCITIES), np.array(IMPORTANCE)
    grid = (PHASES, len(velocities))
    inputs = np.concatenate(
        [
            np.broadcast_to(rhythm[:, None], (*grid, 2)),
            np.broadcast_to(velocities[None, :, None], (*grid, 1)),
        ],
        axis=2,
    )
    scale = np.maximum(np.abs(inputs).max((0, 1)) * np.array([0.7, 0.7, 0.5]), 1e-6)
    # As programs: operation by operation they would take longer to compile than all else here.
    angles = jax.jit(partial(targets, geometry, gait))(
        jnp.broadcast_to(jnp.asarray(phases, dtype=float)[:, None, None], (*grid, 6)),
        jnp.broadcast_to(jnp.asarray(velocities, dtype=float)[None, :, None], (*grid, 6)),
    )
    duty = float(gait.duty)
    stance = (phases < duty).astype(float)
    rise = np.asarray(foot_path(gait, jnp.asarray(phases, dtype=float), jnp.zeros(PHASES))[:, 2])
    along = (phases - duty / 2) * stance
    relative = importance / np.maximum(np.abs(velocities), 0.4)
    lesson = dict(
        inputs=inputs / scale,
        scale=scale,
        targets=angles[:, :, :3],
        feet=jax.jit(forward)(geometry, angles)[:, :, :3],
        stance=stance,
        weight=np.outer(SWING + (1 - SWING) * np.exp(-rise / SKIM), importance)
        / np.sqrt(3 * stance.sum() * len(velocities)),
        stride=np.outer(along / (along @ along) * duty / 2, relative) / np.sqrt(3 * len(velocities)),
        trunk=_trunk(gait),
    )
    return _Lesson(**{name: jnp.asarray(values, dtype=float) for name, values in lesson.items()})


def _trunk(gait: Gait) -> Float[np.ndarray, "6 9"]:
    """Map a tripod's foot errors (left front, right middle, left rear) to the trunk's motion: least squares."""
    height = -float(gait.height)
    rows = []
    for x, y in np.asarray(homes(gait))[[0, 4, 2], :2]:
        rows.append(np.hstack([np.eye(3), [[0, height, -y], [-height, 0, x], [y, -x, 0]]]))
    return np.linalg.pinv(np.vstack(rows))


@jax.jit
@partial(jax.vmap, in_axes=(None, None, 0))
@partial(jax.vmap, in_axes=(None, 2, 0))
def _starts(inputs: Float[Array, "p v 3"], targets: Float[Array, "p v 3"], key: Array) -> _Networks:
    """Draw networks (candidates, legs): units that bend at random points of the lesson, the output layer that fits."""
    x, y = inputs.reshape(-1, 3), targets.reshape(-1, 3)
    first, second = jax.random.split(key)
    w1 = jax.random.normal(first, (3, shaping.UNITS), dtype=float)
    bends = x[jax.random.randint(second, (shaping.UNITS,), 0, x.shape[0])]
    b1 = -0.9 * jnp.sum(bends.T * w1, axis=0)
    units = jnp.concatenate([jax.nn.relu(x @ w1 + b1), jnp.ones_like(x[:, :1])], axis=1)
    ridge = 1e-3 * x.shape[0] * jnp.eye(shaping.UNITS + 1)
    output = jnp.linalg.solve(units.T @ units + ridge, units.T @ y)
    return _Networks(w1=w1, b1=b1, w2=output[:-1], b2=output[-1])


def _foot_errors(networks: _Networks, left: Geometry, lesson: _Lesson) -> Float[Array, "*candidates p v 3 3"]:
    """Measure how far the networks put the left feet from the lesson's [mm]."""
    units = jnp.einsum("pvi,...liu->...pvlu", lesson.inputs, networks.w1) + networks.b1[..., None, None, :, :]
    angles = jnp.einsum("...pvlu,...luj->...pvlj", jax.nn.relu(units), networks.w2)
    angles = angles + networks.b2[..., None, None, :, :]
    return 1e3 * (forward(left, angles) - lesson.feet)


def _feet_loss(errors: Float[Array, "*candidates p v 3 3"], lesson: _Lesson) -> Float[Array, "*candidates 3"]:
    return jnp.sum((errors * lesson.weight[:, :, None, None]) ** 2, axis=(-4, -3, -1))


def _search_loss(networks: _Networks, left: Geometry, lesson: _Lesson) -> Float[Array, ""]:
    return jnp.sum(_feet_loss(_foot_errors(networks, left, lesson), lesson))


@jax.jit
def _best(networks: _Networks, left: Geometry, lesson: _Lesson) -> _Networks:
    """Choose each leg's best candidate."""
    losses = _feet_loss(_foot_errors(networks, left, lesson), lesson)
    best = jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf), axis=0)
    return jax.tree.map(lambda weights: weights[best, jnp.arange(3)], networks)


def _polish_loss(networks: _Networks, left: Geometry, lesson: _Lesson) -> Float[Array, ""]:
    """Add to the feet's errors what they do to the trunk walking straight: its speed and its sway.

    A tripod is two legs of one side and the mirrored middle leg of the other, at one phase and velocity.
    """
    errors = _foot_errors(networks, left, lesson)
    strides = jnp.einsum("pvl,pv->vl", errors[..., 0], lesson.stride)
    mirror = jnp.asarray([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0]], dtype=float)
    tripod = (errors * mirror).reshape(*errors.shape[:2], 9)
    motion = tripod @ lesson.trunk.T  # mm, mrad
    rate = (jnp.roll(motion, -1, axis=0) - motion) * (PHASES / (2 * jnp.pi))
    standing = lesson.weight * (lesson.stance * jnp.roll(lesson.stance, -1))[:, None]
    sway = jnp.sum((rate * standing[:, :, None]) ** 2)
    return jnp.sum(_feet_loss(errors, lesson)) + STRIDE * jnp.sum(strides**2) + SWAY * sway


def _descend(
    loss: Callable[[_Networks, Geometry, _Lesson], Float[Array, ""]],
    networks: _Networks,
    left: Geometry,
    lesson: _Lesson,
    rate: float,
    steps: range,
    progress: Callable[[int, float], None] | None,
) -> _Networks:
    """Follow the gradient with Adam, ever slower, and tell the progress every hundred steps."""
    state = ADAM.init(networks)
    for done in range(0, len(steps), 100):
        upto = min(done + 100, len(steps))
        spans = [jnp.asarray(x, dtype=float) for x in (rate, done, upto, len(steps))]
        networks, state, value = _descend_some(loss, networks, state, left, lesson, *spans)
        if progress:
            progress(steps.start + upto, float(value))
    return networks


@partial(jax.jit, static_argnums=0)
def _descend_some(loss, networks, state, left, lesson, rate, done, upto, length):
    """Take steps `done` to `upto` of `length`; their numbers are no constants, so that one program serves all."""

    def once(carry):
        networks, state, _, step = carry
        value, gradient = jax.value_and_grad(loss)(networks, left, lesson)
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integer powers
            updates, state = ADAM.update(gradient, state)
        pace = -rate * 0.5 * (1 + jnp.cos(jnp.pi * step / length))
        networks = jax.tree.map(lambda weight, update: weight + pace * update, networks, updates)
        return networks, state, value, step + 1

    carry = (networks, state, jnp.zeros_like(rate), done)
    return jax.lax.while_loop(lambda carry: carry[3] < upto, once, carry)[:3]


def _both_sides(networks: _Networks, lesson: _Lesson, literal: bool) -> shaping.Params:
    """Undo the scaling of inputs, and give the right legs the left ones' networks with the coxa reversed."""
    left = networks._replace(w1=networks.w1 / lesson.scale[:, None])
    twice = {name: jnp.concatenate([weights, weights]) for name, weights in left._asdict().items()}
    return shaping.symmetric(shaping.Params(**twice, literal=literal))
