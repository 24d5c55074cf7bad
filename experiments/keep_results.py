"""Keep what came of a run, without its walks: `python experiments/keep_results.py runs/paper-2026 experiments/results`.

Walks and checkpoints are hundreds of megabytes, tables and figures two or three. What is kept is a run folder still,
and goes on with the stages that are missing, as far as those do not ask for walks; the report's page asks for some.
"""

import json
import shutil
import sys
from pathlib import Path

import tyro

from lgmdjax.cli.main import guarded
from lgmdjax.errors import InputError
from lgmdjax.runtime.storage import read_json, write_json

WALKS = ("*.parquet", "walk.npz", "trajectories.npz", "walks", "episodes")
DRAWN = ("*.svg", "*.png", "*.npz")
LEFT_OUT = (*WALKS, "checkpoints", "pupils", "start-*", ".lock", "*.partial*", "report")  # fits and walks of a start


def main(run: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], drawn: bool = True) -> None:
    """Copy a run folder, and let the stamps of its stages tell of the files that are kept.

    Args:
        run: the run folder
        out: where a folder of the same name is made, or made anew
        drawn: keep figures, and what the report draws others from; else tables and trained networks alone
    """
    read_json(run / "run.json")
    kept = out / run.name
    if kept.resolve() == run.resolve():
        raise InputError(f"expected another place than that of the run, got {out}; choose another folder")
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(run, kept, ignore=shutil.ignore_patterns(*LEFT_OUT, *(() if drawn else DRAWN)))
    for stamp in kept.glob("*/done.json"):
        told = json.loads(stamp.read_text())
        files = {name: size for name, size in told["files"].items() if (stamp.parent / name).is_file()}
        write_json(stamp, told | {"files": files})
    for folder in sorted(kept.rglob("*"), reverse=True):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    size = sum(path.stat().st_size for path in kept.rglob("*") if path.is_file())
    print(f"{kept}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    sys.exit(guarded(lambda: tyro.cli(main)))
