"""Maximum, minimum, amin and clip with a derivative that XLA's rounding cannot lose.

JAX differentiates `jnp.maximum` by testing which argument equals the result. XLA may recompute an argument for that
test and round its last bit differently. Neither argument is then equal to the result, and the derivative is silently
zero. This happened at the outlines of cylinders (`test_gradients_are_those_of_central_differences_in_both_modes`). The
functions here test which argument is larger instead.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array


def maximum(a: ArrayLike, b: ArrayLike) -> Array:
    """Return max(a, b) for each element.

    Gradient: that of the larger argument; that of b where both are equal.

    >>> [float(jax.grad(maximum, argnums=i)(2.0, 1.0)) for i in (0, 1)]
    [1.0, 0.0]
    """
    return _maximum(*_promote(a, b))


def minimum(a: ArrayLike, b: ArrayLike) -> Array:
    """Return min(a, b) for each element.

    Gradient: that of the smaller argument; that of b where both are equal.
    """
    return _minimum(*_promote(a, b))


def amin(a: ArrayLike, axis: int) -> Array:
    """Return the minimum along an axis.

    Gradient: that of the first minimum, where the gradient of `jnp.min` may be 0/0.
    """
    return _amin(axis, jnp.asarray(a))


def clip(x: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """Limit x to low .. high.

    Gradient: 1 between the limits, else 0.

    >>> clip(jnp.array([-2.0, 0.5, 3.0]), 0.0, 1.0).tolist()
    [0.0, 0.5, 1.0]
    """
    return minimum(maximum(x, low), high)


def _promote(a: ArrayLike, b: ArrayLike) -> list[Array]:
    """Convert both arguments to the dtype of the result, since integers have no tangents."""
    return [jnp.asarray(x, jnp.result_type(a, b)) for x in (a, b)]


def _select_with_jvp(
    value: Callable[[Array, Array], Array], is_first: Callable[[Array, Array], Array]
) -> Callable[..., Array]:
    """Return a function that computes `value` and whose tangent is the first one where `is_first`, else the second."""

    @jax.custom_jvp
    def select(a: Array, b: Array) -> Array:
        return value(a, b)

    select.defjvp(lambda primals, tangents: (select(*primals), jnp.where(is_first(*primals), *tangents)))
    return select


_maximum, _minimum = _select_with_jvp(jnp.maximum, jnp.greater), _select_with_jvp(jnp.minimum, jnp.less)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _amin(axis: int, a: Array) -> Array:
    return jnp.min(a, axis)


@_amin.defjvp
def _amin_jvp(axis: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (a,), (tangent,) = primals, tangents
    index = jnp.argmin(a, axis, keepdims=True)
    return _amin(axis, a), jnp.take_along_axis(tangent, index, axis).squeeze(axis)
