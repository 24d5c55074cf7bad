"""Rotations and lengths that more than one wing needs.

| symbol  | name                                     | unit |
| ------- | ---------------------------------------- | ---- |
| w x y z | unit quaternion, scalar first            | 1    |
| psi     | angle in the plane, counter-clockwise    | rad  |

World and body frames: x forward, y left, z up.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def rotation_matrix(quaternion: Float[Array | np.ndarray, "4 *n"]) -> Float[Array | np.ndarray, "3 3 *n"]:
    """Return the matrix that rotates the body frame into the world frame; a NumPy array for a NumPy array.

    The components come first, so that one function serves a traced quaternion (4,) and recorded ones (4, frames).

    >>> rotation_matrix(np.array([1.0, 0.0, 0.0, 1.0]) / np.sqrt(2)).round(6) @ [1.0, 0.0, 0.0]  # a quarter turn left
    array([0., 1., 0.])
    """
    array = np.array if isinstance(quaternion, np.ndarray) else jnp.array
    w, x, y, z = quaternion
    return array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def yaw(quaternion: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n"]:
    """Return the heading [rad] in (-pi, pi] of recorded quaternions, positive to the left.

    The result has the precision of the quaternions. Traced code computes the heading from the rotation matrix instead
    (`hexapod.yaw`).

    >>> yaw(np.array([[1.0, 0.0, 0.0, 1.0]]) / np.sqrt(2)).round(4)
    array([1.5708])
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def rotate(vector: Float[Array, "*#shape 2"], angle: Float[Array, "*#shape"]) -> Float[Array, "*shape 2"]:
    """Rotate plane vectors by `angle` [rad], counter-clockwise."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def rotate_recorded(vector: Float[np.ndarray, "*#shape 2"], angle: np.ndarray | float) -> Float[np.ndarray, "*shape 2"]:
    """Rotate plane vectors by `angle` [rad], counter-clockwise, as `rotate` does, in NumPy and double precision.

    It is a separate function because NumPy's complex exponential and JAX's sine and cosine differ in the last bit.
    """
    rotated = (vector[..., 0] + 1j * vector[..., 1]) * np.exp(1j * angle)
    return np.stack([rotated.real, rotated.imag], axis=-1)


def safe_norm(vector: Float[Array, "*n k"]) -> Float[Array, "*n"]:
    """Return the Euclidean norm over the last axis.

    Gradient: zero at zero, where it is undefined.
    """
    square = jnp.sum(vector * vector, axis=-1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
