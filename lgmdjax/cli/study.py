"""`lgmdjax study`: one study, with the pretrained robot or with the robot of a run."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from matplotlib.figure import Figure

from lgmdjax.cli import tracking
from lgmdjax.cli.flags import StudyFlags
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.run_folders import Stage, execute, open_run
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly
from lgmdjax.studies import (
    closed_loop_finetune,
    errata,
    failure_modes,
    gait_gradient,
    gradient_horizon,
    lgmd_gradient,
    overlap,
    sensitivity,
    supervision,
    transfer,
    velocity,
)


class Study(Protocol):
    """The interface of the modules of `lgmdjax.studies`."""

    run: Callable[..., None]
    plot: Callable[[Sequence[JsonObject]], Figure]


MODULES: Mapping[str, Study] = {
    "velocity": velocity,
    "supervision": supervision,
    "errata": errata,
    "failure_modes": failure_modes,
    "sensitivity": sensitivity,
    "overlap": overlap,
    "gait_gradient": gait_gradient,
    "lgmd_gradient": lgmd_gradient,
    "gradient_horizon": gradient_horizon,
    "closed_loop_finetune": closed_loop_finetune,
    "transfer": transfer,
}


def run_study(name: str, flags: StudyFlags) -> Path:
    """Run a study, or resume it, and return the folder with its table <name>.json and its figure <name>.png."""
    tracking.check(flags.track)
    inputs = _input_folders(flags.run)
    robot = assembly.load_robot(inputs["fit-gait"], inputs["train"])

    def work(folder: Path, _: Mapping[str, Path], settings: object, seed: int) -> None:
        MODULES[name].run(folder, inputs, settings, seed)
        rows = storage.read_table(folder / f"{name}.json")
        (folder / f"{name}.png").write_bytes(style.to_png(MODULES[name].plot(rows)))

    facts = {name: flags.settings, "robot": assembly.fingerprint(robot)}
    run = open_run(flags.out, flags.name or f"{name}-{flags.seed}", "study", flags.seed, facts)
    with tracking.log_to(flags.track, run.folder):
        return execute(run, (Stage(name=name, run=work),), name)


def _input_folders(run: Path | None) -> dict[str, Path]:
    """Return the folders of the stages that a study reads; the pretrained robot has no recorded walks."""
    if run is None:
        return {"fit-gait": PRETRAINED_DIR, "train": PRETRAINED_DIR}
    return {stage: run / stage for stage in ("fit-gait", "collect", "train")}
