"""Time of an epoch on 15 minutes of walks, as in the paper, beside training loops in PyTorch and flax.

    python benchmarks/training.py [--epochs 10] [--rounds 10]

All train on the same synthetic walks, with the same windows, streams and mirror images, the same loss and RMSprop; half
of the walks are for training and half for testing, as in the paper. They take turns in every round.

| candidate            | what it does                                                                              |
| -------------------- | ----------------------------------------------------------------------------------------- |
| fit                  | `behaviour_cloning.fit`: each epoch and its test in one program                           |
| fit, hardly any test | the same, tested on one segment                                                           |
| PyTorch              | `nn.LSTM` and `nn.Linear`; the state continues between windows; no test; if installed     |
| nnx.RNN              | one jitted step for each window, from a new state; no test                                |

Times are those of the wall clock. Other programs on the machine lengthen them, so that the minimum says more.
"""

import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
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
TARGET = 0.6  # of PyTorch's time

Candidate = Callable[[int], object]  # trains for a number of epochs


def synthetic_walk(seed: int) -> Walk:
    """Return a segment in which proximity drifts; u follows it with noise, the label without."""
    rng, frames = np.random.default_rng(seed), round(MINUTES * 60 * FRAME_RATE / SEGMENTS)
    proximity = np.abs(np.cumsum(rng.normal(0, 0.05, (frames, 2)), axis=0))
    u = 1 / (1 + np.exp(-proximity - 0.3 * np.abs(rng.normal(size=(frames, 2)))))
    label = np.clip(1.2 + 0.4 * proximity - 0.3 * proximity[:, ::-1], -1, 2)
    rest = dict.fromkeys(FIELDS, np.zeros(frames)) | {"u": u, "label": label, "velocity": label}
    return Walk(episode=0, robot=0, room=seed, seed=seed, **rest)


def fit(train: list[Walk], test: list[Walk]) -> Candidate:
    """Return a fit; its program is compiled for each number of epochs."""

    def run(epochs: int) -> None:
        settings = behaviour_cloning.Settings(epochs=epochs)
        behaviour_cloning.fit(navigator.create(jax.random.key(0)), train, test, settings, show_progress=False)

    return run


def torch_loop(train: list[Walk], threads: int) -> Candidate:
    """Return a loop over the windows in PyTorch."""
    import torch  # pyright: ignore[reportMissingImports]  (no dependency of the package)

    settings = behaviour_cloning.Settings()
    u, label = (torch.from_numpy(np.array(windows)) for windows in _inputs_and_labels(train, settings))
    memory, head = torch.nn.LSTM(2, navigator.UNITS), torch.nn.Linear(navigator.UNITS, 2)
    weights = [*memory.parameters(), *head.parameters()]
    optimiser = torch.optim.RMSprop(weights, lr=settings.learning_rate, alpha=0.9, eps=1e-7)

    def run(epochs: int) -> None:
        torch.set_num_threads(threads)
        for _ in range(epochs):
            state = None
            for now, wanted in zip(u, label, strict=True):
                hidden, state = memory(now, state)
                state = tuple(part.detach() for part in state)
                optimiser.zero_grad()
                torch.mean((head(hidden) - wanted) ** 2).backward()
                torch.nn.utils.clip_grad_norm_(weights, settings.clip)
                optimiser.step()

    return run


def flax_loop(train: list[Walk]) -> Candidate:
    """Return a loop over the windows in flax."""

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
    u, label = (list(map(jnp.asarray, windows)) for windows in _inputs_and_labels(train, settings))
    network, rule = Network(nnx.Rngs(0)), optax.rmsprop(settings.learning_rate, decay=0.9, eps=1e-7)
    rule = optax.chain(optax.clip_by_global_norm(settings.clip), rule)
    optimiser = nnx.Optimizer(network, rule, wrt=nnx.Param)

    def run(epochs: int) -> None:
        for _ in range(epochs):
            errors = [step(network, optimiser, *window) for window in zip(u, label, strict=True)]
            jax.block_until_ready(errors[-1])

    return run


def _inputs_and_labels(walks: list[Walk], settings: behaviour_cloning.Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return u and labels of all windows, standardised, as (windows, frames, streams, 2)."""
    params = behaviour_cloning.standardise(navigator.create(jax.random.key(0)), walks)
    batch = sequences.pack(
        walks, np.asarray(params.output_mean), streams=settings.streams, window=settings.window, mirrored=True
    )
    u = (batch.u - params.input_mean) / params.input_scale
    return np.asarray(u), np.asarray((batch.label - params.output_mean) / params.output_scale)


def main(epochs: int = 10, rounds: int = 10) -> None:
    """Print the time of an epoch of every candidate.

    Args:
        epochs: of each candidate in a round
        rounds: in which all candidates take turns
    """
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # a fit uses all cores, as in the command line
    first, second = sequences.split_halves([synthetic_walk(seed) for seed in range(SEGMENTS)])
    candidates = {"fit": fit(first, second), "fit, hardly any test": fit(first, second[:1])}
    candidates["nnx.RNN"] = flax_loop(first)
    packages = ["jax", "flax", "optax"]
    if find_spec("torch"):
        threads = sorted({1, os.cpu_count() or 1})
        candidates |= {f"PyTorch, threads: {count}": torch_loop(first, count) for count in threads}
        packages.append("torch")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {versions}")
    for run in candidates.values():
        run(epochs)
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, run in candidates.items():
            began = time.perf_counter()
            run(epochs)
            times[name].append((time.perf_counter() - began) / epochs)
    _print(times)


def _print(times: dict[str, list[float]]) -> None:
    print("candidate               ms an epoch: least  median   ratios to `fit`")
    for name, seconds in times.items():
        least, median = (1000 * f(seconds) for f in (min, statistics.median))
        ratios = (f(times["fit"]) / f(seconds) for f in (min, statistics.median))
        print(f"{name:24s}{least:18.1f}{median:8.1f}   " + ", ".join(f"fit takes {ratio:.2f}" for ratio in ratios))
    print(f"target: fit takes {TARGET} of PyTorch")


if __name__ == "__main__":
    tyro.cli(main)
