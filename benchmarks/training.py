"""Time of 1000 epochs on 15 minutes of walks, as in the paper, compared with a training loop in flax.

    python benchmarks/training.py [--epochs 1000]

Both train on the same synthetic walks, with the same windows and streams and their mirror images; half of the walks are
for training and half for testing, as in the paper.

| candidate               | what it does                                                                              |
| ----------------------- | ----------------------------------------------------------------------------------------- |
| `behaviour_cloning.fit` | each epoch and its test in one program; the state continues between windows; checkpoints  |
| a loop of `nnx.RNN`     | one jitted step for each window, from a new state; no test; a few epochs timed and scaled |
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

MINUTES, SEGMENTS = 15, 30
TARGET = 120.0  # s for 1000 epochs
LOOP_EPOCHS = 20  # that are timed


def synthetic_walk(seed: int) -> Walk:
    """Return a segment in which proximity drifts; u follows it with noise, the label without."""
    rng, frames = np.random.default_rng(seed), round(MINUTES * 60 * FRAME_RATE / SEGMENTS)
    proximity = np.abs(np.cumsum(rng.normal(0, 0.05, (frames, 2)), axis=0))
    u = 1 / (1 + np.exp(-proximity - 0.3 * np.abs(rng.normal(size=(frames, 2)))))
    label = np.clip(1.2 + 0.4 * proximity - 0.3 * proximity[:, ::-1], -1, 2)
    rest = dict.fromkeys(FIELDS, np.zeros(frames)) | {"u": u, "label": label, "velocity": label}
    return Walk(episode=0, robot=0, room=seed, seed=seed, **rest)


def measure_fit(walks: list[Walk], epochs: int) -> float:
    """Return the time of a fit with compilation and checkpoints [s]."""
    first, second = sequences.split_halves(walks)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        initial = navigator.create(jax.random.key(0))
        behaviour_cloning.fit(initial, first, second, behaviour_cloning.Settings(epochs=epochs), checkpoints=folder)
        return time.perf_counter() - began


def measure_loop(walks: list[Walk], epochs: int) -> float:
    """Return the time of as many epochs of the loop, scaled from a few epochs after the first [s]."""

    class Network(nnx.Module):
        def __init__(self, rngs: nnx.Rngs):
            self.memory = nnx.RNN(nnx.OptimizedLSTMCell(2, navigator.UNITS, rngs=rngs), time_major=True)
            self.head = nnx.Linear(navigator.UNITS, 2, rngs=rngs)

        def __call__(self, u: jax.Array) -> jax.Array:
            hidden: Any = self.memory(u)  # with its carry only if asked for
            return self.head(hidden)

    @nnx.jit
    def step(network: Network, optimiser: nnx.Optimizer, u: jax.Array, label: jax.Array) -> jax.Array:
        error, grad = nnx.value_and_grad(lambda network: jnp.mean((network(u) - label) ** 2))(network)
        optimiser.update(network, grad)
        return error

    settings = behaviour_cloning.Settings()
    first, _ = sequences.split_halves(walks)
    u, label = (_windows(np.concatenate([getattr(walk, name) for walk in first]), settings) for name in ("u", "label"))
    network = Network(nnx.Rngs(0))
    optimiser = nnx.Optimizer(network, optax.rmsprop(1e-3, decay=0.9, eps=1e-7), wrt=nnx.Param)
    seconds = []
    for _ in range(LOOP_EPOCHS + 1):
        began = time.perf_counter()
        for window in range(len(u)):
            error = step(network, optimiser, u[window], label[window])
        jax.block_until_ready(error)
        seconds.append(time.perf_counter() - began)
    return epochs * float(np.median(seconds[1:]))


def _windows(values: np.ndarray, settings: behaviour_cloning.Settings) -> jax.Array:
    """Cut (frames, 2) into (windows, frames, streams, 2), and append the mirrored streams."""
    size = settings.window * settings.streams
    kept = values[: len(values) // size * size].reshape(settings.streams, -1, settings.window, 2)
    kept = np.moveaxis(kept, 0, 2)
    return jnp.asarray(np.concatenate([kept, kept[..., ::-1]], axis=2), dtype=float)


def main(epochs: int = 1000) -> None:
    """Print both times.

    Args:
        epochs: number of epochs, 1000 in the paper
    """
    walks = [synthetic_walk(seed) for seed in range(SEGMENTS)]
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "flax", "optax"))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {versions}")
    fit, loop = measure_fit(walks, epochs), measure_loop(walks, epochs)
    print(f"{epochs} epochs of {MINUTES} minutes: {fit:.0f} s (target: {TARGET * epochs / 1000:.0f} s)")
    print(f"a loop of nnx.RNN: {loop:.0f} s, {loop / fit:.2f} times as long")


if __name__ == "__main__":
    tyro.cli(main)
