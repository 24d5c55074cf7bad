"""An experiment by itself, as the scripts in `experiments/` start it: with the robot that comes along, or a run's."""

from collections.abc import Callable, Mapping
from functools import partial
from inspect import cleandoc
from pathlib import Path
from typing import Any, get_args

import tyro

from lgmdjax.cli.main import AttemptFlags, Who
from lgmdjax.evaluation import run_trial
from lgmdjax.paths import PRETRAINED
from lgmdjax.pipeline import scales
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.run_folders import Stage, execute, open_run
from lgmdjax.simulation import assembly
from lgmdjax.studies import (
    closed_loop_finetune,
    errata,
    failure_modes,
    gait_gradient,
    gradient_horizon,
    lgmd_gradient,
    sensitivity,
    supervision,
    velocity,
)

STUDIES = {
    "velocity": velocity,
    "sensitivity": sensitivity,
    "supervision": supervision,
    "errata": errata,
    "failure_modes": failure_modes,
    "gait_gradient": gait_gradient,
    "lgmd_gradient": lgmd_gradient,
    "gradient_horizon": gradient_horizon,
    "closed_loop_finetune": closed_loop_finetune,
}

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
    module, default = STUDIES[study], {**scales.SCALES["paper"], **scales.GRADIENTS}[study]

    def main(settings: Any = default, run: Path | None = None, seed: int = 0, out: Path = Path("runs/studies")) -> None:
        inputs = _inputs(run)
        robot = assembly.digest(assembly.trained(inputs["fit-gait"], inputs["train"]))

        def work(folder: Path, _: Mapping[str, Path], settings: Any, seed: int) -> None:
            module.work(folder, inputs, settings, seed)
            rows = storage.read_json(folder / f"{study}.json")
            (folder / f"{study}.png").write_bytes(style.to_png(module.draw(rows)))

        place = open_run(out, f"{study}-{seed}", "study", seed, {study: settings, "robot": robot})
        print(f"look into {execute(place, (Stage(name=study, work=work),), study)}")

    main.__doc__ = f"{cleandoc(module.__doc__ or '')}\n\n{cleandoc(ARGUMENTS)}"
    main.__annotations__["settings"] = type(default)
    return main


def compare(*trials: str) -> None:
    """Read the flags of `walked_by` from the command line, and do it."""
    tyro.cli(partial(walked_by, trials))


def walked_by(
    trials: tyro.conf.Suppress[tuple[str, ...]], attempts: AttemptFlags, who: tuple[Who, ...] = get_args(Who)
) -> None:
    """Let several drivers walk experiments of the paper's, as `lgmdjax trial` does one, and print what came of each.

    Args:
        trials: names of the experiments
        who: the drivers that walk
    """
    for name in trials:
        for driver in who:
            folder = run_trial.attempt(name, driver, **vars(attempts))
            print(f"{name}, {driver}: {told(storage.read_json(folder / 'outcome.json'))}; look into {folder}")


def told(outcome: Mapping[str, Any]) -> str:
    """Say in a line what came of a trial."""
    if "per_100_m" in outcome:
        return f"{outcome['collisions']} collisions in {outcome['distance']:.0f} m"
    untouched = f"{outcome['untouched']} of {outcome['robots']} untouched"
    return f"{untouched}; {outcome['passed']} passed, {outcome['retreated']} turned back"


def _inputs(run: Path | None) -> dict[str, Path]:
    if run is None:
        return {"fit-gait": PRETRAINED, "train": PRETRAINED}
    return {name: run / name for name in ("fit-gait", "collect", "train")}
