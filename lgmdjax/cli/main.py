"""The command line: one function a subcommand, whose arguments are its flags.

What a user can get wrong ends in one line on stderr and exit code 2; an interruption in 130.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from lgmdjax import __version__
from lgmdjax.errors import InputError
from lgmdjax.pipeline.scales import SCALES, Scale
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """Which run folder, and what it is made with."""

    scale: Scale = "quick"
    """smoke goes through every stage in minutes, quick shows the result, paper uses the paper's figures"""
    out: Path = Path("runs")
    """folder of the run folders"""
    seed: int = 0
    """seed of everything that is drawn at random"""
    name: str = ""
    """name of the run folder; <scale>-<seed> if empty"""


@dataclass(frozen=True, kw_only=True)
class Attempts:
    """Flags of whoever walks experiments of the paper."""

    seed: int = 0
    """of rooms, textures and starts"""
    seeds: int | None = None
    """how many times; as many as the paper has, or more, if left out"""
    width: int | None = None
    """of the pictures [px], 320 as in the paper; as it learned with, which says nearly the same, if left out"""
    run: Path | None = None
    """folder of the run whose robot walks; the trained one that comes along if left out"""
    out: Path = Path("runs/trials")
    """the results go into a folder a trial and driver in here"""


Name = Literal["testing", "unseen", "tube", "indoor", "outdoor", "dynamic", "white", "corner"]
Who = Literal["teacher", "learned", "blind", "direct", "random"]
Flags = Annotated[Pipeline, tyro.conf.arg(name="")]
AttemptFlags = Annotated[Attempts, tyro.conf.arg(name="")]


def reproduce(pipeline: Flags) -> None:
    """Fit the gait, collect, train, evaluate, and leave a report; what is done already is skipped."""
    print(f"open {_execute(pipeline, 'report') / 'index.html'}")


def fit_gait(pipeline: Flags) -> None:
    """Teach the shaping networks the regular tripod gait."""
    _execute(pipeline, "fit-gait")


def collect(pipeline: Flags) -> None:
    """Record the teacher's walks in training rooms (and the gait before, if it is not there)."""
    _execute(pipeline, "collect")


def train(pipeline: Flags) -> None:
    """Fit the navigator to the recorded walks (and what they need, if it is not there)."""
    _execute(pipeline, "train")


def evaluate(pipeline: Flags) -> None:
    """Walk all drivers in the paper's experiments and in unseen rooms (and do the stages before, if need be)."""
    _execute(pipeline, "evaluate")


def report(pipeline: Flags) -> None:
    """Write the report page (and do the stages before, if they are not there)."""
    print(f"open {_execute(pipeline, 'report') / 'index.html'}")


def doctor(*, out: Path = Path("runs")) -> int:
    """Check this machine: versions, devices, arithmetic, physics, video, disk; exit code 1 on a FAIL.

    Args:
        out: the folder that runs would be written to
    """
    from lgmdjax.cli.doctor import examine

    return examine(out)


def watch(
    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="video")],
    *,
    stereo: Literal["side-by-side"] | None = None,
    mono: tyro.conf.FlagCreatePairsOff[bool] = False,
    out: Path = Path("runs/watch"),
    table: Literal["csv", "parquet"] = "csv",
    overlap: float = 0.5,
    width: int = 320,
    threshold: float | None = None,
    suppression: float | None = None,
    inhibition: float | None = None,
) -> None:
    """Run the two collision detectors on a video; leave u and FF of each frame, a plot and an overlay video.

    Args:
        path: the video; anything that FFmpeg reads
        stereo: each frame holds the left and the right eye's picture, side by side
        mono: each frame is one picture, and each eye looks at its side of it (so it is without --stereo)
        out: the results go into a folder of the video's name in here
        table: format of the numbers, one row a frame
        overlap: fraction of its picture that each eye looks at, 0.5 (its half) to 1 (all of it)
        width: pictures that are wider are averaged down to this [px]
        threshold: T_s, the change that a cell must exceed [grey levels of 255]
        suppression: T_f, the mean change over the picture at which the detector is silenced [grey levels]
        inhibition: W_I, weight of the inhibition
    """
    from lgmdjax.cli import watch as watching
    from lgmdjax.detectors import lgmd

    if mono and stereo is not None:
        raise InputError("expected --mono or --stereo, got both; leave one out")
    chosen = {"threshold": threshold, "suppression": suppression, "inhibition": inhibition}
    params = replace(lgmd.Params(), **{name: value for name, value in chosen.items() if value is not None})
    eyes = watching.Eyes(stereo=stereo is not None, overlap=overlap, width=width)
    for file in watching.watch(path, out, eyes=eyes, params=params, table=table):
        print(file)


def trial(
    name: Annotated[Name, tyro.conf.Positional],
    *,
    driver: Who = "learned",
    attempts: AttemptFlags,
) -> None:
    """Walk one of the paper's experiments; leave the outcome, the walks, a picture from above and a film.

    Args:
        name: of the experiment
        driver: who walks
    """
    import_physics()
    from lgmdjax.evaluation.run_trial import attempt

    print(f"look into {attempt(name, driver, **vars(attempts))}")


COMMANDS: dict[str, Callable[..., int | None]] = {
    "reproduce": reproduce,
    "fit-gait": fit_gait,
    "collect": collect,
    "train": train,
    "evaluate": evaluate,
    "report": report,
    "trial": trial,
    "watch": watch,
    "doctor": doctor,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; give the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"lgmdjax {__version__}")
        return 0
    prepare_jax()
    return guarded(
        lambda: tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="lgmdjax", args=arguments, description="A hexapod with the eyes of a locust."
        )
    )


def guarded(command: Callable[[], int | None]) -> int:
    """Run a command; give its exit code, after a line on stderr where the user can mend it."""
    try:
        return command() or 0
    except (InputError, OSError) as error:
        print(f"lgmdjax: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lgmdjax: interrupted; the same command carries on", file=sys.stderr)
        return 130


def _execute(pipeline: Pipeline, target: str) -> Path:
    from lgmdjax.runtime.run_folders import execute, open_run

    name = pipeline.name or f"{pipeline.scale}-{pipeline.seed}"
    run = open_run(pipeline.out, name, pipeline.scale, pipeline.seed, SCALES[pipeline.scale])
    import_physics()
    from lgmdjax.pipeline.stages import STAGES

    return execute(run, STAGES, target)
