"""One derivative by three routes: reverse mode, forward mode, central differences."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# What runs a few times is not worth optimising.
QUICKLY_COMPILED = {"xla_backend_optimization_level": 0}


def direction(tree: Any, seed: int = 0) -> Any:
    """Draw a random direction, each leaf by its own size, so that none drowns the others."""
    rng = np.random.default_rng(seed)

    def drawn(leaf: Any) -> Any:
        size = np.maximum(np.abs(np.asarray(leaf)).mean(), 0.01)
        return jnp.asarray(rng.normal(size=np.shape(leaf)) * size, dtype=float)

    return jax.tree.map(drawn, tree)


def along(gradient: Any, tangent: Any) -> Any:
    """Sum up the products of two trees."""
    return sum(jax.tree.leaves(jax.tree.map(jnp.vdot, gradient, tangent)))


class Routes:
    """The derivative of a scalar function of a tree, and of what else it is given, compiled once for each mode."""

    def __init__(self, function: Callable[..., Any]) -> None:
        def sloped(at: Any, tangent: Any, *rest: Any) -> Any:
            return jax.jvp(lambda at: function(at, *rest), (at,), (tangent,))

        self.reverse = jax.jit(jax.grad(function), compiler_options=QUICKLY_COMPILED)
        self.forward = jax.jit(sloped, compiler_options=QUICKLY_COMPILED)

    def assert_agree(self, at: Any, *rest: Any, step: float = 1e-6, rtol: float = 1e-5) -> Any:
        """Compare the slopes along a random direction; give the gradient.

        Reverse and forward mode differ by rounding alone; the differences, by what is left of a kink within the step.
        """
        assert jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        tangent, gradient = direction(at), self.reverse(at, *rest)
        forward = self.forward(at, tangent, *rest)[1]
        ends = [
            self.forward(jax.tree.map(lambda x, dx, by=by: x + by * dx, at, tangent), tangent, *rest)[0]
            for by in (step, -step)
        ]
        assert abs(forward) > 1e-9, "a slope of nothing proves nothing"
        np.testing.assert_allclose(along(gradient, tangent), forward, rtol=1e-9)
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), forward, rtol=rtol)
        return gradient

    def assert_every_leaf_agrees(self, at: Any, *rest: Any) -> None:
        """Compare both modes in every leaf by itself, and see that none has a gradient of nothing."""
        gradient = self.reverse(at, *rest)
        drawn, structure = jax.tree.flatten(direction(at))
        for number, (path, leaf) in enumerate(jax.tree.leaves_with_path(gradient)):
            name = jax.tree_util.keystr(path)
            assert np.all(np.isfinite(leaf)) and np.any(leaf != 0), name
            tangent = [part if k == number else jnp.zeros_like(part) for k, part in enumerate(drawn)]
            forward = self.forward(at, jax.tree.unflatten(structure, tangent), *rest)[1]
            np.testing.assert_allclose(jnp.vdot(leaf, drawn[number]), forward, rtol=1e-6, err_msg=name)


def assert_three_ways_agree(function: Callable[[Any], Any], at: Any, **tolerances: float) -> Any:
    """Compare the derivative of a function once; give its gradient."""
    return Routes(function).assert_agree(at, **tolerances)
