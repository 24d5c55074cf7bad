"""The LSTM layer: both of its forms against NumPy, and the derivative written by hand against JAX's and differences."""

import jax
import jax.numpy as jnp
import numpy as np
from reference import navigator as reference

from lgmdjax.control import lstm

FRAMES, STREAMS, UNITS = 9, 3, 5
RNG = np.random.default_rng(0)
RECURRENCE = RNG.normal(size=(UNITS, 4 * UNITS)) / 2
DRIVE = RNG.normal(size=(FRAMES, STREAMS, 4 * UNITS))
MEMORY = lstm.Memory(*RNG.normal(size=(2, STREAMS, UNITS)) / 2)
IS_FIRST = np.zeros((FRAMES, STREAMS), bool)
IS_FIRST[0, 1] = IS_FIRST[4, 1:] = True


def stepwise(recurrence, memory, drive, is_first):
    """Memories after every frame, from single steps; JAX derives it."""

    def frame(memory, now):
        drive, first = now
        memory = jax.tree.map(lambda x: jnp.where(first[:, None], 0, x), memory)
        memory, _ = lstm.step(recurrence, memory, drive)
        return memory, memory

    return jax.lax.scan(frame, memory, (drive, is_first))[1]


def arguments():
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=float), (RECURRENCE, MEMORY, DRIVE))


def test_both_forms_equal_keras(precision):
    """Each stream from an empty memory, and again after its reset."""
    recurrence, memory, drive = arguments()
    empty, starts = jax.tree.map(jnp.zeros_like, memory), jnp.asarray(IS_FIRST)
    for form in (lstm.scan, stepwise):
        hidden = np.asarray(jax.jit(form)(recurrence, empty, drive, starts).hidden)
        for stream, start in enumerate((0, 4, 4)):
            for part in (slice(0, start), slice(start, FRAMES)):
                expected = reference.lstm(
                    DRIVE[part, stream], np.eye(4 * UNITS), RECURRENCE, np.zeros(4 * UNITS), np.eye(UNITS), np.zeros(1)
                )
                tolerance = 1e-13 if precision == "float64" else 1e-6
                np.testing.assert_allclose(hidden[part, stream], expected.reshape(-1, UNITS), atol=tolerance)


def test_the_derivative_is_that_of_single_steps_and_of_differences():
    """By the recurrence, the first memory and the drive, of a function of all hidden states and cells."""
    weights = lstm.Memory(*RNG.normal(size=(2, FRAMES, STREAMS, UNITS)))

    def loss(form, arguments):
        memories = form(*arguments, jnp.asarray(IS_FIRST))
        return sum(jax.tree.leaves(jax.tree.map(lambda w, x: jnp.sum(w * x**2), weights, memories)))

    at = arguments()
    value = jax.jit(lambda x: loss(lstm.scan, x))
    by_hand = jax.jit(jax.grad(value))(at)
    expected = jax.jit(jax.grad(lambda x: loss(stepwise, x)))(at)
    for got, wanted in zip(jax.tree.leaves(by_hand), jax.tree.leaves(expected), strict=True):
        assert np.abs(wanted).max() > 0.1
        np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-12)
    direction = jax.tree.map(lambda x: jnp.asarray(RNG.normal(size=x.shape)), at)
    ends = [value(jax.tree.map(lambda x, d, s=s: x + s * d, at, direction)) for s in (1e-6, -1e-6)]
    slope = sum(jax.tree.leaves(jax.tree.map(lambda g, d: jnp.sum(g * d), by_hand, direction)))
    np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, slope, rtol=1e-7)
    # Nothing before a stream's first frame has an effect.
    np.testing.assert_array_equal(by_hand[1].hidden[1], 0)
