"""The feed-forward actor: how long it holds a command, and which u it reads."""

import jax
import jax.numpy as jnp
import numpy as np

from lgmdjax.control import actor, perceptron


def test_commands_are_held_and_read_the_u_of_the_last_commands():
    """Against a loop in NumPy."""
    params = actor.Params(layers=perceptron.create(jax.random.key(0), (4, 8, 2)), depth=2, hold=3)
    u = np.random.default_rng(0).uniform(0.5, 1.0, (8, 2))
    found = jax.lax.scan(lambda state, now: actor.step(params, state, now), actor.init(params), jnp.asarray(u))[1]
    weights = [(np.asarray(layer.kernel), np.asarray(layer.bias)) for layer in params.layers]
    for frame in range(8):
        newest = frame - frame % 3
        x = np.concatenate([u[max(newest - 3, 0)], u[newest]])
        hidden = np.tanh((x - 0.5) / 0.1 @ weights[0][0] + weights[0][1])
        action = np.tanh(hidden @ weights[1][0] + weights[1][1])
        np.testing.assert_allclose(found[frame], -1 + 1.5 * (action + 1), rtol=1e-9)
