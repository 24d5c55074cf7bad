"""Two identities that steer XLA's fusion of the camera's elementwise code.

XLA computes a value again in every loop that reads it, unless that value is a division. Both functions use this rule.
They return their argument, and their gradient is the identity. Seen with jaxlib 0.9.2 on CPU.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Tree = TypeVar("Tree")


def materialise(arrays: Tree, anchor: Float[Array, ""]) -> Tree:
    """Return `arrays`, computed once and written to memory, and in reverse mode their cotangents likewise.

    Otherwise each loop that reads an array computes it again, with everything that it depends on. XLA never repeats a
    division, and it cannot remove this division by 1, because it does not know `anchor` at compile time.

    `lax.optimization_barrier` is made for this purpose, but is the wrong tool here. Compared with the division in
    repeated runs (jaxlib 0.9.2, 2 CPU cores, float32), it gave:

    | program                                     | time           | temporaries        | last bits |
    | ------------------------------------------- | -------------- | ------------------ | --------- |
    | one image, 320 x 240 pixels                 | within noise   | the same           | the same  |
    | `lax.scan` of camera and LGMD, 320 x 240    | 4 to 12 times  | 19 instead of 4 MB | changed   |
    | gradient of an image, 80 x 60 pixels        | 1.5 to 5 times | the same within 4% | changed   |

    Args:
        arrays: any tree of arrays.
        anchor: a finite number that is an argument of the compiled function or computed from one.
    """
    one = 1.0 + 0.0 * lax.stop_gradient(anchor)
    return jax.tree.map(lambda a: a / one, arrays)


@jax.custom_jvp
def fusible(quotient: Array) -> Array:
    """Return a quotient that XLA can fuse into several loops.

    XLA does not fuse a division with several users: it writes the quotient, and everything computed before it, to
    memory. Here the division has a single user, a minimum with a bound that is never reached.
    """
    return jnp.minimum(quotient, 1e30)


fusible.defjvps(lambda tangent, _, quotient: tangent)
