"""The command line: one function for each command, which reads its own flags.

A user's mistake ends in one line on stderr and exit code 2, a signal in exit code 128 plus its number (130 for Ctrl-C).
Modules are imported by the command that needs them: `lgmdjax --help` loads neither tyro nor JAX, and the help of a
command loads no JAX.
"""

import argparse
import codecs
import contextlib
import io
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from inspect import getdoc
from pathlib import Path

from lgmdjax import __version__
from lgmdjax.errors import InputError
from lgmdjax.runtime.jax_setup import prepare_jax

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
    from lgmdjax.cli.trial import run_trials

    for line in run_trials(given):
        print(line, flush=True)


def study(arguments: Sequence[str]) -> None:
    """Answer a question about the robot with a table and a figure."""
    word = [word if word.startswith("-") else word.replace("-", "_") for word in arguments[:1]]
    name = _choose("lgmdjax study", "STUDY", _summary(study), STUDIES, word)
    from lgmdjax.cli import flags

    given = flags.parse_study(name, STUDIES[name], arguments[1:])
    from lgmdjax.cli.study import run_study

    print(f"look into {run_study(name, given)}")


def export(arguments: Sequence[str]) -> None:
    """Write a robot's nervous system as ONNX, StableHLO and C99, to run it without this package."""
    from lgmdjax.cli import flags

    given = flags.parse_export(_summary(export), arguments)
    from lgmdjax.cli.export import export_robot

    for line in export_robot(given):
        print(line)


def watch(arguments: Sequence[str]) -> None:
    """Run the two looming detectors on a video: responses of each frame, plot, overlay video."""
    from lgmdjax.cli import flags

    given = flags.parse_watch(_summary(watch), arguments)
    from lgmdjax.cli.watch import watch_video

    for file in watch_video(given):
        print(file)


def bench(arguments: Sequence[str]) -> None:
    """Compare looming detectors on laboratory stimuli: table, JSON, figure."""
    from lgmdjax.cli import flags

    given = flags.parse_bench(_summary(bench), arguments)
    from lgmdjax.cli.bench import run_bench

    for line in run_bench(given):
        print(line, flush=True)


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
    "watch": watch,
    "bench": bench,
    "export": export,
    "doctor": doctor,
}

NOT_RESUMED = ("watch", "doctor")
"""Commands that begin anew after an interruption."""

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
}
"""The studies of `lgmdjax.studies`, and the question of each."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    summaries = {name: _summary(command) for name, command in COMMANDS.items()}
    name = _choose("lgmdjax", "COMMAND", DESCRIPTION, summaries, given[:1])
    prepare_jax()
    _print_any_name()
    with _stopping_at_signals():
        return exit_code(lambda: COMMANDS[name](given[1:]), name)


def exit_code(command: Callable[[], int | None], name: str = "") -> int:
    """Run a command and return its exit code; print one line on stderr for a mistake of the user."""
    try:
        return command() or 0
    except (InputError, OSError) as error:
        print(f"lgmdjax: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        number = interruption.args[0] if interruption.args else signal.SIGINT
        then = "starts anew, and nothing was written" if name in NOT_RESUMED else "resumes"
        print(f"lgmdjax: interrupted by {signal.Signals(number).name}; the same command {then}", file=sys.stderr)
        return 128 + number


@contextlib.contextmanager
def _stopping_at_signals() -> Iterator[None]:
    """End the block at SIGTERM and SIGHUP as at Ctrl-C: what is unfinished is removed.

    Under nohup, SIGHUP stays ignored. Signals reach the main thread alone.
    """

    def stop(number: int, _: object) -> None:
        raise KeyboardInterrupt(number)

    handled = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        handled = []
    before = {number: signal.getsignal(number) for number in handled}
    replaced = [number for number, handler in before.items() if handler == signal.SIG_DFL]
    for number in replaced:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in replaced:
            signal.signal(number, before[number])


def _print_any_name() -> None:
    """Let stdout print the names of files that are not text in its encoding, byte by byte as they are."""

    def replace(error: UnicodeError) -> tuple[str | bytes, int]:
        try:
            return codecs.lookup_error("surrogateescape")(error)
        except UnicodeError:
            return codecs.backslashreplace_errors(error)

    codecs.register_error("lgmdjax-names", replace)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="lgmdjax-names")


def _choose(program: str, noun: str, description: str, choices: Mapping[str, str], word: Sequence[str]) -> str:
    """Return the choice that a word names; exit with help or an error if there is no such word."""
    column = max(map(len, choices))
    listed = "\n".join(f"  {name:{column}}  {summary}" for name, summary in choices.items())
    parser = argparse.ArgumentParser(
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
    from lgmdjax.cli import flags

    name = command.__name__.replace("_", "-")
    given = flags.parse_pipeline(name, _summary(command), arguments)
    from lgmdjax.runtime.run_folders import execute, open_run

    run = open_run(given.out, given.name, given.scale, given.seed, given.settings)
    from lgmdjax.pipeline.stages import STAGES

    return execute(run, STAGES, target)
