"""Copy a run without its walks: `python experiments/keep_results.py runs/paper-2026 experiments/results`.

Walks and checkpoints take hundreds of megabytes, tables and figures two or three. The copy is a run folder: commands
resume in it with the stages that are missing, except those that read recorded walks, the report among them.
"""

import json
import shutil
import sys
from pathlib import Path

import tyro

from lgmdjax.cli.main import exit_code
from lgmdjax.errors import InputError
from lgmdjax.runtime import checksums
from lgmdjax.runtime.storage import read_json, write_json

WALKS = ("*.parquet", "walk.npz", "trajectories.npz", "walks", "episodes")
FITS = ("checkpoints", "learners", "pupils", "repeat-*", "start-*", "tube-*")  # with the walks that belong to them
OTHER = (".lock", "*.partial*", "report")
FIGURES = ("*.svg", "*.png", "*.npz")


def main(run: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], figures: bool = True) -> None:
    """Copy a run folder without its walks, and list in the record of each stage the files that are kept.

    Args:
        run: the run folder
        out: the folder that gets a folder of the same name, in place of one that is there
        figures: keep figures and the arrays that the report plots; without, only tables and trained networks
    """
    read_json(run / "run.json")
    copy = out / run.name
    if copy.resolve() == run.resolve():
        raise InputError(f"expected another folder than that of the run, got {out}; choose another")
    shutil.rmtree(copy, ignore_errors=True)
    ignored = (*WALKS, *FITS, *OTHER, *(() if figures else FIGURES))
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns(*ignored))
    for record in copy.glob("*/done.json"):
        facts = json.loads(record.read_text(encoding="utf-8"))
        files = {name: size for name, size in facts["files"].items() if (record.parent / name).is_file()}
        had_checksum = facts.pop(checksums.CHECKSUM_KEY, None) is not None  # those of older versions are not
        facts["files"] = files
        write_json(record, checksums.add_checksum(facts) if had_checksum else facts)
    for folder in sorted(copy.rglob("*"), reverse=True):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    size = sum(path.stat().st_size for path in copy.rglob("*") if path.is_file())
    print(f"{copy}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: tyro.cli(main)))
