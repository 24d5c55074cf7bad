"""The larger and the smaller of two, with a derivative that none loses.

JAX differentiates `jnp.maximum` by asking which of the two is equal to it. XLA may compute them anew to ask, and come
to another last bit: then neither is, and the slope is lost, here and there and in silence. These ask which is larger.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array


@jax.custom_jvp
def larger(a: ArrayLike, b: ArrayLike) -> Array:
    """max(a, b). Gradient: that of the larger one; of b where they are equal."""
    return jnp.maximum(a, b)


@jax.custom_jvp
def smaller(a: ArrayLike, b: ArrayLike) -> Array:
    """min(a, b). Gradient: that of the smaller one; of b where they are equal."""
    return jnp.minimum(a, b)


@larger.defjvp
def _larger_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (a, b), (da, db) = primals, tangents
    found = larger(a, b)
    return found, jnp.where(a > b, da, db).astype(found.dtype)


@smaller.defjvp
def _smaller_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (a, b), (da, db) = primals, tangents
    found = smaller(a, b)
    return found, jnp.where(a < b, da, db).astype(found.dtype)


def within(x: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """Limit x to low .. high. Gradient: 1 between them, else 0."""
    return smaller(larger(x, low), high)
