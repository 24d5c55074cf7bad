"""What every component keeps: one shape of state, one program, the same numbers however it is run, a gradient.

A component has `Params`, `State`, `init` and `step(params, state, input) -> (state, output)`. New ones join by a
line in `COMPONENTS`; each runs in double and single precision, with implicit dtype promotion forbidden.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.control import braitenberg, controller, navigator, policies
from lgmdjax.detectors import lgmd
from lgmdjax.locomotion import cpg, shaping

STEPS = 4


@dataclass(frozen=True)
class Component:
    """How to build and run one.

    Attributes:
        name: for the test's name.
        params: builds the parameters, in the precision of the moment.
        init: first state, from the parameters and the first input.
        step: the component's step.
        inputs: `STEPS` inputs from a generator, stacked.
        flat: names of parameters whose gradient is zero here, and why it may be.
        plain: run it without jit too; not worth its minutes for what only composes others.
    """

    name: str
    params: Callable[[], Any]
    init: Callable[[Any, Any], Any]
    step: Callable[[Any, Any, Any], tuple[Any, Any]]
    inputs: Callable[[np.random.Generator], Any]
    flat: tuple[str, ...] = ()
    plain: bool = True


def pictures(*shape: int) -> Callable[[np.random.Generator], Any]:
    """Quiet noise, whose changes lie about the thresholds."""
    return lambda rng: jnp.asarray(rng.uniform(100, 130, (STEPS, *shape)), dtype=float)


def between(low: float, high: float, *shape: int) -> Callable[[np.random.Generator], Any]:
    return lambda rng: jnp.asarray(rng.uniform(low, high, (STEPS, *shape)), dtype=float)


def smooth() -> lgmd.Params:
    return lgmd.Params(threshold=5.0, suppression=12.0, smooth=True)


def guided() -> controller.Params:
    """The rhythm in one Runge-Kutta step: four take long to compile, and are tested by themselves."""
    return controller.Params(
        lgmd=smooth(),
        driver=navigator.create(jax.random.key(1)),
        cpg=cpg.Params(substeps=1),
        shaping=shaping.init(jax.random.key(2)),
    )


def open_nerves(params: controller.Params, frames: Any) -> controller.State:
    return controller.init(params, frames, policies.LEARNED, jax.random.key(0))


def looks(_: np.random.Generator) -> policies.Senses:
    """Frames quiet enough for a command within the gait's range, and so unlike that both its ends are met."""
    u = jnp.asarray([[0.52, 0.55], [0.9, 0.55], [0.6, 0.7], [0.8, 0.85]], dtype=float)
    nothing = jnp.zeros_like(u)
    return policies.Senses(u=u, feed_forward=nothing, excitation=nothing, distances=nothing)


def driven(driver: policies.Driver, params: Callable[[], Any], flat: tuple[str, ...] = ()) -> Component:
    return Component(
        driver.name, params, lambda params, _: driver.init(params, jax.random.key(4)), driver.step, looks, flat
    )


# `simulation` has this shape too, but is not here, since MuJoCo's step takes long to compile. Where it is compiled
# anyway, test_simulation holds that its state can be scanned and that chunks of a crowd are one robot's walk, and
# test_imitation that reverse and forward mode agree in every parameter of the controller.
COMPONENTS = (
    Component("lgmd", smooth, lgmd.init, lgmd.step, pictures(12, 16)),
    Component(
        "lgmd-hard",
        lambda: lgmd.Params(threshold=5.0),
        lgmd.init,
        lgmd.step,
        pictures(12, 16),
        flat=("threshold", "suppression", "threshold_width", "suppression_width"),  # steps
    ),
    Component(
        "cpg",
        lambda: cpg.Params(substeps=2),
        lambda params, _: cpg.init(params, jax.random.key(0)),
        cpg.step,
        between(0.02, 0.03),
    ),
    Component(
        "teacher",
        braitenberg.Params,
        lambda params, _: braitenberg.init(params),
        braitenberg.step,
        # Near enough for the tie-break, far enough for the range: all limits but the slowest are touched.
        lambda rng: jnp.asarray([[0.7, 0.8], [0.8, 4.0], [1.5, 2.0], [0.66, 0.61]], dtype=float),
        flat=("slowest", "symmetry", "steady", "first_side"),  # a bound not touched, comparisons, a choice
    ),
    *(
        Component(
            f"navigator-{variant}",
            lambda variant=variant: navigator.create(jax.random.key(1), variant),
            lambda params, _: navigator.init(params),
            navigator.step,
            between(0.5, 1.0, 2),
            flat=("input_mean", "input_scale", "output_scale") if variant == "mean" else (),
        )
        for variant in navigator.VARIANTS
    ),
    Component(
        "navigator-symmetric",
        lambda: navigator.create(jax.random.key(1), symmetric=True),
        lambda params, _: navigator.init(params),
        navigator.step,
        between(0.5, 1.0, 2),
    ),
    driven(policies.BLIND, lambda: policies.Blind(velocity=jnp.asarray([1.2, 1.1]))),
    driven(
        policies.DIRECT,
        lambda: policies.Direct(rule=braitenberg.Params(), gain=jnp.asarray(10.0)),
        flat=("near", "close", "full_turn", "symmetry", "steady", "first_side"),  # the teacher's own departures
    ),
    driven(policies.RANDOM, lambda: policies.Replay(velocities=jnp.asarray([[1.0, 0.5], [0.5, 1.0], [1.2, 0.9]]))),
    Component(
        "controller",
        guided,
        open_nerves,
        lambda params, state, frames: controller.step(params, state, frames, policies.LEARNED, 1 / 30),
        pictures(2, 12, 16),
        plain=False,
    ),
)
each = pytest.mark.parametrize("component", COMPONENTS, ids=lambda component: component.name)
pytestmark = pytest.mark.usefixtures("precision", "strict")


def built(component: Component) -> tuple[Any, Any, Any]:
    """Parameters, first state, inputs."""
    params, inputs = component.params(), component.inputs(np.random.default_rng(5))
    return params, component.init(params, at(inputs, 0)), inputs


def at(tree: Any, k: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[k], tree)


def looped(step: Callable, params: Any, state: Any, inputs: Any) -> tuple[Any, Any]:
    """Run by a Python loop; last state, and stacked outputs."""
    outputs = []
    for k in range(STEPS):
        state, output = step(params, state, at(inputs, k))
        outputs.append(output)
    return state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *outputs)


def assert_same(a: Any, b: Any) -> None:
    """Equal up to the rounding of another order of sums."""
    tolerance = 1e-10 if jax.config.jax_enable_x64 else 2e-4  # pyright: ignore[reportAttributeAccessIssue]
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def kind(tree: Any) -> Any:
    """Structure, and shape and dtype of every leaf."""
    return jax.tree.structure(tree), [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


@each
def test_state_keeps_its_kind_and_precision(component):
    params, state, inputs = built(component)
    after, output = jax.eval_shape(component.step, params, state, at(inputs, 0))
    assert kind(after) == kind(jax.eval_shape(lambda: state))
    for leaf in jax.tree.leaves((after, output)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert leaf.dtype == jnp.zeros(()).dtype


@each
def test_jit_scan_and_vmap_equal_plain_steps_and_compile_once(component):
    params, state, inputs = built(component)
    traced = []

    @jax.jit
    def step(params: Any, state: Any, now: Any) -> tuple[Any, Any]:
        traced.append(state)
        return component.step(params, state, now)

    compiled = looped(step, params, state, inputs)
    assert len(traced) == 1, "a state that came back is of another kind than the first"
    if component.plain:
        assert_same(component.step(params, state, at(inputs, 0)), step(params, state, at(inputs, 0)))
    scanned = jax.jit(partial(jax.lax.scan, partial(component.step, params)))
    assert_same(scanned(state, inputs), compiled)
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    pairs = jax.tree.map(lambda leaf: jnp.stack([leaf[0], leaf[1]]), inputs)
    mapped = jax.jit(jax.vmap(component.step, in_axes=(None, 0, 0)))(params, both, pairs)
    for k in (0, 1):
        assert_same(at(mapped, k), step(params, state, at(inputs, k)))


@each
def test_gradient_is_finite_and_reaches_every_parameter(component):
    params, _, inputs = built(component)

    @jax.jit
    @jax.grad
    def gradient(params: Any) -> Any:
        start = component.init(params, at(inputs, 0))
        _, outputs = jax.lax.scan(partial(component.step, params), start, inputs)
        # Weighted, since the sum of two sides can be blind to what moves both.
        return sum(jnp.sum(leaf * _weights(leaf)) for leaf in jax.tree.leaves(outputs))

    leaves, _ = jax.tree.flatten_with_path(gradient(params))
    assert leaves
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path)
        assert np.all(np.isfinite(leaf)), name
        if any(flat in name for flat in component.flat):
            assert np.all(leaf == 0), f"{name} has a gradient after all: take it off the list"
        else:
            assert np.any(leaf != 0), name


def _weights(leaf: Any) -> Any:
    return jnp.cos(1 + jnp.arange(leaf.size, dtype=leaf.dtype)).reshape(leaf.shape)
