"""Settings of the stages, except those of stage train. Imports no JAX, so that the command line needs none."""

from dataclasses import dataclass

from lgmdjax.evaluation.settings import TrialPlan
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.transfer.names import FaultName


@dataclass(frozen=True, kw_only=True)
class RobotSettings:
    """A robot of one's own."""

    name: str  # that of its TOML file
    digest: str  # of the TOML file and the MJCF


@dataclass(frozen=True, kw_only=True)
class FitGaitSettings:
    """Fit of the shaping networks to the regular tripod gait, and walks at set velocities."""

    steps: int  # number of optimiser steps
    seconds: float  # duration of each walk [s]


@dataclass(frozen=True, kw_only=True)
class CollectSettings:
    """Recorded walks of the teacher; every robot has a room of its own, and every episode new rooms."""

    eyes: CameraSettings  # the stereo camera
    robots: int  # number of robots in an episode
    episodes: int  # number of episodes
    seconds: float  # duration of each robot's walk in an episode [s]
    calibration_seconds: float  # duration of each robot's walk for the calibration of the detectors [s]
    camera_faults: tuple[FaultName, ...] = ()  # that robots may have, here and in stage train; never in the calibration


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings:
    """All policies in the paper's experiments, and in held-out rooms."""

    trials: tuple[TrialPlan, ...]  # the trials, and the settings of each


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """The report page, with a video of one walk."""

    video_seconds: float  # duration of the video [s]
