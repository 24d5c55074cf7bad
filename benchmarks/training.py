"""How long 1000 epochs of the paper's 15 minutes of walking take, beside the loop that one writes with flax alone.

    python benchmarks/training.py [--epochs 1000]

Both see the same invented walks, half of them to learn from and half to test on, as in the paper: the same windows and
streams, mirrored ones too. Ours is `training.fit`: an epoch and its test is one program, the state goes on from window
to window, and progress is saved. Beside it a Python loop over windows of one jitted step of `nnx.RNN`, which forgets
between windows and does not test; some of its epochs are timed, and scaled.
"""

import os
import platform
import tempfile
import time
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import nnx

from lgmdjax.control import navigator
from lgmdjax.learning import behaviour_cloning, sequences
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episodes import FIELDS, Walk

MINUTES, STRETCHES = 15, 30
ASKED = 120.0  # s for 1000 epochs
LOOPED = 20  # epochs of the loop


def invented(seed: int) -> Walk:
    """A stretch whose nearness drifts; u follows it with noise, the label without."""
    rng, frames = np.random.default_rng(seed), round(MINUTES * 60 * FRAME_RATE / STRETCHES)
    nearness = np.abs(np.cumsum(rng.normal(0, 0.05, (frames, 2)), axis=0))
    u = 1 / (1 + np.exp(-nearness - 0.3 * np.abs(rng.normal(size=(frames, 2)))))
    label = np.clip(1.2 + 0.4 * nearness - 0.3 * nearness[:, ::-1], -1, 2)
    rest = dict.fromkeys(FIELDS, np.zeros(frames)) | {"u": u, "label": label, "velocity": label}
    return Walk(episode=0, robot=0, room=seed, seed=seed, **rest)


def ours(walks: list[Walk], epochs: int) -> float:
    """Seconds of a fit, compilation and checkpoints included."""
    first, second = sequences.halve(walks)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        start = navigator.create(jax.random.key(0))
        behaviour_cloning.fit(start, first, second, behaviour_cloning.Settings(epochs=epochs), checkpoints=folder)
        return time.perf_counter() - began


def looped(walks: list[Walk], epochs: int) -> float:
    """Seconds of as many epochs of the loop, scaled from a few after the first."""

    class Network(nnx.Module):
        def __init__(self, rngs: nnx.Rngs):
            self.memory = nnx.RNN(nnx.OptimizedLSTMCell(2, navigator.UNITS, rngs=rngs), time_major=True)
            self.head = nnx.Linear(navigator.UNITS, 2, rngs=rngs)

        def __call__(self, u: jax.Array) -> jax.Array:
            hidden: Any = self.memory(u)  # with its carry only if asked for
            return self.head(hidden)

    @nnx.jit
    def step(network: Network, optimiser: nnx.Optimizer, u: jax.Array, label: jax.Array) -> jax.Array:
        error, slope = nnx.value_and_grad(lambda network: jnp.mean((network(u) - label) ** 2))(network)
        optimiser.update(network, slope)
        return error

    settings = behaviour_cloning.Settings()
    first, _ = sequences.halve(walks)
    u, label = (_windows(np.concatenate([getattr(walk, name) for walk in first]), settings) for name in ("u", "label"))
    network = Network(nnx.Rngs(0))
    optimiser = nnx.Optimizer(network, optax.rmsprop(1e-3, decay=0.9, eps=1e-7), wrt=nnx.Param)
    seconds = []
    for _ in range(LOOPED + 1):
        began = time.perf_counter()
        for window in range(len(u)):
            error = step(network, optimiser, u[window], label[window])
        jax.block_until_ready(error)
        seconds.append(time.perf_counter() - began)
    return epochs * float(np.median(seconds[1:]))


def _windows(values: np.ndarray, settings: behaviour_cloning.Settings) -> jax.Array:
    """Cut (frames, 2) into (windows, frames, streams, 2), mirrored streams beside the others."""
    size = settings.window * settings.streams
    kept = values[: len(values) // size * size].reshape(settings.streams, -1, settings.window, 2)
    kept = np.moveaxis(kept, 0, 2)
    return jnp.asarray(np.concatenate([kept, kept[..., ::-1]], axis=2), dtype=float)


def main(epochs: int = 1000) -> None:
    """Print both.

    Args:
        epochs: of the fit; the paper has 1000
    """
    walks = [invented(seed) for seed in range(STRETCHES)]
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "flax", "optax"))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {versions}")
    fitted, loop = ours(walks, epochs), looped(walks, epochs)
    print(f"{epochs} epochs of {MINUTES} minutes: {fitted:.0f} s (asked: {ASKED * epochs / 1000:.0f} s)")
    print(f"a loop of nnx.RNN: {loop:.0f} s, {loop / fitted:.2f} times as long")


if __name__ == "__main__":
    tyro.cli(main)
