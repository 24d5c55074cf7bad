"""The larger and the smaller of two, with a derivative that none loses.

JAX differentiates `jnp.maximum` by asking which of the two is equal to it. XLA may compute them anew to ask, and come
to another last bit: then neither is, and the slope is lost, here and there and in silence (so it was at the limbs of
cylinders, in `test_gradients_are_those_of_central_differences_in_both_modes`). These ask which is larger.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array


def maximum(a: ArrayLike, b: ArrayLike) -> Array:
    """max(a, b). Gradient: that of the larger one; of b where they are equal."""
    return _larger(*_alike(a, b))


def minimum(a: ArrayLike, b: ArrayLike) -> Array:
    """min(a, b). Gradient: that of the smaller one; of b where they are equal."""
    return _smaller(*_alike(a, b))


def amin(a: ArrayLike, axis: int) -> Array:
    """Take the least along an axis. Gradient: that of the first of the least, where `jnp.min` may come to 0/0."""
    return _least(axis, jnp.asarray(a))


def clip(x: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """Limit x to low .. high. Gradient: 1 between them, else 0."""
    return minimum(maximum(x, low), high)


def _alike(a: ArrayLike, b: ArrayLike) -> list[Array]:
    """Give both the dtype of the result: whole numbers have no tangents."""
    return [jnp.asarray(x, jnp.result_type(a, b)) for x in (a, b)]


def _chosen(value: Callable[[Array, Array], Array], is_first: Callable[[Array, Array], Array]) -> Callable[..., Array]:
    """Give one of two, and the slope of the first where it is that."""

    @jax.custom_jvp
    def one(a: Array, b: Array) -> Array:
        return value(a, b)

    one.defjvp(lambda both, slopes: (one(*both), jnp.where(is_first(*both), *slopes)))
    return one


_larger, _smaller = _chosen(jnp.maximum, jnp.greater), _chosen(jnp.minimum, jnp.less)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _least(axis: int, a: Array) -> Array:
    return jnp.min(a, axis)


@_least.defjvp
def _least_jvp(axis: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (a,), (slope,) = primals, tangents
    where = jnp.argmin(a, axis, keepdims=True)
    return _least(axis, a), jnp.take_along_axis(slope, where, axis).squeeze(axis)
