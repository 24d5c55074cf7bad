"""Teach the shaping networks that come with the package: `python experiments/teach_gait.py` (a minute on two cores)."""

import jax
from tqdm import tqdm

from lgmdjax.body import hexapod
from lgmdjax.locomotion import gait_fit, kinematics, shaping
from lgmdjax.paths import SHAPING

STEPS, SEED = 6000, 1


def main() -> None:
    """Fit the networks to the regular tripod gait and keep them where `shaping.taught` finds them."""
    with tqdm(total=STEPS, desc="shaping networks", unit="step") as bar:

        def show(done: int, loss: float) -> None:
            bar.set_postfix_str(f"{loss**0.5:.2f} mm", refresh=False)
            bar.update(done - bar.n)

        networks = gait_fit.teach(
            kinematics.geometry(hexapod.load()), key=jax.random.key(SEED), steps=STEPS, progress=show
        )
    shaping.save(SHAPING, networks, {"steps": STEPS, "seed": SEED})


if __name__ == "__main__":
    main()
