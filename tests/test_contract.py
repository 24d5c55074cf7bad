"""The contract of every component: a state of fixed structure, one compilation, equal results in every mode, gradients.

A component has `Params`, `State`, `init` and `step(params, state, input) -> (state, output)`. Add new
ones to `COMPONENTS`. Each is tested in double and single precision, with implicit dtype promotion forbidden; detectors
in single precision alone, since their transcriptions in NumPy are compared in double precision.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, PyTree

from lgmdjax.control import actor, braitenberg, compass, controller, names, navigator, perceptron, policies
from lgmdjax.detectors import d_lgmd, dsn, emd, eta, grm, lgmd, lgmd1_grouping, lgmd1_onoff, lgmd2, lplc2, scaled, tau
from lgmdjax.detectors.protocol import Geometry
from lgmdjax.locomotion import cpg, shaping

STEPS = 4
Step = Callable[[PyTree, PyTree, PyTree], tuple[PyTree, PyTree]]


@dataclass(frozen=True)
class Component:
    """How to build and run a component.

    Attributes:
        name: for the test's name.
        params: builds the parameters, in the current precision.
        init: returns the first state from the parameters and the first input.
        step: the component's step.
        inputs: returns `STEPS` inputs, stacked, from a random generator.
        zero_gradient: names of parameters whose gradient is zero here; a comment says why.
        eager: whether to run it without jit too, which takes minutes for a composition of other components.
        precisions: in which it is tested.
    """

    name: str
    params: Callable[[], PyTree]
    init: Callable[[PyTree, PyTree], PyTree]
    step: Step
    inputs: Callable[[np.random.Generator], PyTree]
    zero_gradient: tuple[str, ...] = ()
    eager: bool = True
    precisions: tuple[str, ...] = ("float64", "float32")


def noise(*shape: int) -> Callable[[np.random.Generator], Array]:
    """Weak noise, whose changes are near the thresholds."""
    return lambda rng: jnp.asarray(rng.uniform(100, 130, (STEPS, *shape)), dtype=float)


def uniform(low: float, high: float, *shape: int) -> Callable[[np.random.Generator], Array]:
    return lambda rng: jnp.asarray(rng.uniform(low, high, (STEPS, *shape)), dtype=float)


def smooth_lgmd() -> lgmd.Params:
    return lgmd.Params(threshold=5.0, suppression=12.0, smooth=True)


def learned_controller() -> controller.Params:
    """With one Runge-Kutta step per frame: four take long to compile, and are tested with the CPG."""
    return controller.Params(
        detector=smooth_lgmd(),
        policy=navigator.create(jax.random.key(1)),
        cpg=cpg.Params(substeps=1),
        shaping=shaping.init(jax.random.key(2)),
    )


def init_controller(params: controller.Params, frames: Array) -> controller.State:
    return controller.init(params, frames, policies.LEARNED, jax.random.key(0))


def observations(_: np.random.Generator) -> policies.Observation:
    """Responses that command velocities within the gait's range, including both of its ends."""
    u = jnp.asarray([[0.52, 0.55], [0.9, 0.55], [0.6, 0.7], [0.8, 0.85]], dtype=float)
    zero = jnp.zeros_like(u)
    return policies.Observation(u=u, feed_forward=zero, excitation=zero, distances=zero, corridor=zero)


def commands_and_headings(_: np.random.Generator) -> tuple[Array, Array]:
    """Commands and headings [rad], one of them far from the wanted one, after a turn."""
    velocities = jnp.asarray([[1.0, 1.3], [1.0, 1.0], [1.1, 1.0], [1.0, 1.0]], dtype=float)
    return velocities, jnp.asarray([0.1, 0.2, 1.5, -0.3], dtype=float)


EMD_GAIN = (".motion.gain",)  # of the correlators as a detector of their own


def looming_object(_: np.random.Generator) -> Geometry:
    """Size and expansion of an object, as an observer would be told them."""
    return Geometry(size=jnp.asarray([0.2, 0.25, 0.4, 1.0]), rate=jnp.asarray([0.5, 1.0, 2.0, 5.0]))


def policy_component(
    policy: policies.Policy, params: Callable[[], PyTree], zero_gradient: tuple[str, ...] = ()
) -> Component:
    return Component(
        policy.name,
        params,
        lambda params, _: policy.init(params, jax.random.key(4)),
        policy.step,
        observations,
        zero_gradient,
    )


def detector(module: Any, params: Callable[[], PyTree], zero_gradient: tuple[str, ...] = ()) -> Component:
    return Component(
        module.__name__.rpartition(".")[2],
        params,
        module.init,
        module.step,
        noise(12, 16),
        zero_gradient,
        eager=False,
        precisions=("float32",),
    )


# `closed_loop` follows the contract too, but is not here, since MuJoCo's step takes long to compile. Where it is
# compiled anyway, test_closed_loop checks that its state can be scanned and that chunks of a batch equal the rollout of
# one robot, and test_rollout_gradient checks that both modes agree in every parameter of the controller.
COMPONENTS = (
    Component(
        "compass",
        lambda: compass.Params(drift=0.1),
        lambda params, first: compass.init(params, first[1], jnp.ones_like(first[1])),
        lambda params, state, now: compass.step(params, state, now[0], now[1], 1 / 30),
        commands_and_headings,
    ),
    Component("lgmd", smooth_lgmd, lgmd.init, lgmd.step, noise(12, 16)),
    Component(
        "lgmd-hard",
        lambda: lgmd.Params(threshold=5.0),
        lgmd.init,
        lgmd.step,
        noise(12, 16),
        zero_gradient=("threshold", "suppression", "threshold_width", "suppression_width"),  # steps
    ),
    detector(lgmd1_grouping, lambda: lgmd1_grouping.Params(threshold=1.0, smooth=True)),
    detector(
        lgmd1_onoff,
        lambda: lgmd1_onoff.Params(threshold=5.0, smooth=True),
        zero_gradient=("adaptation_threshold",),  # a step
    ),
    detector(
        lgmd2,
        # Inhibition of which half, as mediated, is above its lowest value, and weak enough for the ON channel to pass.
        lambda: lgmd2.Params(threshold=1.0, mediation_scale=15.0, on_inhibition=0.2, off_inhibition=0.3, smooth=True),
        zero_gradient=("adaptation_threshold", "joint_weight"),  # a step; in noise no cell passes both channels
    ),
    detector(
        d_lgmd,
        lambda: d_lgmd.Params(inhibition=0.2, threshold=0.2, interpolated=True, smooth=True),
        zero_gradient=("max_threshold",),  # does not apply
    ),
    detector(dsn, lambda: dsn.Params(inhibition=0.5, threshold=1.0, smooth=True)),
    detector(emd, emd.Params),
    detector(grm, grm.Params, EMD_GAIN),
    detector(lplc2, lambda: replace(lplc2.create(5), intercept=0.3, inhibition_intercept=-0.01), EMD_GAIN),
    detector(scaled, lambda: scaled.Params(detector=smooth_lgmd(), contrast=1.2, gain=0.8, pooling=2)),
    replace(detector(eta, eta.Params), inputs=looming_object),
    replace(detector(tau, tau.Params), inputs=looming_object),
    Component(
        "cpg",
        lambda: cpg.Params(substeps=2),
        lambda params, _: cpg.init(params, jax.random.key(0)),
        cpg.step,
        uniform(0.02, 0.03),
    ),
    Component(
        "teacher",
        braitenberg.Params,
        lambda params, _: braitenberg.init(params),
        braitenberg.step,
        # Near and far distances, so that the tie-break and all limits but the lowest velocity apply.
        lambda rng: jnp.asarray([[0.7, 0.8], [0.8, 4.0], [1.5, 2.0], [0.66, 0.61]], dtype=float),
        # A limit that does not apply, comparisons, a choice, and what the step does not use.
        zero_gradient=("min_velocity", "tie_tolerance", "turn_deadband", "default_side", "corridor"),
    ),
    *(
        Component(
            f"navigator-{variant}",
            lambda variant=variant: navigator.create(jax.random.key(1), variant),
            lambda params, _: navigator.init(params),
            navigator.step,
            uniform(0.5, 1.0, 2),
            zero_gradient=("input_mean", "input_scale", "output_scale") if variant == "mean" else (),
        )
        for variant in names.VARIANTS
    ),
    Component(
        "navigator-symmetric",
        lambda: navigator.create(jax.random.key(1), symmetric=True),
        lambda params, _: navigator.init(params),
        navigator.step,
        uniform(0.5, 1.0, 2),
    ),
    Component(
        "actor",
        lambda: actor.Params(layers=perceptron.create(jax.random.key(1), (4, 8, 2)), depth=2, hold=2),
        lambda params, _: actor.init(params),
        actor.step,
        uniform(0.5, 1.0, 2),
    ),
    policy_component(policies.BLIND, lambda: policies.BlindParams(velocity=jnp.asarray([1.2, 1.1]))),
    policy_component(
        policies.DIRECT,
        lambda: policies.DirectParams(rule=braitenberg.Params(), gain=jnp.asarray(10.0)),
        # The teacher's deviations from eq. 22.
        zero_gradient=(
            "turn_distance",
            "full_turn_distance",
            "full_turn",
            "tie_tolerance",
            "turn_deadband",
            "default_side",
            "corridor",
        ),
    ),
    policy_component(
        policies.REPLAY, lambda: policies.ReplayParams(velocities=jnp.asarray([[1.0, 0.5], [0.5, 1.0], [1.2, 0.9]]))
    ),
    Component(
        "controller",
        learned_controller,
        init_controller,
        lambda params, state, frames: controller.step(params, state, frames, policies.LEARNED, 1 / 30),
        noise(2, 12, 16),
        eager=False,
    ),
)
each = pytest.mark.parametrize(
    ("precision", "component"),
    [
        pytest.param(precision, component, id=f"{precision}-{component.name}")
        for component in COMPONENTS
        for precision in component.precisions
    ],
    indirect=["precision"],
)
pytestmark = pytest.mark.usefixtures("strict")


def build(component: Component) -> tuple[PyTree, PyTree, PyTree]:
    """Return parameters, first state and inputs."""
    params, inputs = component.params(), component.inputs(np.random.default_rng(5))
    return params, component.init(params, at(inputs, 0)), inputs


def at(tree: PyTree, k: int) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[k], tree)


def run_loop(step: Step, params: PyTree, state: PyTree, inputs: PyTree) -> tuple[PyTree, PyTree]:
    """Run steps in a Python loop; return the last state and the stacked outputs."""
    outputs = []
    for k in range(STEPS):
        state, output = step(params, state, at(inputs, k))
        outputs.append(output)
    return state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *outputs)


def assert_same(a: PyTree, b: PyTree) -> None:
    """Compare up to rounding errors of another order of sums."""
    tolerance = 1e-10 if jax.config.jax_enable_x64 else 2e-4  # pyright: ignore[reportAttributeAccessIssue]
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def signature(tree: PyTree) -> tuple[object, list]:
    """Return the structure, and shape and dtype of every leaf."""
    return jax.tree.structure(tree), [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


@each
def test_state_keeps_structure_shapes_and_dtypes(precision, component):
    params, state, inputs = build(component)
    next_state, output = jax.eval_shape(component.step, params, state, at(inputs, 0))
    assert signature(next_state) == signature(jax.eval_shape(lambda: state))
    for leaf in jax.tree.leaves((next_state, output)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert leaf.dtype == jnp.zeros(()).dtype


@each
def test_jit_scan_and_vmap_equal_eager_steps_and_compile_once(precision, component):
    params, state, inputs = build(component)
    traced = []

    @jax.jit
    def step(params: PyTree, state: PyTree, value: PyTree) -> tuple[PyTree, PyTree]:
        traced.append(state)
        return component.step(params, state, value)

    compiled = run_loop(step, params, state, inputs)
    assert len(traced) == 1, "the returned state differs in structure, shape or dtype from the first"
    if component.eager:
        assert_same(component.step(params, state, at(inputs, 0)), step(params, state, at(inputs, 0)))
    scanned = jax.jit(partial(jax.lax.scan, partial(component.step, params)))
    assert_same(scanned(state, inputs), compiled)
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    pairs = jax.tree.map(lambda leaf: jnp.stack([leaf[0], leaf[1]]), inputs)
    mapped = jax.jit(jax.vmap(component.step, in_axes=(None, 0, 0)))(params, both, pairs)
    for k in (0, 1):
        assert_same(at(mapped, k), step(params, state, at(inputs, k)))


@each
def test_gradient_is_finite_and_reaches_every_parameter(precision, component):
    params, _, inputs = build(component)

    @jax.jit
    @jax.grad
    def gradient(params: PyTree) -> PyTree:
        start = component.init(params, at(inputs, 0))
        _, outputs = jax.lax.scan(partial(component.step, params), start, inputs)
        # Weighted, since the sum of both sides may not depend on what changes them in opposite ways.
        return sum(jnp.sum(leaf * _weights(leaf)) for leaf in jax.tree.leaves(outputs))

    leaves, _ = jax.tree.flatten_with_path(gradient(params))
    assert leaves
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path)
        assert np.all(np.isfinite(leaf)), name
        if any(zero in name for zero in component.zero_gradient):
            assert np.all(leaf == 0), f"expected a zero gradient of {name}, got another; remove it from zero_gradient"
        else:
            assert np.any(leaf != 0), name


def _weights(leaf: PyTree) -> PyTree:
    return jnp.cos(1 + jnp.arange(leaf.size, dtype=leaf.dtype)).reshape(leaf.shape)
