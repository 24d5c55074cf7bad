"""One derivative computed in three ways: reverse mode, forward mode and central differences."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

Tree = TypeVar("Tree")

# A program that runs a few times only is not worth optimising.
FAST_COMPILE = {"xla_backend_optimization_level": 0}


def random_direction(tree: Tree, seed: int = 0) -> Tree:
    """Sample a random direction, each leaf scaled by its own size, so that no leaf dominates."""
    rng = np.random.default_rng(seed)

    def sample(leaf: Array) -> Array:
        size = np.maximum(np.abs(np.asarray(leaf)).mean(), 0.01)
        return jnp.asarray(rng.normal(size=np.shape(leaf)) * size, dtype=float)

    return jax.tree.map(sample, tree)


def inner_product(gradient: PyTree, tangent: PyTree) -> Array:
    """Return the inner product of two trees of the same structure."""
    return jnp.asarray(sum(jax.tree.leaves(jax.tree.map(jnp.vdot, gradient, tangent))))


class DerivativeCheck:
    """The derivative of a scalar function with respect to its first argument, a tree; compiled once for each mode."""

    def __init__(self, function: Callable[..., Array | float]) -> None:
        def value_and_derivative(at: PyTree, tangent: PyTree, *rest: PyTree) -> tuple[Array, Array]:
            return jax.jvp(lambda at: function(at, *rest), (at,), (tangent,))

        self.reverse = jax.jit(jax.grad(function), compiler_options=FAST_COMPILE)
        self.forward = jax.jit(value_and_derivative, compiler_options=FAST_COMPILE)

    def assert_agree(self, at: Tree, *rest: PyTree, step: float = 1e-6, rtol: float = 1e-5) -> Tree:
        """Compare the three derivatives along a random direction; return the gradient.

        Reverse and forward mode differ by rounding only. The central difference also contains the kinks within `step`.
        """
        assert jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        tangent, gradient = random_direction(at), self.reverse(at, *rest)
        forward = self.forward(at, tangent, *rest)[1]
        ends = [
            self.forward(jax.tree.map(lambda x, dx, by=by: x + by * dx, at, tangent), tangent, *rest)[0]
            for by in (step, -step)
        ]
        assert abs(forward) > 1e-9, "a derivative of zero proves nothing"
        np.testing.assert_allclose(inner_product(gradient, tangent), forward, rtol=1e-9)
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), forward, rtol=rtol)
        return gradient

    def assert_every_leaf_agrees(self, at: PyTree, *rest: PyTree) -> None:
        """Compare reverse and forward mode in each leaf separately; no leaf may have a zero gradient."""
        gradient = self.reverse(at, *rest)
        sampled, structure = jax.tree.flatten(random_direction(at))
        for number, (path, leaf) in enumerate(jax.tree.leaves_with_path(gradient)):
            name = jax.tree_util.keystr(path)
            assert np.all(np.isfinite(leaf)) and np.any(leaf != 0), name
            tangent = [part if k == number else jnp.zeros_like(part) for k, part in enumerate(sampled)]
            forward = self.forward(at, jax.tree.unflatten(structure, tangent), *rest)[1]
            np.testing.assert_allclose(jnp.vdot(leaf, sampled[number]), forward, rtol=1e-6, err_msg=name)


def assert_derivatives_agree(function: Callable[[Tree], Array | float], at: Tree, **tolerances: float) -> Tree:
    """Compare the three derivatives of a function once; return its gradient."""
    return DerivativeCheck(function).assert_agree(at, **tolerances)
