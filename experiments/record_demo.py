"""Record the walk of `lgmdjax demo`: `python experiments/record_demo.py`, three minutes on 2 cores.

The pretrained robot walks in a random room, with the cameras of its training. Writes lgmdjax/data/demo.npz.
"""

import numpy as np
from tqdm import tqdm

from lgmdjax.paths import DATA_DIR
from lgmdjax.reporting import playback
from lgmdjax.runtime.jax_setup import prepare_jax

SEED = 8  # of the room
SECONDS = 40


def main() -> None:
    """Simulate the walk frame by frame, as the live viewer does, and write it."""
    prepare_jax()
    from lgmdjax.runtime.storage import write_stamp
    from lgmdjax.viewer.live import LiveSimulation
    from lgmdjax.viewer.messages import Controls, Live

    simulation = LiveSimulation(Live(seed=SEED), Controls(), lambda report: None)
    room = simulation.entered()
    frames = [simulation.advance() for _ in tqdm(range(SECONDS * playback.FRAME_RATE), desc="walk", unit="frame")]
    series = {name: np.stack([getattr(frame, name) for frame in frames]) for name in SERIES}
    walk = playback.Playback(title="random room", room=room.shape, centres=room.centres[None], **series)
    playback.save(DATA_DIR / "demo.npz", walk)
    write_stamp(DATA_DIR, {})


SERIES = ("time", "qpos", "u", "velocity", "contact", "is_first", "pictures", "layers")

if __name__ == "__main__":
    main()
