"""Flags of the commands, and the settings that they can change one by one.

The flag of a setting is its path: `--train.epochs`, `--collect.eyes.width`, `--evaluate.tube.seeds` (the plan of a
trial has the trial's name). Its default is that of the scale, so `--scale` is read before the other flags are known.
Nothing here imports NumPy or JAX, so that help is printed at once.
"""

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from lgmdjax.control.names import POLICY_NAMES, PolicyName
from lgmdjax.datasets.formats import DatasetFormat
from lgmdjax.deployment.formats import FORMATS, PRETRAINED, Format
from lgmdjax.errors import InputError
from lgmdjax.evaluation.settings import BenchScale, TrialName, TrialPlan
from lgmdjax.pipeline import scales
from lgmdjax.pipeline.scales import Scale
from lgmdjax.pipeline.settings import EvaluateSettings
from lgmdjax.runtime import seeds

FlagsT = TypeVar("FlagsT")
MAX_NAME = 200  # characters of the name that a run folder gets from its changed settings
MAY_BE_ZERO = ("dagger-rounds", "ground", "falloff")


@dataclass(frozen=True, kw_only=True)
class PipelineFlags:
    """The run folder, and the settings of its stages."""

    scale: Scale = "quick"
    """smoke runs every stage in minutes, quick shows the result, paper has the settings of the paper"""
    out: Path = Path("runs")
    """folder that holds the run folders"""
    seed: int = 0
    """seed of all random numbers"""
    name: str = ""
    """name of the run folder; if empty, <scale>-<seed> and each setting that is changed: quick-0_train.epochs=200"""
    robot: Path | None = None
    """TOML file that describes a robot of your own (docs/howto/robot.md); the package's robot if left out"""
    track: str = ""
    """log of the curves of fits: tensorboard, or module:function for your own log(step, values)"""
    distributed: tyro.conf.FlagCreatePairsOff[bool] = False
    """share the work with other processes, started with the same flags; SLURM or Open MPI say which one this is"""
    coordinator: str = ""
    """without SLURM and Open MPI: HOST:PORT of process 0, at which the processes find each other"""
    processes: int | None = None
    """with --coordinator: number of processes"""
    process: int | None = None
    """with --coordinator: number of this process, from 0"""
    wait: float = 300.0
    """how long processes wait for each other at the start [s]"""
    chunks: str = ""
    """URL of an object store for the recorded walks, such as s3://bucket/prefix (docs/howto/many_machines.md)"""
    settings: Annotated[Mapping[str, object], tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class StudyFlags:
    """The robot and the settings of a study."""

    run: Path | None = None
    """run folder of the robot that is studied; the pretrained robot if left out"""
    seed: int = 0
    """seed of all random numbers"""
    out: Path = Path("runs/studies")
    """folder that holds the folders of the studies"""
    name: str = ""
    """name of the study's folder; if empty, <study>-<seed> and each setting that is changed: velocity-0_robots=4"""
    track: str = ""
    """log of the curves of fits: tensorboard, or module:function for your own log(step, values)"""
    settings: object


@dataclass(frozen=True, kw_only=True)
class TrialFlags:
    """The trials, and the robot and policies that run them."""

    trials: tyro.conf.Positional[tuple[TrialName, ...]]
    """trials of the paper"""
    policy: tuple[PolicyName | Literal["all"], ...] = ("learned",)
    """policies to compare; all means all five"""
    seed: int = 0
    """seed of rooms, textures and start poses"""
    seeds: int | None = None
    """number of seeds; if left out that of the trial, which is at least the paper's number of repetitions"""
    width: int | None = None
    """width of the pictures [px], 320 in the paper; if left out as in the robot's training, with similar results"""
    run: Path | None = None
    """run folder of the robot; the pretrained robot if left out"""
    out: Path = Path("runs/trials")
    """folder that holds one folder for each trial and policy"""

    def policies(self) -> tuple[PolicyName, ...]:
        """Return the policies that are compared, in the order in which they were given."""
        names: list[PolicyName] = []
        for name in self.policy:
            names.extend(POLICY_NAMES if name == "all" else (name,))
        return tuple(dict.fromkeys(names))


@dataclass(frozen=True, kw_only=True)
class AlarmFlags:
    """When a rising response counts as an alarm."""

    threshold: float = 0.6
    """adapted response of an eye, from 0.5 (no rise) to 1; 0.6 means 1.5 times the excitation of the last seconds"""
    persistence: float = 0.1
    """how long the response must stay above the threshold [s]"""
    exit_code: tyro.conf.FlagCreatePairsOff[bool] = False
    """end with exit code 3 if there is an alarm, for scripts"""


@dataclass(frozen=True, kw_only=True)
class WatchFlags:
    """The video, and how the detectors see it."""

    video: tyro.conf.Positional[str]
    """any video that FFmpeg reads, or a live source: /dev/video0, tcp://, rtsp:// or http://..., a pipe, /dev/stdin"""
    seconds: float = 60.0
    """how long a live source is watched, unless it ends earlier; a file is watched to its end"""
    stereo: Literal["side-by-side"] | None = None
    """each frame holds the pictures of the left and the right eye, side by side"""
    mono: tyro.conf.FlagCreatePairsOff[bool] = False
    """each frame is one picture, of which each eye sees its side (the default without --stereo)"""
    out: Path = Path("runs/watch")
    """folder that holds one folder for each video"""
    table: Literal["csv", "parquet"] = "csv"
    """file format of the responses, one row for each frame"""
    overlay: bool = True
    """write the video with the responses drawn over it; without it the command is more than twice as fast"""
    overlap: float = 0.5
    """fraction of its picture's width that each eye sees, from 0.5 (its half) to 1 (all of it)"""
    ground: float = 0.0
    """fraction of its picture's height, at the bottom, that no eye sees"""
    falloff: float = 0.0
    """how much less weight cells have at the side than ahead; 2 in the pretrained robot, 0 for equal weights"""
    fov: float = 170.0
    """horizontal field of view of a picture [deg], which --falloff needs for the bearings of the cells"""
    pooling: int = 1
    """width of a detector's cell [px]"""
    width: int = 320
    """wider pictures are averaged down to this width [px]"""
    threshold: float | None = None
    """T_s, threshold of a cell's excitation [grey levels of 255]"""
    suppression: float | None = None
    """T_f, mean change of the picture above which the response is suppressed [grey levels]"""
    inhibition: float | None = None
    """W_I, weight of the inhibition"""
    alarm: AlarmFlags = AlarmFlags()


@dataclass(frozen=True, kw_only=True)
class BenchFlags:
    """What the detectors are compared on, and which."""

    on: tyro.conf.Positional[Literal["stimuli", "clips", "fit", "closed-loop", "all"]] = "stimuli"
    """stimuli: laboratory stimuli, from approach to a flash of light; clips: labelled videos; fit: their constants
    fitted by gradient; closed-loop: walks of the robot that they steer; all: all of these, on one page"""
    paths: tyro.conf.Positional[tuple[Path, ...]] = ()
    """with clips and all, the folder of the videos, and the file of their labels if that is not labels.csv in it"""
    detector: tuple[str, ...] = ("all",)
    """detectors by name, or module:attribute for one of your own; all means those of lgmdjax.detectors"""
    scale: BenchScale = "quick"
    """smoke goes through every step; quick takes minutes, in the closed loop half an hour; full has l/|v| from 10 ms
    to 2 s, and three splits and navigators for each detector in fit and closed loop"""
    seed: int = 0
    """seed of the noise, the rooms and the training"""
    run: Path | None = None
    """run folder of the robot that walks; the pretrained robot if left out"""
    out: Path = Path("runs/bench")
    """folder that holds one folder for each benchmark and scale"""


@dataclass(frozen=True, kw_only=True)
class SweepFlags:
    """The file of the sweep, and where its runs are executed."""

    file: tyro.conf.Positional[Path]
    """TOML file with the command, its flags and seeds, and the measures; docs/howto/sweep.md describes it"""
    out: Path = Path("runs/sweeps")
    """folder that holds the folders of the sweeps"""
    name: str = ""
    """name of the sweep's folder; that of the file if left out"""
    workers: int = 1
    """number of runs at once on this machine; each uses all cores that it finds"""
    submitit: Literal["slurm", "local"] | None = None
    """run jobs by submitit (extra `cluster`): on a SLURM cluster, or on this machine to try it"""
    minutes: int = 120
    """longest duration of a job of submitit [min]"""
    cores: int = 2
    """number of cores of a job of submitit"""
    partition: str = ""
    """partition of SLURM; its default if left out"""


@dataclass(frozen=True, kw_only=True)
class ExportFlags:
    """The robot, and where its nervous system is written."""

    robot: tyro.conf.Positional[Path]
    """run folder of the robot, or the word pretrained for the one that comes with the package"""
    out: tyro.conf.Positional[Path]
    """folder to write; it must be empty or not exist"""
    width: int | None = None
    """width of the pictures [px], 320 in the paper; if left out as in the robot's training"""
    formats: tuple[Format, ...] = FORMATS
    """programs to write; onnx needs the extra `onnx`"""

    def run(self) -> Path | None:
        """Return the run folder; None means the pretrained robot."""
        return None if self.robot == Path(PRETRAINED) else self.robot


@dataclass(frozen=True, kw_only=True)
class DatasetFlags:
    """The recorded walks, and the data set that is made of them."""

    run: tyro.conf.Positional[Path]
    """run folder, whose teacher's walks are exported; or any folder with recorded walks, such as that of a trial"""
    out: tyro.conf.Positional[Path]
    """folder to write; it must be empty or not exist"""
    format: DatasetFormat = "lerobot"
    """lerobot is LeRobotDataset v3.0; the others are plain tables and arrays"""
    video: bool = False
    """render both eyes' pictures again from the poses, for lerobot (H.264) and zarr (without loss)"""
    licence: str = "Apache-2.0"
    """licence of the data, by its SPDX identifier; the card names it"""


@dataclass(frozen=True, kw_only=True)
class DemoFlags:
    """Where the page is served."""

    host: str = "127.0.0.1"
    """address to listen on; with the default only this machine can connect"""
    port: int = 8080
    """port to listen on; 0 takes a free one"""
    browser: bool = True
    """open the page in a browser"""
    out: Path = Path("runs/view")
    """folder that holds what is recorded in the browser"""


@dataclass(frozen=True, kw_only=True)
class ViewFlags(DemoFlags):
    """What is shown, and where the page is served."""

    path: tyro.conf.Positional[Path | None] = None
    """run folder, folder of a trial, or chunk-*.parquet; a live simulation if left out"""
    run: Path | None = None
    """run folder of the robot that is simulated live; the pretrained robot if left out"""
    room: Literal["random"] | TrialName = "random"
    """room of the live simulation: random, or that of a trial"""
    seed: int = 0
    """seed of the room of the live simulation"""


@dataclass(frozen=True, kw_only=True)
class DoctorFlags:
    """The folder that is checked."""

    out: Path = Path("runs")
    """folder that run folders would be written to"""


NEED_RUN = ("sensitivity", "overlap", "lgmd_gradient")
"""Studies that read recorded walks; the pretrained robot has none."""


def parse_pipeline(command: str, description: str, arguments: Sequence[str]) -> PipelineFlags:
    """Read the flags of a pipeline stage, whose settings default to those of the scale."""
    scale = _read_scale(arguments)
    preset = scales.SCALES[scale]
    flags = parse(PipelineFlags(scale=scale, settings=preset), command, description, arguments)
    settings = {stage: _keep_preset(preset[stage], flags.settings[stage]) for stage in preset}
    check_settings(settings)
    for flag, value in changed_settings(preset, settings).items():
        if flag.endswith(".trial"):
            raise InputError(f"expected --{flag} unchanged, got {value}; use the flags of the other trial instead")
    robot = f"_robot={_format(flags.robot.stem)}" if flags.robot else ""
    name = flags.name or name_run(f"{flags.scale}-{flags.seed}{robot}", preset, settings)
    return replace(flags, name=name, settings=settings)


def parse_study(study: str, question: str, arguments: Sequence[str]) -> StudyFlags:
    """Read the flags of a study, whose settings default to those of scale paper."""
    preset = {**scales.SCALES["paper"], **scales.STUDY_PRESETS}[study]
    flags = parse(StudyFlags(settings=preset), f"study {study}", question, arguments)
    if study in NEED_RUN and flags.run is None:
        raise InputError(f"expected --run with a run folder for study {study}, which reads recorded walks; got none")
    settings = _keep_preset(preset, flags.settings)
    check_settings(settings, "settings")
    name = flags.name or name_run(f"{study}-{flags.seed}", preset, settings)
    return replace(flags, name=name, settings=settings)


def parse(flags: FlagsT, command: str, description: str, arguments: Sequence[str]) -> FlagsT:
    """Read flags; those that are not given keep the values of `flags`. Raises InputError for an impossible --seed."""
    for before, argument in zip(("", *arguments), arguments, strict=False):
        flag, equals, value = argument.partition("=")
        if not (value if equals else argument) and "--name" not in (before, flag):
            named = flag if equals else before or "the first argument"
            raise InputError(f"expected a value for {named}, got an empty one; leave it out, or give a path")
    given = tyro.cli(
        type(flags),
        default=flags,
        prog=f"lgmdjax {command}",
        description=description,
        args=arguments,
        config=(tyro.conf.AvoidSubcommands,),
        registry=_REGISTRY,
    )
    seeds.check(getattr(given, "seed", 0))
    return given


def parse_trial(description: str, arguments: Sequence[str]) -> TrialFlags:
    """Read the flags of command trial."""
    flags = parse(TrialFlags(trials=tyro.MISSING), "trial", description, arguments)
    if not flags.trials:
        raise InputError(f"expected one or more trials, got none; choose from {', '.join(get_args(TrialName))}")
    return flags


def parse_watch(description: str, arguments: Sequence[str]) -> WatchFlags:
    """Read the flags of command watch."""
    return parse(WatchFlags(video=tyro.MISSING), "watch", description, arguments)


def parse_bench(description: str, arguments: Sequence[str]) -> BenchFlags:
    """Read the flags of command bench."""
    return parse(BenchFlags(), "bench", description, arguments)


def parse_sweep(description: str, arguments: Sequence[str]) -> SweepFlags:
    """Read the flags of command sweep."""
    return parse(SweepFlags(file=tyro.MISSING), "sweep", description, arguments)


def parse_dataset(description: str, arguments: Sequence[str]) -> DatasetFlags:
    """Read the flags of command export-dataset."""
    return parse(DatasetFlags(run=tyro.MISSING, out=tyro.MISSING), "export-dataset", description, arguments)


def parse_export(description: str, arguments: Sequence[str]) -> ExportFlags:
    """Read the flags of command export."""
    flags = parse(ExportFlags(robot=tyro.MISSING, out=tyro.MISSING), "export", description, arguments)
    if not flags.formats:
        raise InputError(f"expected one or more --formats, got none; choose from {', '.join(FORMATS)}")
    return flags


def changed_settings(preset: object, settings: object, flag: str = "") -> dict[str, object]:
    """Return the settings that differ from the preset, by the names of their flags.

    >>> from lgmdjax.pipeline.settings import ReportSettings
    >>> changed_settings({"report": ReportSettings(video_seconds=10)}, {"report": ReportSettings(video_seconds=5)})
    {'report.video-seconds': 5}
    """
    fields = _fields(preset, settings, flag)
    if fields is None:
        return {} if preset == settings else {flag: settings}
    return {name: value for field in fields for name, value in changed_settings(*field).items()}


def name_run(prefix: str, preset: object, settings: object) -> str:
    """Return the default name of a run folder, which lists its changed settings.

    >>> name_run("quick-0", {"report": 1.0}, {"report": 2.0})
    'quick-0_report=2'
    """
    changed = changed_settings(preset, settings)
    name = "_".join([prefix, *(f"{flag}={_format(value)}" for flag, value in changed.items())])
    if len(name) > MAX_NAME:
        raise InputError("expected a --name for a run with so many changed settings, got none; choose one")
    return name


def check_settings(settings: object, flag: str = "") -> None:
    """Raise `InputError` for a number that is negative or not finite, or zero where the setting can't be zero."""
    for _, value, name in _fields(settings, settings, flag) or ():
        check_settings(value, name)
    may_be_zero = flag.rpartition(".")[2] in MAY_BE_ZERO
    for value in settings if isinstance(settings, tuple) else (settings,):
        if isinstance(value, (int, float)) and not (0 < value < math.inf or (value == 0 and may_be_zero)):
            least = "0 or more" if may_be_zero else "more than 0"
            raise InputError(f"expected {least} for --{flag}, got {value}; choose another number")


def _fields(preset: object, settings: object, flag: str) -> list[tuple[object, object, str]] | None:
    """Return (preset, setting, flag) for each part of some settings; None for a setting without parts."""
    if isinstance(preset, EvaluateSettings) and isinstance(settings, EvaluateSettings):
        plans = zip(preset.trials, settings.trials, strict=True)
        return [(before, after, f"{flag}.{before.trial}") for before, after in plans]
    before, after = (_mapping(each) for each in (preset, settings))
    if before is None or after is None:
        return None
    return [(before[name], after[name], f"{flag}.{name.replace('_', '-')}".lstrip(".")) for name in after]


def _mapping(settings: object) -> dict[str, object] | None:
    if is_dataclass(settings):
        return dict(vars(settings))
    return dict(settings) if isinstance(settings, Mapping) else None


def _format(value: object) -> str:
    """Return a value as a part of a file name."""
    values = value if isinstance(value, tuple) else (value,)
    text = ",".join(f"{each:.12g}" if isinstance(each, float) else str(each) for each in values)
    return re.sub(r"[^\w.,+-]", "-", text)


def _keep_preset(preset: object, settings: object) -> object:
    """Return the preset if the settings are equal to it, because 10.0 and 10 would have different hashes."""
    return preset if settings == preset else settings


def _read_scale(arguments: Sequence[str]) -> Scale:
    """Return the scale among the arguments, or the default for an unknown scale, which tyro then rejects."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--scale", nargs="?")
    found = parser.parse_known_args(arguments)[0].scale
    return found if found in scales.SCALES else PipelineFlags.scale


_REGISTRY = ConstructorRegistry()


@_REGISTRY.primitive_rule
def _read_paths(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path] | None:
    """Expand ~."""
    if info.type is not Path:
        return None

    def read(words: list[str]) -> Path:
        return Path(words[0]).expanduser()

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda path: [str(path)],
    )


@_REGISTRY.struct_rule
def _name_plans_by_trial(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Name the flags of stage evaluate's plans by their trials, not by their numbers."""
    if info.type is not EvaluateSettings:
        return None
    plans = tuple(StructFieldSpec(name=plan.trial, type=TrialPlan, default=plan) for plan in info.default.trials)
    return StructConstructorSpec(
        instantiate=lambda **plans: EvaluateSettings(trials=tuple(plans.values())), fields=plans
    )
