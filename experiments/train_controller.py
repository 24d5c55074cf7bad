"""Train the controller that comes with the package: `python experiments/train_controller.py` (half an hour, two cores).

As `lgmdjax train --scale paper` does, but for the networks that the paper's is compared with.
The eyes have pictures of 80 x 60, whose cells look at as many degrees as those of the paper's 320 x 240 do, and say the
same (the difference of the two u correlates with 0.996): the walk is ten times as fast. Interrupted, the same command
carries on.
"""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import tyro

from lgmdjax import scales
from lgmdjax.cli import guarded, import_physics, prepare_jax

PAPER = scales.SCALES["paper"]
SETTINGS = {
    "fit-gait": PAPER["fit-gait"],
    "collect": replace(PAPER["collect"], eyes=PAPER["train"].eyes, calibration_seconds=20),
    "train": replace(PAPER["train"], variants=("lstm",), halves_epochs=80),
}
FILES = ("controller.safetensors", "baselines.npz")


def main(out: Path = Path("runs"), seed: int = 0) -> None:
    """Train, and put the controller where `lgmdjax trial` finds it.

    Args:
        out: folder of the run folder
        seed: of everything that is drawn at random
    """
    prepare_jax()  # before anything imports JAX
    import_physics()
    from lgmdjax.runs import execute, open_run
    from lgmdjax.stages import STAGES, crew

    train = execute(open_run(out, f"controller-{seed}", "controller", seed, SETTINGS), STAGES, "train")
    for name in FILES:
        shutil.copyfile(train / name, crew.DATA / name)


if __name__ == "__main__":
    sys.exit(guarded(lambda: tyro.cli(main)))
