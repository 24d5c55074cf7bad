"""Train the controller that comes with the package: `python experiments/train_controller.py` (half an hour, two cores).

As `lgmdjax train --scale paper`, at the paper's resolution, but with three rounds of the robot's own walks and fewer
epochs, which is enough. Interrupted, the same command carries on.
"""

import shutil
from pathlib import Path

import tyro

from lgmdjax import scales
from lgmdjax.cli import import_physics, prepare_jax
from lgmdjax.runs import execute, open_run
from lgmdjax.stages import STAGES, crew

PAPER = scales.SCALES["paper"]
EYES = PAPER["collect"].eyes
SETTINGS = dict(PAPER) | {
    "collect": scales.Collect(eyes=EYES, robots=16, episodes=2, seconds=28.125, calibration_seconds=20),
    "train": scales.Train(eyes=EYES, epochs=200, rounds=3, round_epochs=80, robots=16, round_seconds=60),
}
FILES = ("controller.safetensors", "baselines.npz")


def main(out: Path = Path("runs"), seed: int = 0) -> None:
    """Train, and put the controller where `lgmdjax trial` finds it.

    Args:
        out: folder of the run folder
        seed: of everything that is drawn at random
    """
    prepare_jax()
    import_physics()
    train = execute(open_run(out, f"controller-{seed}", "controller", seed, SETTINGS), STAGES, "train")
    for name in FILES:
        shutil.copyfile(train / name, crew.DATA / name)


if __name__ == "__main__":
    tyro.cli(main)
