"""A layer of LSTM units: one frame, and many frames with a hand-written derivative.

    z = d + U h',  i, f, o = sigmoid(z_i, z_f, z_o),  g = tanh(z_g)
    c = f c' + i g
    h = o tanh(c)

| symbol     | name         | shape            | meaning                                                      |
| ---------- | ------------ | ---------------- | ------------------------------------------------------------ |
| U          | recurrence   | units, 4 units   | gates in the order i, f, g, o                                |
| d          | drive        | ..., 4 units     | product of the layer's input with its weights, and the bias  |
| h, c       | hidden, cell | ..., units       | memory; h' and c' are those of the frame before              |
| i, f, g, o | gates        | ..., units       | input, forget, candidate, output                             |

Source: Hochreiter & Schmidhuber 1997, with the forget gate of Gers et al. 2000.

JAX could differentiate `scan` by itself, but would add up the gradient of U frame by frame. Here it is one product over
all frames.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Memory(NamedTuple):
    """What the units keep from frame to frame."""

    hidden: Float[Array, "*batch units"]
    cell: Float[Array, "*batch units"]


class Gates(NamedTuple):
    """Activations of the gates, 0..1, and of the candidate, -1..1."""

    input: Float[Array, "*batch units"]
    forget: Float[Array, "*batch units"]
    candidate: Float[Array, "*batch units"]
    output: Float[Array, "*batch units"]


class _Saved(NamedTuple):
    """What the derivative of `scan` needs; series have a leading axis of frames."""

    recurrence: Array
    initial: Memory
    is_first: Array
    gates: Gates
    memories: Memory


def step(
    recurrence: Float[Array, "units gates"], memory: Memory, drive: Float[Array, "*batch gates"]
) -> tuple[Memory, Gates]:
    """Return the memory after one frame, and the gates that led to it."""
    z = drive + memory.hidden @ recurrence
    # sigmoid(z) = (1 + tanh(z / 2)) / 2, so that all gates are one call of tanh.
    half = jnp.repeat(jnp.asarray([0.5, 0.5, 1.0, 0.5], z.dtype), z.shape[-1] // 4)
    i, f, g, o = jnp.split(jnp.tanh(half * z), 4, axis=-1)
    gates = Gates(input=0.5 + 0.5 * i, forget=0.5 + 0.5 * f, candidate=g, output=0.5 + 0.5 * o)
    cell = gates.forget * memory.cell + gates.input * gates.candidate
    return Memory(hidden=gates.output * jnp.tanh(cell), cell=cell), gates


@jax.custom_vjp
def scan(
    recurrence: Float[Array, "units gates"],
    memory: Memory,
    drive: Float[Array, "frames *batch gates"],
    is_first: Bool[Array, "frames *#batch"],
) -> Memory:
    """Return the memories after every frame; the memory is set to zero before each frame with `is_first`.

    Gradient: in reverse mode only.
    """
    return _scan(recurrence, memory, drive, is_first)[0]


def _scan(recurrence: Array, memory: Memory, drive: Array, is_first: Array) -> tuple[Memory, _Saved]:
    def frame(memory: Memory, now: tuple[Array, Array]) -> tuple[Memory, tuple[Memory, Gates]]:
        drive, is_first = now
        memory, gates = step(recurrence, _empty(memory, is_first), drive)
        return memory, (memory, gates)

    _, (memories, gates) = jax.lax.scan(frame, memory, (drive, is_first))
    return memories, _Saved(recurrence, memory, is_first, gates, memories)


def _differentiate(saved: _Saved, grads: Memory) -> tuple[Array, Memory, Array, None]:
    """Return the gradients with respect to the arguments of `scan` from those with respect to its result."""
    before = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs[:-1]]), saved.initial, saved.memories)
    before = _empty(before, saved.is_first)

    def frame(grad: Memory, now: tuple[Memory, Gates, Array, Array, Array]) -> tuple[Memory, Array]:
        own, (i, f, g, o), cell, cell_before, is_first = now
        squashed = jnp.tanh(cell)
        dh = grad.hidden + own.hidden
        dc = grad.cell + own.cell + dh * o * (1 - squashed**2)
        dz = (dc * g * i * (1 - i), dc * cell_before * f * (1 - f), dc * i * (1 - g**2), dh * squashed * o * (1 - o))
        dz = jnp.concatenate(dz, axis=-1)
        return _empty(Memory(hidden=dz @ saved.recurrence.T, cell=dc * f), is_first), dz

    series = grads, saved.gates, saved.memories.cell, before.cell, saved.is_first
    grad, dz = jax.lax.scan(frame, jax.tree.map(jnp.zeros_like, saved.initial), series, reverse=True)
    units, gates = saved.recurrence.shape
    return before.hidden.reshape(-1, units).T @ dz.reshape(-1, gates), grad, dz, None


def _empty(memory: Memory, is_first: Array) -> Memory:
    return jax.tree.map(lambda x: jnp.where(is_first[..., None], 0, x), memory)


scan.defvjp(_scan, _differentiate)
