"""A multilayer perceptron: layers of tanh units and a linear output.

    h_0 = x,  h_k = tanh(h_{k-1} W_k + b_k),  y = h_{n-1} W_n + b_n

| symbol | name   | shape           |
| ------ | ------ | --------------- |
| W_k    | kernel | inputs, outputs |
| b_k    | bias   | outputs         |
"""

from collections.abc import Sequence
from itertools import pairwise

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float


@struct.dataclass(kw_only=True)
class Layer:
    """Weights of one layer."""

    kernel: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]


Layers = tuple[Layer, ...]


def create(key: Array, sizes: Sequence[int], output_gain: float = 1.0) -> Layers:
    """Return layers with orthogonal kernels of gain sqrt(2), the last of `output_gain`, and without bias.

    >>> [layer.kernel.shape for layer in create(jax.random.key(0), (3, 8, 2))]
    [(3, 8), (8, 2)]

    Args:
        key: of the kernels.
        sizes: number of inputs, of the units of each layer, and of outputs.
        output_gain: of the last layer; with a small one the first outputs are near zero.
    """
    gains = [2**0.5] * (len(sizes) - 2) + [output_gain]
    shapes = pairwise(sizes)
    keys = jax.random.split(key, len(gains))
    return tuple(
        Layer(kernel=jax.nn.initializers.orthogonal(gain)(key, shape, float), bias=jnp.zeros(shape[1]))
        for key, gain, shape in zip(keys, gains, shapes, strict=True)
    )


def apply(layers: Layers, inputs: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
    """Return the outputs."""
    *hidden, last = layers
    for layer in hidden:
        inputs = jnp.tanh(inputs @ layer.kernel + layer.bias)
    return inputs @ last.kernel + last.bias
