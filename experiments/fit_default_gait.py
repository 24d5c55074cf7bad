"""Fit the shaping networks that are part of the package: `python experiments/fit_default_gait.py`, a minute on 2 cores.

A robot without a trained controller walks with them. The pretrained robot has its own (`train_pretrained.py`).
"""

import jax
from tqdm import tqdm

from lgmdjax.body import hexapod
from lgmdjax.locomotion import gait_fit, kinematics, shaping
from lgmdjax.paths import DATA_DIR, SHAPING_FILE
from lgmdjax.runtime.storage import write_stamp

STEPS = 6000  # of the optimiser
SEED = 1


def main() -> None:
    """Fit the networks to the regular tripod gait, and write them to where `shaping.load_pretrained` reads them."""
    with tqdm(total=STEPS, desc="shaping networks", unit="step") as bar:

        def show(done: int, loss: float) -> None:
            bar.set_postfix_str(f"{loss**0.5:.2f} mm", refresh=False)
            bar.update(done - bar.n)

        networks = gait_fit.fit(
            kinematics.read_geometry(hexapod.load()), key=jax.random.key(SEED), steps=STEPS, progress=show
        )
    shaping.save(SHAPING_FILE, networks, {"steps": STEPS, "seed": SEED})
    write_stamp(DATA_DIR, {})


if __name__ == "__main__":
    main()
