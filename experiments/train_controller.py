"""Train the robot that comes with the package: `python experiments/train_controller.py` (an hour, two cores).

It is that of `lgmdjax train --scale paper --seed 2026`, put where `lgmdjax trial` finds it, with the gait that it
learned on: on another one, taught alike, it turned from a tube in 2 of 6 walks, on its own in 12 of 12. Interrupted,
the same command carries on.
"""

import shutil
import sys
from pathlib import Path

import tyro

from lgmdjax.cli.main import guarded
from lgmdjax.paths import PRETRAINED
from lgmdjax.pipeline import scales
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax

FILES = {"fit-gait": ("shaping.safetensors",), "train": ("controller.safetensors", "baselines.npz")}


def main(out: Path = Path("runs"), seed: int = 2026) -> None:
    """Train, and keep gait and controller.

    Args:
        out: folder of the run folder
        seed: of everything that is drawn at random
    """
    prepare_jax()  # before anything imports JAX
    import_physics()
    from lgmdjax.pipeline.stages import STAGES
    from lgmdjax.runtime.run_folders import execute, open_run

    train = execute(open_run(out, f"paper-{seed}", "paper", seed, scales.SCALES["paper"]), STAGES, "train")
    for stage, names in FILES.items():
        for name in names:
            shutil.copyfile(train.parent / stage / name, PRETRAINED / name)


if __name__ == "__main__":
    sys.exit(guarded(lambda: tyro.cli(main)))
