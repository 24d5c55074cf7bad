"""A fit by one or several processes: `python fit_in_processes.py FOLDER EPOCHS [ADDRESS PROCESSES PROCESS]`."""

import sys
import time
from pathlib import Path

import jax
import numpy as np

from lgmdjax.control import navigator
from lgmdjax.learning import behaviour_cloning
from lgmdjax.runtime import distributed
from lgmdjax.simulation import sharding
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episodes import FIELDS, Walk

FRAMES, ROBOTS = 1500, 16


def make_walks(generator: np.random.Generator) -> list[Walk]:
    """Make walks whose labels are a delayed difference of u, with noise."""
    walks = []
    for room in range(ROBOTS):
        u = 0.5 + 0.2 * np.abs(np.cumsum(generator.normal(0, 0.05, (FRAMES, 2)), axis=0) % 1)
        label = 1.3 - 2.0 * (np.roll(u, 5, axis=0) - 0.5) + generator.normal(0, 0.1, u.shape)
        fields = {name: np.zeros((FRAMES, *field.shape), np.float32) for name, field in FIELDS.items()}
        fields |= {"u": u.astype(np.float32), "label": label.astype(np.float32), "ok": np.ones(FRAMES, bool)}
        fields |= {"time": np.arange(FRAMES) / FRAME_RATE, "velocity": fields["label"]}
        walks.append(Walk(episode=0, robot=room, room=room, seed=0, **fields))
    return walks


def main(folder: Path, epochs: int, address: str, processes: int, process: int) -> None:
    if processes > 1:
        distributed.start(address, processes, process, seconds=120)
    walks = make_walks(np.random.default_rng(0))
    settings = behaviour_cloning.Settings(epochs=epochs)
    start = navigator.create(jax.random.key(0), "lstm")
    began = time.perf_counter()
    fit = behaviour_cloning.fit(start, walks[:12], walks[12:], settings, checkpoints=folder / "checkpoints")
    seconds = time.perf_counter() - began
    devices = len(sharding.stream_devices(settings.streams))
    weights = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(fit.best.weights)])
    np.savez(
        folder / f"fit-{process}.npz",
        train=fit.train_mse,
        test=fit.test_mse,
        devices=np.asarray(devices),
        weights=weights,
    )
    print(f"{epochs} epochs in {seconds:.1f} s on {devices} devices of {processes} processes", flush=True)
    distributed.leave()


if __name__ == "__main__":
    place = sys.argv[3:] or ("", "1", "0")
    main(Path(sys.argv[1]), int(sys.argv[2]), place[0], int(place[1]), int(place[2]))
