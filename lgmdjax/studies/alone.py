"""A study by itself, as the scripts in `experiments/` start it: with the robot that comes along, or with a run's."""

from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import Any

import tyro

from lgmdjax import figures, files, scales
from lgmdjax.runs import Stage, execute, open_run
from lgmdjax.stages import crew

ARGUMENTS = """
Args:
    settings: how much of it
    run: folder of the run whose robot walks; the one that comes along if left out
    seed: of rooms and starts
    out: the results go into a folder of the study's name in here
"""


def run(study: str) -> None:
    """Read the flags of a study from the command line, and do it."""
    tyro.cli(command(study))


def command(study: str) -> Callable[..., None]:
    """Make the command of a study, for `tyro.cli`."""
    module, default = import_module(f"lgmdjax.studies.{study}"), scales.SCALES["paper"][study]

    def main(settings: Any = default, run: Path | None = None, seed: int = 0, out: Path = Path("runs/studies")) -> None:
        inputs = _inputs(run)
        robot = crew.digest(crew.trained(inputs["fit-gait"], inputs["train"]))

        def work(folder: Path, _: Mapping[str, Path], settings: Any, seed: int) -> None:
            module.work(folder, inputs, settings, seed)
            rows = files.read_json(folder / f"{study}.json")
            (folder / f"{study}.png").write_bytes(figures.to_png(module.draw(rows)))

        place = open_run(out, f"{study}-{seed}", "study", seed, {study: settings, "robot": robot})
        print(f"look into {execute(place, (Stage(name=study, work=work),), study)}")

    main.__doc__ = f"{cleandoc(module.__doc__ or '')}\n\n{cleandoc(ARGUMENTS)}"
    main.__annotations__["settings"] = type(default)
    return main


def _inputs(run: Path | None) -> dict[str, Path]:
    if run is None:
        return {"fit-gait": crew.DATA, "train": crew.DATA}
    return {name: run / name for name in ("fit-gait", "collect", "train")}
