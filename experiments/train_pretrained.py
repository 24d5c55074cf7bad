"""Train the robot that is part of the package: `python experiments/train_pretrained.py`, 24 minutes on 2 cores.

The pretrained robot is that of one run: its controller with the gait that it was trained on. After an interruption the
same command resumes.
"""

import shutil
import sys
from pathlib import Path

from lgmdjax.cli.main import main
from lgmdjax.paths import DATA_DIR, PRETRAINED_DIR
from lgmdjax.runtime.storage import write_stamp

SCALE, SEED, OUT = "paper", 2026, Path("runs")
FILES = ("fit-gait/shaping.safetensors", "train/controller.safetensors", "train/baselines.npz")


def train_pretrained() -> int:
    """Train the controller and all that it needs, and copy both to where `lgmdjax trial` reads them."""
    code = main(["train", "--scale", SCALE, "--seed", str(SEED), "--out", str(OUT)])
    if code == 0:
        for file in FILES:
            shutil.copy(OUT / f"{SCALE}-{SEED}" / file, PRETRAINED_DIR)
        write_stamp(DATA_DIR, {})
    return code


if __name__ == "__main__":
    sys.exit(train_pretrained())
