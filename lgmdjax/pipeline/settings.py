"""Settings of the stages, beside those of stage train."""

from dataclasses import dataclass

from lgmdjax.evaluation.settings import TrialPlan
from lgmdjax.sensors.settings import CameraSettings


@dataclass(frozen=True, kw_only=True)
class FitGaitSettings:
    """The shaping networks, taught the regular tripod gait, and walked at set velocities."""

    steps: int
    seconds: float  # of each measured walk


@dataclass(frozen=True, kw_only=True)
class CollectSettings:
    """Walks of the teacher: as many robots at once, each in a room of its own, and new rooms for every episode."""

    eyes: CameraSettings
    robots: int
    episodes: int
    seconds: float  # of each robot in an episode
    calibration_seconds: float  # of each robot, walked before to choose the thresholds on


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings:
    """The drivers in the paper's experiments, and in rooms that nobody has seen."""

    places: tuple[TrialPlan, ...]


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """The page; the video shows one walk."""

    video_seconds: float
