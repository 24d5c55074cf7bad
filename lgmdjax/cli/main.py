"""The command line: one function for each command, which reads its own flags.

A user's mistake, and an environment in which a library does not start, end in one line on stderr and exit code 2. An
interruption ends in exit code 130 (Ctrl-C), 143 (SIGTERM) or 129 (SIGHUP), within two seconds. Modules are imported by
the command that needs them: `lgmdjax --help` loads neither tyro nor JAX, and the help of a command loads no JAX.
"""

import argparse
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from inspect import getdoc
from pathlib import Path
from typing import IO, TYPE_CHECKING

from lgmdjax import __version__
from lgmdjax.cli import environment, streams
from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import interruption
from lgmdjax.runtime.jax_setup import collect_garbage_rarely, prepare_jax, prepare_opengl

if TYPE_CHECKING:
    from lgmdjax.cli import flags

RESUMES, RESTARTS = "the same command resumes", "the same command starts again"  # after an interruption
NOT_RESUMED = (
    "watch", "export", "export-dataset", "drive", "calibrate-camera", "servos", "sim-robot", "demo", "view", "doctor",
)  # fmt: skip
RESUMED_BENCHMARKS = ("fit", "closed-loop", "all")
ALARM_CODE = 3  # exit code of `lgmdjax watch --alarm.exit-code` after an alarm
MIN_COLUMNS, MAX_COLUMNS = 40, 400  # of help; tyro does not terminate in narrower terminals
DESCRIPTION = "A hexapod robot that avoids obstacles with two looming detectors (LGMD) and a learned controller."


def reproduce(arguments: Sequence[str]) -> None:
    """Fit the gait, collect, train, evaluate and report; finished stages are skipped."""
    print(f"open {_run_stages('report', arguments, reproduce) / 'index.html'}")


def fit_gait(arguments: Sequence[str]) -> None:
    """Fit the shaping networks to the regular tripod gait."""
    _run_stages("fit-gait", arguments, fit_gait)


def collect(arguments: Sequence[str]) -> None:
    """Record walks of the teacher in training rooms, after the stages that this one needs."""
    _run_stages("collect", arguments, collect)


def train(arguments: Sequence[str]) -> None:
    """Train the navigator on recorded walks, after the stages that this one needs."""
    _run_stages("train", arguments, train)


def evaluate(arguments: Sequence[str]) -> None:
    """Run all policies in the trials, after the stages that this one needs."""
    _run_stages("evaluate", arguments, evaluate)


def report(arguments: Sequence[str]) -> None:
    """Write the report page, after the stages that this one needs."""
    print(f"open {_run_stages('report', arguments, report) / 'index.html'}")


def trial(arguments: Sequence[str]) -> None:
    """Run policies in trials of the paper: outcome, walks, plot of the paths, video."""
    from lgmdjax.cli import flags

    given = flags.parse_trial(_summary(trial), arguments)
    environment.check_jax()
    from lgmdjax.cli.trial import run_trials

    for line in run_trials(given):
        print(line, flush=True)


def study(arguments: Sequence[str]) -> None:
    """Answer a question about the robot with a table and a figure."""
    word = [word if word.startswith("-") else word.replace("-", "_") for word in arguments[:1]]
    name = _choose("lgmdjax study", "STUDY", _summary(study), STUDIES, word)
    from lgmdjax.cli import flags

    given = flags.parse_study(name, STUDIES[name], arguments[1:])
    if name == "transfer":
        prepare_opengl()
    environment.check_jax()
    from lgmdjax.cli.study import run_study

    print(f"results in {run_study(name, given)}")


def sweep(arguments: Sequence[str]) -> None:
    """Run a command with many settings and seeds, here or on a cluster: table and figure with intervals."""
    from lgmdjax.cli import flags

    given = flags.parse_sweep(_summary(sweep), arguments)
    environment.check_jax()
    from lgmdjax.cli.sweep import run

    print(f"results in {run(given)}")


def watch(arguments: Sequence[str]) -> int:
    """Run the two looming detectors on a video: responses of each frame, alarms, plot, overlay video."""
    from lgmdjax.cli import flags

    given = flags.parse_watch(_summary(watch), arguments)
    environment.check_jax()
    from lgmdjax.cli.watch import watch_video

    watched = watch_video(given)
    for file in watched.files:
        print(file)
    return ALARM_CODE if watched.alarms and given.alarm.exit_code else 0


def export(arguments: Sequence[str]) -> None:
    """Write a robot's nervous system as ONNX, StableHLO and C99, to run it without this package."""
    from lgmdjax.cli import flags

    given = flags.parse_export(_summary(export), arguments)
    environment.check_jax()
    from lgmdjax.cli.export import export_robot

    for line in export_robot(given):
        print(line)


def export_dataset(arguments: Sequence[str]) -> None:
    """Write recorded walks as a data set: LeRobot, CSV, Parquet or Zarr, with a card."""
    from lgmdjax.cli import flags

    given = flags.parse_dataset(_summary(export_dataset), arguments)
    environment.check_jax()
    from lgmdjax.datasets import exporter

    for file in exporter.export(given.run, given.out, given.format, video=given.video, licence=given.licence):
        print(file)


def drive(arguments: Sequence[str]) -> int:
    """Drive a robot by its nervous system, from live cameras to servos (extra `drive`)."""
    from lgmdjax.cli import hardware_flags

    given = hardware_flags.parse_drive(_summary(drive), arguments)
    environment.check_jax()
    from lgmdjax.cli.drive import drive as run

    return run(given)


def calibrate_camera(arguments: Sequence[str]) -> None:
    """Calibrate a camera's lens from pictures of a chessboard (extra `drive`)."""
    from lgmdjax.cli import hardware_flags

    given = hardware_flags.parse_calibrate_camera(_summary(calibrate_camera), arguments)
    environment.check_jax()
    from lgmdjax.cli.calibrate_camera import calibrate

    for line in calibrate(given):
        print(line)


def servos(arguments: Sequence[str]) -> None:
    """Find out which servo is which joint: `servos map` moves one at a time (extra `drive`)."""
    _choose("lgmdjax servos", "ACTION", _summary(servos), {"map": "move one servo at a time and ask"}, arguments[:1])
    from lgmdjax.cli import hardware_flags

    given = hardware_flags.parse_servos_map(_summary(servos), arguments[1:])
    environment.check_jax()
    from lgmdjax.cli.servos import map_servos

    map_servos(given)


def sim_robot(arguments: Sequence[str]) -> None:
    """Simulate a robot in a room: servos on a pseudo-terminal, eyes as a stream of pictures."""
    from lgmdjax.cli import hardware_flags

    given = hardware_flags.parse_sim_robot(_summary(sim_robot), arguments)
    environment.check_jax()
    from lgmdjax.cli.sim_robot import run_robot

    run_robot(given)


def bench(arguments: Sequence[str]) -> None:
    """Compare looming detectors on stimuli, on labelled videos, after a fit, and as the eyes of the robot."""
    from lgmdjax.cli import flags

    given = flags.parse_bench(_summary(bench), arguments)
    environment.check_jax()
    from lgmdjax.cli import bench_all

    run = bench_all.run_all if given.on == "all" else bench_all.BENCHMARKS[given.on].run
    for line in run(given):
        print(line, flush=True)


def demo(arguments: Sequence[str]) -> None:
    """Show the pretrained robot in the browser: a recorded walk at once, a live simulation on request."""
    from lgmdjax.cli import flags

    given = flags.parse(flags.DemoFlags(), "demo", _summary(demo), arguments)
    from lgmdjax.cli.view import show_demo

    show_demo(given)


def view(arguments: Sequence[str]) -> None:
    """Show recorded walks in the browser, or simulate a robot live in a room whose obstacles can be moved."""
    from lgmdjax.cli import flags

    given = flags.parse(flags.ViewFlags(), "view", _summary(view), arguments)
    from lgmdjax.cli.view import show_walks

    show_walks(given)


def doctor(arguments: Sequence[str]) -> int:
    """Check this machine: versions, devices, arithmetic, physics, video, disk; exit code 1 after a FAIL."""
    from lgmdjax.cli import flags

    given = flags.parse(flags.DoctorFlags(), "doctor", _summary(doctor), arguments)
    from lgmdjax.cli.doctor import run_checks

    return run_checks(given.out)


COMMANDS: Mapping[str, Callable[[Sequence[str]], int | None]] = {
    "reproduce": reproduce,
    "fit-gait": fit_gait,
    "collect": collect,
    "train": train,
    "evaluate": evaluate,
    "report": report,
    "trial": trial,
    "study": study,
    "sweep": sweep,
    "watch": watch,
    "export": export,
    "export-dataset": export_dataset,
    "drive": drive,
    "calibrate-camera": calibrate_camera,
    "servos": servos,
    "sim-robot": sim_robot,
    "bench": bench,
    "demo": demo,
    "view": view,
    "doctor": doctor,
}

STUDIES: Mapping[str, str] = {
    "velocity": "How fast should the robot walk for its detectors? (fig. 9)",
    "supervision": "Which rule should teach, and which network should learn? (sec. 3.4 and 4.2)",
    "errata": "What do the equations do that cannot work as printed?",
    "failure_modes": "How often do a white wall and a corner stop the robot, and what helps? (sec. 5.4)",
    "sensitivity": "How far may camera, rooms, legs and data be from those of the training?",
    "overlap": "How much of its picture should each detector see?",
    "gait_gradient": "Can the gait be fitted by gradient through the physics?",
    "lgmd_gradient": "Does a detector that is fitted by gradient steer better than the calibrated one?",
    "gradient_horizon": "Over how many frames is a gradient through the closed loop meaningful?",
    "closed_loop_finetune": "Does the gradient through the closed loop teach what imitation cannot?",
    "transfer": "Does the trained robot avoid obstacles in another engine, and which fault stops it?",
}
"""The studies of `lgmdjax.studies`, and the question of each."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    return exit_code(lambda: _run(given), RESUMES if resumes(given) else RESTARTS)


def resumes(given: Sequence[str]) -> bool:
    """Return whether a command resumes after an interruption, rather than start again.

    >>> resumes(["bench", "stimuli"]), resumes(["bench", "fit"]), resumes(["trial", "tube"])
    (False, True, True)
    """
    if given[:1] == ["bench"]:
        return any(word in RESUMED_BENCHMARKS for word in given[1:])
    return not (given and given[0] in NOT_RESUMED)


def exit_code(command: Callable[[], int | None], afterwards: str = RESUMES) -> int:
    """Run a command and return its exit code; print one line on stderr for a mistake of the user.

    Args:
        command: returns an exit code, or None for 0.
        afterwards: what the user can do after an interruption.
    """
    interrupted = f"lgmdjax: interrupted; {afterwards}"
    try:
        with streams.writable(), interruption.handling_signals(interrupted):
            return command() or 0
    except OSError as error:
        return streams.complain(f"lgmdjax: {one_line(streams.explain_full_disk(error) or error)}", 2)
    except InputError as error:
        return streams.complain(f"lgmdjax: {error}", 2)
    except MemoryError as error:
        reason = one_line(error) or "none"
        return streams.complain(f"lgmdjax: expected more memory, got {reason}; run fewer robots at once", 2)
    except KeyboardInterrupt as error:
        return streams.complain(interrupted, error.exit_code if isinstance(error, interruption.Interrupted) else 130)
    except Exception as error:
        if fault := environment.explain(error):
            return streams.complain(f"lgmdjax: {one_line(fault)}", 2)
        raise


def _run(given: Sequence[str]) -> int | None:
    """Run the command that the arguments name."""
    columns = shutil.get_terminal_size().columns
    if not MIN_COLUMNS <= columns <= MAX_COLUMNS:
        os.environ["COLUMNS"] = str(min(max(columns, MIN_COLUMNS), MAX_COLUMNS))
    summaries = {name: _summary(command) for name, command in COMMANDS.items()}
    name = _choose("lgmdjax", "COMMAND", DESCRIPTION, summaries, given[:1])
    prepare_jax()
    collect_garbage_rarely()
    return COMMANDS[name](given[1:])


class _Parser(argparse.ArgumentParser):
    """A parser that raises an error if its help cannot be printed."""

    def _print_message(self, message: str, file: IO[str] | None = None) -> None:
        (file or sys.stderr).write(message or "")


def _choose(program: str, noun: str, description: str, choices: Mapping[str, str], word: Sequence[str]) -> str:
    """Return the choice that a word names; exit with help or an error if there is no such word."""
    column = max(map(len, choices))
    listed = "\n".join(f"  {name:{column}}  {summary}" for name, summary in choices.items())
    parser = _Parser(
        prog=program,
        usage=f"{program} {noun} [flags]",
        description=description,
        epilog=f"{noun} is one of\n{listed}\n\n`{program} {noun} --help` lists the flags.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action="version", version=f"lgmdjax {__version__}", help="show the version and exit"
    )
    parser.add_argument("name", metavar=noun, choices=choices, help=argparse.SUPPRESS)
    return parser.parse_args(word).name


def _summary(command: Callable[[Sequence[str]], int | None]) -> str:
    """Return the first line of a command's docstring, which is its help."""
    return (getdoc(command) or "").partition("\n")[0]


def _run_stages(target: str, arguments: Sequence[str], command: Callable[[Sequence[str]], None]) -> Path:
    """Run the stages up to a target in the run folder of the flags; return the folder of the target."""
    from lgmdjax.cli import flags, tracking

    name = command.__name__.replace("_", "-")
    given = flags.parse_pipeline(name, _summary(command), arguments)
    tracking.check(given.track)
    environment.check_jax()
    from lgmdjax.cli import processes

    with processes.joined(given, name):
        return _run_stages_of(given, target)


def _run_stages_of(given: "flags.PipelineFlags", target: str) -> Path:
    """Run the stages up to a target, with the other processes if there are some."""
    from lgmdjax.cli import tracking
    from lgmdjax.runtime import distributed, object_store
    from lgmdjax.runtime.run_folders import execute, open_run

    settings, robot_stages = given.settings, ()
    if given.robot is not None:
        from lgmdjax.body import custom_robot
        from lgmdjax.pipeline import robot

        own = custom_robot.read(given.robot)
        settings, robot_stages = {"robot": robot.settings_of(own), **settings}, (robot.make_stage(own),)
    run = open_run(given.out, given.name, given.scale, given.seed, settings)
    track = given.track if distributed.is_first() else ""
    with object_store.keep_chunks(given.chunks, run.folder), tracking.log_to(track, run.folder):
        from lgmdjax.pipeline.stages import STAGES

        return execute(run, (*robot_stages, *STAGES), target)
